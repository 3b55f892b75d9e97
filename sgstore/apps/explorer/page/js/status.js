// @ts-check
// What was found, in a line: how much, how long it took, who cannot answer.
import { h, htm, useEffect, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { BY_QUERY, ORDERS } from "./order.js";
import { answer, filter, find, framesFound, hidden, isPattern, matches, offline, open, order, sought,
  store, tickAll } from "./state.js";

const html = htm.bind(h);

/** How long something is under way. */
export function Elapsed() {
  const [seconds, tell] = useState(0);
  useEffect(() => {
    const began = performance.now(), tick = setInterval(() => tell(Math.floor((performance.now() - began) / 1000)),
      250);
    return () => clearInterval(tick);
  }, []);
  return html`${seconds} s`;
}

/** The reason of an error, with its place in the query; not again what stands above the page. @param {any} error */
function reasonShown({ reason, start }) {
  if (reason === api.trouble.value) return "not answered yet";
  if (!Number.isInteger(start)) return reason;
  const before = [...answer.value.query].slice(0, start).join(""), line = before.split("\n").length;
  return `line ${line}, column ${start - before.lastIndexOf("\n")}: ${reason}`;
}

/** What RETURN asks for beside the matches, and the way to it. */
function Form() {
  const { state, query, rows, lists, columns, verdicts } = answer.value;
  if (state !== "done" || verdicts || !isPattern(query)) return null;
  if (lists === "values") {
    return html`<span class="note">The table has what RETURN asks for. Without RETURN, the matches are pictures.</span>`;
  }
  if (offline.value) return null;
  return html`${rows || lists === "chosen" || columns[0] === "frame_id" ? null
    : html`<span class="note">The pictures are the matches; the table has the values of RETURN.</span>`}
    <button class="small" onClick=${() => find({ rows: !rows })}>${rows ? "pictures" : "table"}</button>`;
}

/** Close a list that lies over the page: by the Escape key, or when the focus leaves it. @param {Event} event */
function leave(event) {
  const list = /** @type {HTMLDetailsElement} */ (event.currentTarget);
  if (event instanceof KeyboardEvent ? event.key !== "Escape"
    : list.contains(/** @type {Node | null} */ (/** @type {FocusEvent} */ (event).relatedTarget))) return;
  if (list.open) event.stopPropagation();
  list.open = false;
}

export function Status() {
  const told = answer.value, { frames, traces: many } = framesFound.value, found = matches.value.length;
  const left = Object.entries(told.reasons || {});
  if (told.state === "idle" || sought.value.trim()) return null;
  const wordOf = (/** @type {number} */ n) => (told.verdicts ? (n === 1 ? "violation" : "violations")
    : n === 1 ? "match" : "matches");
  const where = filter.value, all = /** @type {import("./state.js").Trace[]} */ (store.value.traces);
  const known = { trace: all.map((t) => t.name), map: [...new Set(all.map((t) => t.map).filter(Boolean))] };
  return html`<div class="status" role="status" aria-live="polite">
    ${told.state === "busy" ? html`<span class="busy" aria-hidden="true"></span>
      <span class="asking">asking … <${Elapsed} key=${told.id} /></span>` : null}
    ${told.error ? html`<div class="error"><b>${reasonShown(told.error)}</b>
      ${told.error.hint && open.value ? html` · ${told.error.hint}` : null}</div>`
      : told.rows ? html`<span><b>${told.rows.length.toLocaleString("en")}</b> rows</span>`
      : html`<span><b>${found.toLocaleString("en")}</b> ${wordOf(found)} in ${many} ${many === 1 ? "trace"
        : "traces"}, ${frames.toLocaleString("en")} frames</span>`}
    ${hidden.value && !told.rows ? html`<span class="note">
      ${hidden.value.toLocaleString("en")} ${wordOf(hidden.value)}${" "}
      in other traces</span><button class="small" onClick=${() => { filter.value = { trace: "", map: "" }; }}>
      show all</button>` : null}
    ${told.ms && !offline.value ? html`<span class="faint">${Math.round(told.ms)} ms</span>` : null}
    ${told.state === "cancelled" ? html`<span class="note">stopped: this is what was found before</span>` : null}
    ${told.truncated ? html`<span class="note">there are more: only the first ${(told.count || told.rows?.length
      || found).toLocaleString("en")} are shown</span>` : null}
    ${(told.notes || []).map((/** @type {string} */ note) => html`<span class="note">${note}</span>`)}
    ${left.length ? html`<details class="why-left" onFocusOut=${leave} onKeyDown=${leave}><summary>
      ${left.length} ${left.length === 1 ? "trace" : "traces"} cannot answer</summary>
      <ul tabindex="0">${left.map(([trace, reason]) => html`<li><b>${trace}</b>: ${reason}</li>`)}</ul></details>` : null}
    <span class="grow"></span>
    ${/** @type {const} */ (["trace", "map"]).map((of) => (known[of].length < 2 ? null
      : html`<select aria-label=${of} value=${where[of]}
      onChange=${(/** @type {{target: HTMLInputElement}} */ e) => { filter.value = { ...where,
      [of]: e.target.value }; }}>
      <option value="">${`all ${of}s`}</option>${known[of].map((one) => html`<option>${one}</option>`)}</select>`))}
    ${found > 1 && !told.rows ? html`<select aria-label="order" value=${order.value}
      onChange=${(/** @type {{target: HTMLInputElement}} */ e) => { order.value = e.target.value; }}>
      ${Object.entries(ORDERS).map(([key, word]) => html`<option value=${key}>${key || told.lists !== "chosen" ? word
        : BY_QUERY}</option>`)}</select>` : null}
    <${Form} />
    ${found && !told.rows && !offline.value ? html`<button class="small"
      onClick=${() => tickAll(matches.value)}>select all</button>` : null}
  </div>`;
}
