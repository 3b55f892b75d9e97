// @ts-check
// The page: its head, the search, what was found, and the view that is open; keys.
import { effect, h, htm, render, untracked, useEffect, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { copyCommand, copyLink, followPlace, followSelection, offered, readAddress, tickOffered } from "./address.js";
import { askWhy, frame } from "./clock.js";
import { forget, retry } from "./data.js";
import { Editor, focusEditor, NumberSlider } from "./editor.js";
import { Gallery } from "./gallery.js";
import { Above, keys } from "./keys.js";
import { Scene } from "./scene.js";
import { Compare } from "./compare.js";
import { countLibrary, Near, Start, WordSearch } from "./library.js";
import { Selection } from "./select.js";
import { Coverage } from "./sheets.js";
import {
  answer, ask, askAgain, cancel, changed, dialog, find, history, isPattern, keep, library, matches, namesIn, notes,
    notice, open,
  openFrame, paints, parametersOf, reasonOf, refresh, retries, say, sought, store, tag, tagged, text, theme, ticked, values,
    view, words,
} from "./state.js";
import { Elapsed, Status } from "./status.js";
import { runsOfTags } from "./timeline.js";
import { Rows, Verdicts } from "./verdicts.js";

const html = htm.bind(h);
const VIEWS = [["find", "Find"], ["coverage", "Coverage"], ["selection", "Selection"], ["compare", "Compare"]];

/** What is filled of the disc on the button of the colours. @type {Record<string, string>} */
const DISC = { "": "M7 1.5v11a5.5 5.5 0 0 0 0-11z", light: "", dark: "M7 1.5a5.5 5.5 0 0 0 0 11a5.5 5.5 0 0 0 0-11z" };

function Head() {
  const about = store.value, frames = about.traces.reduce((/** @type {number} */ n,
    /** @type {any} */ t) => n + t.frames, 0);
  const next = theme.value === "" ? "dark" : theme.value === "dark" ? "light" : "";
  const home = () => { open.value = null; view.value = "find"; ask(""); };
  return html`<header><button class="brand" title="the library" onClick=${home}>
    <img src="static/icon.svg" alt="" />sgstore</button>
    <h1>${about.store} · ${about.traces.length} ${about.traces.length === 1 ? "trace"
      : "traces"} · ${frames.toLocaleString("en")} frames</h1>
    <nav aria-label="Views">${VIEWS.map(([key, name]) => html`<button
      aria-current=${view.value === key ? "page" : undefined}
      onClick=${() => { view.value = key || "find"; }}>${name}${key === "selection" && ticked.value.size
        ? html` <span class="badge">${ticked.value.size}</span>` : null}</button>`)}</nav>
    <button class="quiet" title="light, dark, or as the system has it"
      aria-label=${`Colours: ${theme.value || "of the system"}`} onClick=${() => { theme.value = next; }}>
      <svg class="icon" viewBox="0 0 14 14" aria-hidden="true"><circle cx="7" cy="7" r="5.5" fill="none"
        stroke="currentColor" stroke-width="1.5" /><path d=${DISC[theme.value]} fill="currentColor" /></svg></button>
    <button class="quiet" onClick=${() => { dialog.value = "keys"; }}><kbd>?</kbd> keys</button></header>`;
}

function Search() {
  const names = namesIn(text.value), patterns = library.value.filter((p) => p.kind !== "predicate");
  const choose = (/** @type {any} */ event) => {
    const one = library.value.find((p) => p.name === event.target.value);
    event.target.value = "";
    if (one) ask(one.text);
  };
  const groups = [...new Set(patterns.map((p) => p.library))];
  return html`<section class="search" aria-label="Search"><${Editor} />
    <div class="tools">
      <${WordSearch} />
      <select aria-label="Library of patterns" onChange=${choose}><option value="">library</option>
        ${groups.map((name) => html`<optgroup label=${name}>
          ${patterns.filter((p) => p.library === name).map((p) => html`<option value=${p.name} title=${p.sentence}>
          ${p.name}</option>`)}</optgroup>`)}</select>
      <select aria-label="History"
        onChange=${(/** @type {{target: HTMLInputElement}} */ e) => {
          if (e.target.value) { text.value = e.target.value; find(); }
          e.target.value = "";
        }}><option value="">history</option>
        ${history().map((one) => html`<option value=${one}>${one.replace(/\s+/g, " ").slice(0,
          90)}</option>`)}</select>
      ${names.map((name) => html`<label>$${name} <input size="8" aria-label=${`Value of $${name}`}
        value=${values.value[name] || ""}
        onInput=${(/** @type {{target: HTMLInputElement}} */ e) => { values.value = { ...values.value,
          [name]: e.target.value }; }}
        onKeyDown=${(/** @type {any} */ e) => { if (e.key === "Enter") find(); }} /></label>`)}
      ${sought.value.trim() ? null : html`<${NumberSlider} />`}<span class="grow"></span>
      ${answer.value.state === "busy" ? html`<button onClick=${cancel}>Stop</button>` : null}
      <button class="main" onClick=${() => find()}>Find <kbd>
        ${navigator.platform.startsWith("Mac") ? "Cmd" : "Ctrl"} Enter</kbd></button>
    </div></section>`;
}

/** @param {{first: number, last: number}} frames */
const spanOf = ({ first, last }) => `#${first}${last > first ? `–${last}` : ""}`;

function TagForm() {
  const now = open.value, match = now?.match, chosen = tagged.value;
  const spans = [
    ...(chosen ? [{ ...chosen, word: chosen.first === chosen.last ? "this frame" : "these frames" }] : []),
    ...(now && !chosen ? [{ trace: now.trace, first: frame.value, last: frame.value, word: "this frame" }] : []),
    ...(now && match && !chosen ? [{ trace: match.trace, first: match.first, last: match.last, word: "the match" }]
      : []),
  ];
  const first = spans[0];
  if (!first) return null;
  const mine = runsOfTags(notes.value, first.trace).filter((one) => one.first <= first.last
    && first.first <= one.last);
  const write = async (/** @type {SubmitEvent} */ event) => {
    event.preventDefault();
    const form = new FormData(/** @type {HTMLFormElement} */ (event.target)),
      { trace, first: seq, last } = spans[Number(form.get("span") || 0)] || first;
    try {
      await tag({ trace, seq, last, tag: form.get("tag"), note: form.get("note") });
      dialog.value = "";
      say("tagged");
    } catch (error) { say(reasonOf(error)); }
  };
  const remove = (/** @type {typeof mine[0]} */ one) => tag({ trace: first.trace, seq: one.first, last: one.last,
    tag: one.tag, do: "remove" }).catch((e) => say(reasonOf(e)));
  const known = [...new Set(notes.value.map((n) => n[2]))];
  return html`<h2>Tag ${first.trace}${spanOf(first)}</h2>
    <form onSubmit=${write}>
    <p><label>Tag <input name="tag" required maxlength="100" list="tags" autofocus /></label><datalist id="tags">
      ${known.map((one) => html`<option value=${one} />`)}</datalist></p>
    <p><label>Note <input name="note" size="40" maxlength="2000" /></label></p>
    ${spans.length < 2 ? null : html`<p><label>For <select name="span">
      ${spans.map((one, i) => html`<option value=${i}>${one.word}, ${spanOf(one)}</option>`)}</select></label></p>`}
    ${mine.map((one) => html`<p class="row"><span class="chip">
      ${one.tag}</span> ${one.note} <span class="faint">${spanOf(one)} ${one.who}</span>
      <button type="button" class="small" onClick=${() => remove(one)}>remove</button></p>`)}
    <button class="main">Tag</button></form>
    <p class="faint">Tags lie in a file beside the store; a query can ask for them: WHERE notes.tag = '…'</p>`;
}

function Found() {
  const told = answer.value;
  if (sought.value.trim() || (told.state === "idle" && !open.value)) return html`<${Start} />`;
  if (told.rows) return html`<${Rows} />`;
  if (!open.value && (told.error || (told.state !== "busy" && !told.matches.length
    && !told.verdicts))) return html`<${Nothing} />`;
  return html`${told.verdicts && !open.value ? html`<${Verdicts} />` : null}<main class=${open.value ? "open" : ""}>
    <${Gallery} found=${matches.value} word=${told.verdicts ? ["violation", "violations"] : undefined} />
      ${open.value ? html`<${Scene} />` : null}</main>`;
}

/** What to do where nothing was found: mend the text, take a pattern that is near, or see how near the store comes. */
function Nothing() {
  const { error, query } = answer.value, chars = [...query],
    could = store.value.traces.filter((/** @type {any} */ t) => !(t.name in answer.value.reasons));
  if (!error) {
    return html`<div class="sheet"><h2>Nothing matches</h2><${Nearest} query=${query} />
      <p class="faint">Open a trace: the lanes below it show where each part of the pattern holds,
        and <kbd>w</kbd> the part that a frame lacks.</p>
      <p class="row wrap">${could.slice(0, 60).map((/** @type {any} */ t) => html`<button
        onClick=${() => openFrame(t.name, 0)}>${t.name}</button>`)}</p></div>`;
  }
  const placed = Number.isInteger(error.start), { start, end } = placed ? error : { start: 0, end: chars.length },
    stop = Math.max(end, start + 1);
  const before = chars.slice(0, start).join(""), word = chars.slice(start, stop).join("");
  const better = /did you mean '([^']+)'\?/.exec(error.hint || "")?.[1],
    pattern = /\b(?:MATCH|CHECK|DEFINE|USING|SELECT|WITH|FROM)\b/.test(query);
  const mend = () => { text.value = placed ? `${before}${better}${chars.slice(end).join("")}`
    : `${better}`; find(); };
  return html`<div class="sheet">${placed ? html`<pre class="wrong">${before}<mark>${word || " "}</mark>
    ${chars.slice(stop).join("")}</pre>` : null}
    ${better ? html`<p>Did you mean <button class="main" onClick=${mend}>${better}</button></p>` : error.hint
      ? html`<p>${error.hint}</p>` : null}
    <h2>Near this</h2><${Near} text=${pattern ? word.replace(/([a-z])([A-Z])/g, "$1 $2") : query} most=${6} /></div>`;
}

/** The part of a pattern that no frame has, and the frame that comes nearest. @param {{query: string}} props */
function Nearest({ query }) {
  const [told, tell] = useState(/** @type {any} */ (null));
  useEffect(() => {
    const mine = new AbortController();
    tell(null);
    if (isPattern(query)) api.json("api/nearest", { text: query, parameters: parametersOf(query) },
      { signal: mine.signal }).then(tell, (error) => {
        if (!mine.signal.aborted) tell({ error: { reason: reasonOf(error) } });
      });
    return () => mine.abort();
  }, [query]);
  if (!isPattern(query)) return null;
  if (!told) return html`<p class="row faint" role="status"><span class="busy" aria-hidden="true"></span>
    looking for the part that is never true … <${Elapsed} key=${query} /></p>`;
  if (told.error) return html`<p class="error" role="alert">${told.error.reason}</p>`;
  if (!told.failed) return html`<p class="nearest" role="status">Each part of the pattern is true in some frame,
    but never in this order or for this long.</p>`;
  const go = () => { openFrame(told.trace, told.seq); askWhy(); };
  const others = (told.others || []).map((/** @type {string} */ one,
    /** @type {number} */ i) => html`${i ? " and " : ""}<code>${one}</code>`);
  return html`<p class="nearest" role="status">No frame of the store has <code>${told.failed}</code>${others.length
    ? html` together with ${others}` : null}. ${told.trace === undefined ? null : html`${told.found
      ? html`The nearest is <code>${told.found}</code>` : "A frame with the other parts"}:
      ${" "}<button onClick=${go}>${told.trace}#${told.seq}</button>`}</p>`;
}

function App() {
  if (!store.value) return html`<p class="loading">Reading the store …</p>`;
  const shownView = view.value;
  return html`<${Head} /><${Notices} />${shownView === "find" ? html`<${Search} /><${Status} /><${Found} />`
    : shownView === "coverage" ? html`<${Coverage} />` : shownView === "selection" ? html`<${Selection} />`
      : html`<${Compare} />`}<${Above}><${TagForm} /></${Above}>`;
}

keys.unshift(["/", "editor", { "/": focusEditor }], ["Ctrl Enter", "find", {}]);
keys.push(["t", "tag this frame", { t: () => { tagged.value = null; if (open.value) dialog.value = "tag"; } }],
  ["y", "copy a link", { y: copyLink }],
  ["Y", "copy the command that opens this view", { Y: copyCommand }]);

effect(() => {
  if (theme.value) document.documentElement.dataset.theme = theme.value; else delete document.documentElement.dataset.theme;
  keep("theme", theme.value);
  untracked(() => { paints.value++; });
});

/** The last selection of the store, which a page without it offers again. */
function LastSelection() {
  const many = offered.value.size, forget = () => { offered.value = new Map(); };
  if (!many) return null;
  return html`<aside class="notice" aria-label="Last selection">${many.toLocaleString("en")}
    ${" "}${many === 1 ? "match" : "matches"} of this store ${many === 1 ? "was" : "were"} selected before.
    ${" "}<button class="small" onClick=${tickOffered}>Select again</button>
    ${" "}<button class="small" onClick=${forget}>Forget</button></aside>`;
}

/** What the page has to say of the store and the server. */
function Notices() {
  const close = () => { notice.value = ""; };
  return html`${api.trouble.value ? html`<p class="notice error" role="alert">${api.trouble.value}</p>` : null}
    ${notice.value ? html`<p class="notice" role="alert">${notice.value} <button class="small"
      onClick=${close}>Close</button></p>` : null}
    ${changed.value ? html`<p class="notice" role="status">The store has changed since this was asked.
      ${" "}<button class="small" onClick=${askAgain}>Ask again</button></p>` : null}<${LastSelection} />`;
}

const LOOK = 2000; // ms between looks at the store

/** Follow the store and its server, while the page is in sight. */
async function follow() {
  const found = document.hidden ? null : await api.look();
  if (found && (found.a !== store.value.stamp || (found.b && found.b !== store.value.other?.stamp))) {
    await refresh().catch((error) => say(reasonOf(error)));
  }
  setTimeout(follow, LOOK);
}

/** Read what belongs to the store beside its traces. */
async function readRest() {
  try {
    notes.value = (await api.json("api/notes")).notes;
    words.value = await api.json("api/words");
    library.value = await api.json("api/library");
    countLibrary();
  } catch (error) { say(reasonOf(error)); }
}

/** The store, as soon as the server answers. @param {HTMLElement} place */
async function firstRead(place) {
  for (;;) {
    try { return await api.json("api/store"); } catch (error) { place.textContent = reasonOf(error); }
    await new Promise((done) => setTimeout(done, LOOK));
  }
}

async function begin() {
  const place = /** @type {HTMLElement} */ (document.getElementById("app"));
  store.value = await firstRead(place);
  place.textContent = "";
  render(html`<${App} />`, place);
  followPlace(); // the address may change while it is read
  await readAddress();
  followSelection().catch((error) => say(reasonOf(error)));
  let stamp = "";
  effect(() => { // another state of the store
    const { stamp: now, store: name, other } = store.value;
    if (stamp && stamp !== `${now} ${other?.stamp}`) untracked(forget);
    stamp = `${now} ${other?.stamp}`;
    document.title = `${name} · sgstore`;
    untracked(readRest);
  });
  effect(() => { // the server answers again
    if (!api.returns.value) return;
    untracked(() => {
      retries.value++;
      retry();
      if (!library.value.length) readRest();
      if (answer.value.lost) find({ keep: true });
    });
  });
  addEventListener("online", () => { api.look(); });
  follow();
}

begin();
