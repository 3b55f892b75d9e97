// @ts-check
// Verdicts of checks as a table.
import { h, htm } from "../vendor/core.js";
import { answer } from "./state.js";

const html = htm.bind(h);

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
