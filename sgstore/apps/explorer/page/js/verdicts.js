// @ts-check
// Answers as tables: the rows of a query, and the verdicts of checks.
import { h, htm } from "../vendor/core.js";
import { answer } from "./state.js";

const html = htm.bind(h);

const MOST = 2000; // rows that are shown

export function Rows() {
  const { columns, rows } = answer.value;
  return html`<div class="sheet" tabindex="0"><table><thead><tr>
    ${columns.map((/** @type {string} */ c, /** @type {number} */ i) => html`<th
    class=${rows.some((/** @type {any[]} */ row) => typeof row[i] === "number") ? "number" : ""}>${c}</th>`)}</tr>
    </thead>
    <tbody>${rows.slice(0, MOST).map((/** @type {any[]} */ row) => html`<tr>
      ${row.map((v) => html`<td class=${typeof v === "number" ? "number" : ""}>${shown(v)}</td>`)}</tr>`)}</tbody>
      </table>
    ${rows.length > MOST ? html`<p class="note">${MOST.toLocaleString("en")} of ${rows.length.toLocaleString("en")} rows
      are shown; add LIMIT or a condition</p>` : null}</div>`;
}

/** A value of a row in words. @param {unknown} v */
export const shown = (v) => (v === null ? "" : typeof v === "object" ? JSON.stringify(v) : typeof v === "number"
  && !Number.isInteger(v) ? String(Number(v.toPrecision(7))) : String(v));

export function Verdicts() {
  const told = answer.value.verdicts, more = ["robustness", "reason",
    "absent_frames"].filter((name) => told.some((/** @type {any} */ v) => v[name]));
  return html`<div class="sheet verdicts" tabindex="0"><table><thead><tr><th>check</th><th>trace</th><th>verdict</th>
    <th class="number">violations</th>${more.map((name) => html`<th>${name.replace("_", " ")}</th>`)}</tr></thead>
    <tbody>${told.map((/** @type {any} */ v) => html`<tr><td>${v.check}</td><td>${v.trace}</td>
      <td class=${v.verdict === "true" ? "holds" : v.verdict === "false" ? "fails" : ""}>${v.verdict}</td>
      <td class="number">${v.violations}</td>${more.map((name) => html`<td>${v[name]}</td>`)}</tr>`)}</tbody></table>
      </div>`;
}
