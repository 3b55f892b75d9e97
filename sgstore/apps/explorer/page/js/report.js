// @ts-check
// A report: what a query found, to be looked at without a server. One file holds this page and its answers.
import { h, htm, render } from "../vendor/core.js";
import { keepAll } from "./data.js";
import { Gallery } from "./gallery.js";
import { Above, keys } from "./keys.js";
import { kept } from "./offline.js";
import { Scene } from "./scene.js";
import { Rows, Verdicts } from "./verdicts.js";
import { answer, dialog, find, matches, notes, offline, open, store, text, values } from "./state.js";
import { Status } from "./status.js";

const html = htm.bind(h);

function Head() {
  const given = Object.entries(kept.parameters).map(([name, value]) => `$${name} = ${value}`).join(", ");
  return html`<header><span class="brand">sgstore</span><h1>${kept.about.store} · ${kept.made}</h1>
    <span class="grow"></span><button class="quiet" onClick=${() => { dialog.value = "keys"; }}>
      <kbd>?</kbd> keys</button></header>
    <section class="search asked"><code>${kept.query}</code>
      ${given ? html`<span class="faint"> ${given}</span>` : null}</section>`;
}

function Report() {
  const told = answer.value;
  const body = open.value ? html`<main class="open"><${Gallery} found=${matches.value} /><${Scene} /></main>`
    : told.rows ? html`<${Rows} />`
    : told.verdicts ? html`<${Verdicts} /><main><${Gallery} found=${matches.value} /></main>`
    : told.state === "done" && !told.matches.length ? html`<div class="sheet"><h2>Nothing matches</h2></div>`
      : html`<main><${Gallery} found=${matches.value} /></main>`;
  return html`<${Head} /><${Status} />${body}
<${Above} />`;
}

offline.value = true;
keepAll();
store.value = kept.about;
notes.value = kept.notes;
text.value = kept.query;
values.value = Object.fromEntries(Object.entries(kept.parameters).map(([name, value]) => [name, String(value)]));
for (const sign of ["x", "g", "w"]) keys.splice(keys.findIndex(([one]) => one === sign), 1);
render(html`<${Report} />`, /** @type {HTMLElement} */ (document.getElementById("app")));
find();
