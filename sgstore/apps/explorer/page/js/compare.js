// @ts-check
// Two queries, or two stores: what differs as small pictures, and as tables.
import { computed, h, htm, signal, useEffect, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { beside } from "./clock.js";
import { Gallery } from "./gallery.js";
import { abstraction, Table, useWork } from "./sheets.js";
import {
  again, find, frameNamed, inOther, isPattern, matchesIn, openFrame, parametersOf, reasonOf, say, second, side, store,
    text, traces,
} from "./state.js";

const html = htm.bind(h);
const MOST = 2000; // tiles of what differs

const shown = signal("tiles");
const other = computed(() => second.value.trim() || text.value.trim());
const inB = computed(() => side.value || (store.value?.other ? "b" : "a"));

/** @typedef {import("./state.js").Match} Match */
/** @typedef {Map<string, {frames: Set<number>, matches: Match[]}>} Found */

/** Frames that a query finds, by trace. @param {string} query @param {string} of @param {AbortSignal} signal
 * @returns {Promise<Found>} */
async function framesOf(query, of, signal) {
  /** @type {Found} */
  const by = new Map(),
    more = (/** @type {number} */ many) => {
      const told = `There are more than ${many.toLocaleString("en")} matches`;
      throw new Error(`${told}, and only whole answers can be compared: add a condition.`);
    };
  for await (const match of matchesIn(api.lines("api/find",
    { text: query, parameters: parametersOf(query), side: of }, { signal }), more)) {
    const one = by.get(match.trace) || { frames: new Set(), matches: [] };
    by.set(match.trace, one);
    one.matches.push(match);
    for (let at = match.first; at <= match.last; at++) one.frames.add(at);
  }
  return by;
}

/** Open a frame that differs, in the store that has it, and ask the query that finds it. @param {string} trace
 * @param {number} at @param {string} query */
async function go(trace, at, query) {
  if (!traces.value.has(trace)) { say(`only the second store has ${trace}`); return; }
  text.value = query;
  await find();
  beside.value = !!store.value.other;
  openFrame(trace, at);
}

/** Stretches of frames that one finds and the other does not, as matches. @param {Found} a @param {Found} b
 * @param {string} of @param {string} word @param {string} query */
function onlyIn(a, b, of, word, query) {
  /** @type {Match[]} */
  const tiles = [];
  for (const [name, { frames, matches }] of a) {
    const not = b.get(name)?.frames;
    /** @type {[number, number][]} */
    const runs = [];
    for (const at of [...frames].filter((one) => !not?.has(one)).sort((x, y) => x - y)) {
      const last = runs[runs.length - 1];
      if (last && last[1] === at - 1) last[1] = at; else runs.push([at, at]);
    }
    for (const [first, last] of runs) {
      const found = matches.find((m) => m.first <= first && first <= m.last), whole = found?.first === first
        && found.last === last; // a whole match has the times of the answer, part of one those of its frames
      tiles.push({
        trace: of === "b" ? inOther(name) : name, first, last,
        start: whole ? found.start : NaN, end: whole ? found.end : NaN, binding: found?.binding || {},
        names: found?.names || {}, values: {}, index: `${word} ${name} ${first}`, group: `${name} · only in ${word}`,
        go: () => go(name, first, query),
      });
    }
  }
  return tiles;
}

/** Scenes that one store has alone, as matches. @param {any} table */
function scenesOf(table) {
  return table.rows.flatMap((/** @type {any[]} */ [change, name, inA, ofB, frame], /** @type {number} */ i) => {
    const found = frameNamed(frame), b = change !== "vanished";
    if (!found || change === "changed") return [];
    const [trace, first] = found, frames = `${inA || ofB} frames of ${name.slice(0, 8)}`;
    return [{
      trace: b ? inOther(trace) : trace, first, last: first, start: NaN, end: NaN, binding: {}, names: { frames },
      values: {}, index: `scene ${i}`, group: `Scenes that only ${b ? "B" : "A"} has`,
      go: () => go(trace, first, text.value.trim()),
    }];
  });
}

export function Compare() {
  const [found, tell] = useState(/** @type {any} */ (null)), [wrong, fail] = useState("");
  const a = text.value.trim(), b = other.value, of = inB.value, both = store.value.other,
    same = a === b && of === "a";
  useEffect(() => {
    const mine = new AbortController();
    tell(null);
    fail("");
    if (same || !isPattern(a)) return undefined;
    Promise.all([framesOf(a, "a", mine.signal), framesOf(b, of, mine.signal)])
      .then(([one, two]) => { if (!mine.signal.aborted) tell({ a: one,
        b: two }); }).catch((error) => { if (!mine.signal.aborted) fail(reasonOf(error)); });
    return () => mine.abort();
  }, [a, b, of, again.value]);
  const submit = (/** @type {any} */ event) => {
    event.preventDefault();
    second.value = new FormData(event.target).get("second")?.toString().trim() || "";
  };
  return html`<section class="compare" aria-label="Compare"><form class="sheet row wrap" onSubmit=${submit}>
      <span><b>A</b> ${store.value.store}</span> <code class="cut" title=${a}>
        ${a || "no query yet: type one under Find"}</code>
      <b>B</b>
      ${both ? html`<select aria-label="Store of B" value=${of}
        onChange=${(/** @type {{target: HTMLInputElement}} */ e) => { side.value = e.target.value; }}>
        <option value="b">${both.store}</option><option value="a">${store.value.store}</option></select>`
        : html`<span>${store.value.store}</span>`}
      <input name="second" class="query" aria-label="Query of B" defaultValue=${second.value}
        placeholder="the same query, or another one" /><button>Compare</button>
      <span role="group" aria-label="Form"><button type="button" aria-pressed=${shown.value === "tiles"}
        onClick=${() => { shown.value = "tiles"; }}>Tiles</button> <button type="button"
        aria-pressed=${shown.value === "tables"} onClick=${() => { shown.value = "tables"; }}>Tables</button></span>
        </form>
    ${wrong ? html`<p class="sheet error" role="alert">${wrong}</p>` : null}
    ${both ? html`<${OfStores} found=${found} />` : same || !found
      ? html`<div class="sheet"><p class="faint" role="status">
      ${!a ? "Type a query under Find; then another one for B here, or start sgstore serve with --compare OTHER."
      : same ? "Type another query for B, "
        + "or start sgstore serve with --compare OTHER to see two stores side by side." : "working …"}</p></div>`
      : html`<${Differing} found=${found} />`}</section>`;
}

/** @param {{found: any}} props */
function OfStores({ found }) {
  const told = useWork("api/diff", { abstraction: abstraction.value });
  return html`${told.error ? html`<p class="sheet error" role="alert">${told.error}</p>` : null}<${Differing}
    found=${found} diff=${told.found} waits=${!told.found && !told.error} />`;
}

/** @param {{found: any, diff?: any, waits?: boolean}} props */
function Differing({ found, diff, waits }) {
  const tiles = found ? [...onlyIn(found.a, found.b, "a", "A", text.value.trim()),
    ...onlyIn(found.b, found.a, inB.value, "B", other.value)] : [];
  const scenes = diff ? scenesOf(diff.scenes) : [], all = [...tiles, ...scenes];
  const many = (/** @type {Found} */ one) => [...one.values()].reduce((n, { frames }) => n + frames.size, 0);
  const only = (/** @type {string} */ word) => tiles.filter((t) => t.group?.endsWith(`only in ${word}`)).reduce((n,
    t) => n + t.last - t.first + 1, 0);
  return html`<div class="status" role="status">${found ? html`<span><b>
    ${many(found.a).toLocaleString("en")}</b> frames in A, <b>
    ${many(found.b).toLocaleString("en")}</b> in B; only in A <b>${only("A").toLocaleString("en")}</b>, only in B <b>
    ${only("B").toLocaleString("en")}</b></span>` : null}
      ${diff ? html`<span class="faint">${diff.scenes.said[0]}</span>` : waits
        ? html`<span class="faint">scenes are compared …</span>` : null}${all.length > MOST
        ? html`<span class="note">the first ${MOST.toLocaleString("en")} of
          ${" "}${all.length.toLocaleString("en")} pictures</span>` : null}</div>
    ${shown.value === "tiles" ? html`<main>${all.length ? html`<${Gallery} found=${all.slice(0, MOST)}
      word=${["stretch", "stretches"]} />` : waits ? null : html`<div class="sheet"><h2>Nothing differs</h2>
      <p class="faint">${found ? "Both find the same frames."
      : "Both have the same scenes. A query under Find is compared, too."}</p></div>`}</main>`
      : html`<div class="sheet" tabindex="0">${found ? html`<h2>Matches of the query</h2>
        <${ByTrace} found=${found} />` : null}
        ${diff ? html`<h2>Scenes</h2><${Table} table=${diff.scenes} /><h2>Frame by frame</h2>
          <${Table} table=${diff.frames} />` : null}</div>`}`;
}

/** @param {{found: {a: Found, b: Found}}} props */
function ByTrace({ found }) {
  const names = [...new Set([...found.a.keys(), ...found.b.keys()])].sort(), none = new Set();
  return html`<table><thead><tr><th>trace</th><th class="number">frames in A</th><th class="number">in B</th>
    <th class="number">only in A</th><th class="number">only in B</th><th>first that differs</th></tr></thead><tbody>
    ${names.map((name) => {
      const a = found.a.get(name)?.frames || none, b = found.b.get(name)?.frames || none;
      const odd = [...a].filter((s) => !b.has(s)), even = [...b].filter((s) => !a.has(s)),
        first = Math.min(...odd, ...even);
      return html`<tr><td>${name}</td><td class="number">${a.size}</td><td class="number">${b.size}</td>
        <td class="number">${odd.length}</td><td class="number">${even.length}</td><td>
        ${Number.isFinite(first) ? html`<button class="quiet small"
        onClick=${() => go(name, first, odd.includes(first) ? text.value.trim() : other.value)}>
        ${name}#${first}</button>` : "the same"}</td></tr>`;
    })}</tbody></table>`;
}
