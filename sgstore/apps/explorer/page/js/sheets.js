// @ts-check
// Views beside the search: coverage; tables and charts.
import { h, htm, signal, useEffect, useMemo, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { beside } from "./clock.js";
import { again, ask, isLost, openFrame, reasonOf, retries, view } from "./state.js";

const html = htm.bind(h);

// Tables and charts --------------------------------------------------------------------------------------------------

/** A frame by its name: TRACE#SEQ. @param {any} name */
function go(name) {
  const found = /^(.*)#(\d+)$/.exec(String(name));
  if (view.value === "compare") beside.value = true;
  if (found) openFrame(found[1] || "", Number(found[2]));
}

/** A table; columns that hold nothing are left out. @param {{table: any, most?: number}} props */
export function Table({ table, most = 200 }) {
  const columns = table.columns.map((/** @type {string} */ name, /** @type {number} */ at) => {
    const all = table.rows.map((/** @type {any[]} */ row) => row[at]), numbers = all.filter(Number.isFinite), top = Math.max(...numbers.map(Math.abs));
    // As many digits behind the point in all of a column, four that count of the largest.
    const digits = numbers.every(Number.isInteger) ? 0 : Math.min(Math.max(3 - Math.floor(Math.log10(top)), 0), 6);
    return { name, at, digits, number: numbers.length > 0, known: all.some((/** @type {any} */ v) => v !== null && v !== "") };
  }).filter((/** @type {any} */ one) => one.known);
  return html`${(table.said || []).map((/** @type {string} */ line) => html`<p class="faint">${line}</p>`)}
    <table><thead><tr>${columns.map((/** @type {any} */ one) => html`<th class=${one.number ? "number" : ""}>${one.name.replace(/_/g, " ")}</th>`)}</tr></thead><tbody>
    ${table.rows.slice(0, most).map((/** @type {any[]} */ row) => html`<tr>${columns.map((/** @type {any} */ { name, at, digits }) => {
      const v = row[at];
      if (name === "query") return html`<td>${v ? html`<button class="small" onClick=${() => ask(v)}>find</button> <code class="cut" title=${v}>${v}</code>` : ""}</td>`;
      if ((name === "frame" || name === "first") && v) return html`<td><button class="quiet small" onClick=${() => go(v)}>${v}</button></td>`;
      if (name === "class" && String(v).length > 24) return html`<td><code title=${v}>${String(v).slice(0, 12)}</code></td>`;
      if ((name === "share" || name === "cumulative") && typeof v === "number") return html`<td class="number">${(v * 100).toFixed(2)} %</td>`;
      return html`<td class=${typeof v === "number" ? "number" : ""}>${v === null ? "" : typeof v === "number" ? v.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }) : html`<span class="cut" title=${String(v)}>${v}</span>`}</td>`;
    })}</tr>`)}</tbody></table>
    ${table.of > most ? html`<p class="faint">${most} of ${table.of.toLocaleString("en")} rows</p>` : null}`;
}

/** A line chart of columns of a table. @param {{table: any, x: string, lines: string[]}} props */
function Chart({ table, x, lines }) {
  const at = table.columns.indexOf(x), xs = table.rows.map((/** @type {any[]} */ r) => r[at]);
  const all = lines.map((name) => table.rows.map((/** @type {any[]} */ r) => r[table.columns.indexOf(name)]));
  const right = Math.max(...xs, 1), top = Math.max(...all.flat().filter(Number.isFinite), 1);
  const colours = ["var(--accent)", "var(--ego)"], said = (/** @type {number} */ v) => v.toLocaleString("en", { maximumFractionDigits: v < 10 ? 1 : 0 });
  return html`<svg class="chart" viewBox="0 0 900 240" role="img" aria-label=${`${lines.join(" and ")} by ${x}`}>
    ${[0, 0.5, 1].map((s) => html`<line class="axis" x1="50" x2="890" y1=${206 - s * 170} y2=${206 - s * 170} /><text class="axis-text" x="44" y=${210 - s * 170} text-anchor="end">${said(top * s)}</text>
      <text class="axis-text" x=${50 + s * 840} y="221" text-anchor=${s === 1 ? "end" : "middle"}>${said(right * s)}</text>`)}
    ${all.map((ys, k) => html`<polyline class="series" style=${{ stroke: colours[k] }} points=${ys.map((/** @type {number} */ v, /** @type {number} */ i) => `${50 + (xs[i] / right) * 840},${206 - (v / top) * 170}`).join(" ")} />
      <text x=${50 + k * 110} y="18" font-size="12" font-weight="600" fill=${colours[k]}>${(lines[k] || "").replace(/_/g, " ")}</text>`)}
    <text class="axis-text" x="470" y="235" text-anchor="middle">${x}</text></svg>`;
}

/** Something that takes a while: asks once, and says what came of it; what is not looked at any more ends. @param {string} path @param {any} body */
export function useWork(path, body) {
  const [told, tell] = useState(/** @type {any} */ ({})), text = useMemo(() => JSON.stringify(body), [body.clips || JSON.stringify(body)]);
  const asked = `${path}${text} ${again.value} ${retries.value > told.lost ? retries.value : ""}`;
  useEffect(() => {
    const mine = new AbortController(), how = { signal: mine.signal };
    (path === "api/diff" ? api.work(path, body, undefined, how) : api.json(path, body, how).then((found) => { if (found.error) throw new Error(found.error.reason); return found; }))
      .then((found) => tell({ asked, found })).catch((error) => { if (!mine.signal.aborted) tell({ asked, error: reasonOf(error), lost: isLost(error) ? retries.peek() : undefined }); });
    return () => mine.abort();
  }, [asked]);
  return told.asked === asked ? told : {}; // not the answer to what was asked before
}

/** @param {{told: any, children?: any}} props */
export const Waiting = ({ told, children }) => (told.error ? html`<p class="error" role="alert">${told.error}</p>` : !told.found ? html`<p class="faint" role="status">working …</p>` : children(told.found));

// Coverage ---------------------------------------------------------------------------------------------------------------

export const abstraction = signal("RSV");
const what = signal("classes");

export function Coverage() {
  const told = useWork("api/coverage", { what: what.value, abstraction: abstraction.value });
  return html`<div class="sheet" tabindex="0"><div class="row wrap">
      ${[["classes", "Classes by rank"], ["growth", "Growth"], ["combos", "Combinations"]].map(([key, name]) => html`<button aria-pressed=${what.value === key} class=${what.value === key ? "main" : ""} onClick=${() => { what.value = key || ""; }}>${name}</button>`)}
      <label class="row">abstraction <select value=${abstraction.value} onChange=${(/** @type {any} */ e) => { abstraction.value = e.target.value; }}>${["RSV", "ER", "EL", "E", "junction"].map((one) => html`<option>${one}</option>`)}</select></label></div>
    <${Waiting} told=${told}>${(/** @type {any} */ found) => (what.value === "growth" && found.columns
      ? html`<h2>Does more data bring more kinds of scenes?</h2><${Chart} table=${found} x="frames" lines=${["classes", "at_random"]} /><${Table} table=${found} />`
      : found.missing ? html`<h2>Combinations of two features</h2><${Table} table=${found.shares} /><h2>Missing</h2><p class="faint">Each is a query: what it finds would close the gap.</p><${Table} table=${found.missing} /><h2>Covered</h2><${Table} table=${found.covered} />`
      : found.columns ? html`<h2>Classes of scenes, the most frequent first</h2><${Chart} table=${found} x="rank" lines=${["frames"]} /><${Table} table=${found} />` : null)}</${Waiting}></div>`;
}
