// @ts-check
// Views beside the search: coverage; tables and charts.
import { h, htm, signal, useEffect, useMemo, useRef, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { beside } from "./clock.js";
import { wantThumbs } from "./data.js";
import { Thumb } from "./gallery.js";
import { again, ask, frameNamed, isLost, openFrame, reasonOf, retries, view } from "./state.js";
import { Elapsed } from "./status.js";

const html = htm.bind(h);

// Tables and charts --------------------------------------------------------------------------------------------------

/** Open a frame by its name. @param {string} name */
function go(name) {
  const found = frameNamed(name);
  if (view.value === "compare") beside.value = true;
  if (found) openFrame(...found);
}

/** Words for columns of coverage. @type {Record<string, string>} */
const HEADS = { class: "kind of scene", classes: "kinds of scenes", new_per_1000: "new per 1,000 frames",
  at_random: "kinds in random order" };

/** @param {string} name */
const headOf = (name) => HEADS[name] || name.replace(/_/g, " ");

/** A table; columns that hold nothing are left out. @param {{table: any, most?: number}} props */
export function Table({ table, most = 200 }) {
  const columns = table.columns.map((/** @type {string} */ name, /** @type {number} */ at) => {
    const all = table.rows.map((/** @type {any[]} */ row) => row[at]), numbers = all.filter(Number.isFinite),
      top = Math.max(...numbers.map(Math.abs));
    // As many digits behind the point in all of a column, four that count of the largest.
    const digits = numbers.every(Number.isInteger) ? 0 : Math.min(Math.max(3 - Math.floor(Math.log10(top)), 0), 6);
    return { name, at, digits, number: numbers.length > 0, known: all.some((/** @type {any} */ v) => v !== null
      && v !== "") };
  }).filter((/** @type {any} */ one) => one.known);
  return html`${(table.said || []).map((/** @type {string} */ line) => html`<p class="faint">${line}</p>`)}
    <table><thead><tr>${columns.map((/** @type {any} */ one) => html`<th class=${one.number ? "number" : ""}>
      ${headOf(one.name)}</th>`)}</tr></thead><tbody>
    ${table.rows.slice(0, most).map((/** @type {any[]} */ row, /** @type {number} */ i) => html`<tr>
      ${columns.map((/** @type {any} */ { name, at, digits }) => {
      const v = row[at];
      if (name === "query") return html`<td>${v ? html`<button class="small"
        onClick=${() => ask(v)}>find</button> <code class="cut" title=${v}>${v}</code>` : ""}</td>`;
      if ((name === "frame" || name === "first") && v) return html`<td>
        <button class="quiet small" onClick=${() => go(v)}>${v}</button></td>`;
      if (name === "class" && table.words?.[i]) return html`<td title=${`class ${v} of ${abstraction.value}`}>
        ${table.words[i].replace(/_/g, " ")}</td>`;
      if (name === "class" && String(v).length > 24) return html`<td><code title=${v}>${String(v).slice(0, 12)}</code>
        </td>`;
      if ((name === "share" || name === "cumulative") && typeof v === "number") return html`<td class="number">
        ${(v * 100).toFixed(2)} %</td>`;
      return html`<td class=${typeof v === "number" ? "number" : ""}>
        ${v === null ? "" : typeof v === "number" ? v.toLocaleString("en",
        { minimumFractionDigits: digits, maximumFractionDigits: digits })
        : html`<span class="cut" title=${String(v)}>${v}</span>`}</td>`;
    })}</tr>`)}</tbody></table>
    ${table.of > most ? html`<p class="faint">${most} of ${table.of.toLocaleString("en")} rows</p>` : null}`;
}

/** Whether the window is that of a phone. */
const phone = matchMedia("(max-width: 520px)"), narrow = signal(phone.matches);
phone.addEventListener("change", () => { narrow.value = phone.matches; });

/** Whether axes are logarithmic. */
const logarithmic = signal(true);

/** Round numbers of an axis. @param {number} low @param {number} high @param {boolean} log */
function ticksOf(low, high, log) {
  if (!log) return [0, 0.25, 0.5, 0.75, 1].map((s) => low + (high - low) * s);
  const found = [];
  for (let power = Math.ceil(Math.log10(low)); 10 ** power <= high; power++) found.push(10 ** power);
  return found.length > 1 ? found : [low, high];
}

/** A line chart of columns of a table, with linear or logarithmic axes.
 * @param {{table: any, x: string, lines: string[]}} props */
function Chart({ table, x, lines }) {
  const log = logarithmic.value,
    column = (/** @type {string} */ name) => table.rows.map((/** @type {any[]} */ row) => row[table.columns.indexOf(name)]);
  const xs = column(x), all = lines.map(column), positive = all.flat().filter((v) => Number.isFinite(v) && v > 0);
  const right = Math.max(...xs, 1), top = Math.max(...positive, 1), left = log ? Math.max(Math.min(...xs), 1) : 0,
    low = log ? Math.min(...positive, 1) : 0;
  const scale = (/** @type {number} */ v, /** @type {number} */ from,
    /** @type {number} */ to) => (log ? Math.log(Math.max(v, from) / from) / Math.log(to / from || 1)
    : (v - from) / (to - from)) || 0;
  const wide = narrow.value ? 430 : 900; // so that its text can be read
  const px = (/** @type {number} */ v) => 56 + scale(v, left, right) * (wide - 70),
    py = (/** @type {number} */ v) => 206 - scale(v, low, top) * 170;
  const colours = ["var(--accent)", "var(--ego)"], said = (/** @type {number} */ v) => v.toLocaleString("en",
    { maximumFractionDigits: v < 10 ? 1 : 0 });
  return html`<label class="row"><input type="checkbox" checked=${log}
    onChange=${() => { logarithmic.value = !log; }} /> logarithmic axes</label>
    <svg class="chart" viewBox=${`0 0 ${wide} 246`} role="img"
      aria-label=${`${lines.map(headOf).join(" and ")} by ${x}, ${log
      ? "logarithmic" : "linear"} axes`}>
    ${ticksOf(low, top, log).map((v) => html`<line class="axis" x1="56" x2=${wide - 14} y1=${py(v)} y2=${py(v)} />
      <text class="axis-text" x="50" y=${py(v) + 4} text-anchor="end">${said(v)}</text>`)}
    ${ticksOf(left, right, log).map((v) => html`<text class="axis-text" x=${px(v)} y="224" text-anchor="middle">
      ${said(v)}</text>`)}
    ${all.map((ys, k) => html`<polyline class="series" style=${{ stroke: colours[k] }}
      points=${ys.map((/** @type {number} */ v, /** @type {number} */ i) => `${px(xs[i])},${py(v)}`).join(" ")} />
      <text x=${56 + k * 150} y="18" font-size="12" font-weight="600" fill=${colours[k]}>
        ${headOf(lines[k] || "")}</text>`)}
    <text class="axis-text" x=${wide / 2 + 20} y="242" text-anchor="middle">${x}</text></svg>`;
}

/** Something that takes a while: asks once, and says what came of it; what is not looked at any more ends.
 * @param {string} path @param {any} body */
export function useWork(path, body) {
  const [told, tell] = useState(/** @type {any} */ ({})), text = useMemo(() => JSON.stringify(body),
    [body.clips || JSON.stringify(body)]);
  const asked = `${path}${text} ${again.value} ${retries.value > told.lost ? retries.value : ""}`;
  const ending = useRef(() => {}), [begun, begin] = useState(0);
  useEffect(() => {
    const mine = new AbortController(), how = { signal: mine.signal };
    ending.current = () => mine.abort();
    (path === "api/diff" ? api.work(path, body, undefined, how)
      : api.json(path, body,
      how).then((found) => { if (found.error) throw new Error(found.error.reason); return found; }))
      .then((found) => tell({ asked, found })).catch((error) => { if (!mine.signal.aborted) tell({ asked,
        error: reasonOf(error), lost: isLost(error) ? retries.peek() : undefined }); });
    return () => mine.abort();
  }, [asked, begun]);
  const [off, setOff] = useState(""), stop = () => { ending.current(); setOff(asked); }; // what the user stopped
  if (told.asked === asked) return told;
  return off === asked ? { stopped: true, start: () => { setOff(""); begin((n) => n + 1); } }
    : { stop }; // not the answer to what was asked before
}

/** What stands in the place of an answer while it is under way. @param {{told: any, children?: any}} props */
export function Waiting({ told, children }) {
  if (told.error && told.error !== api.trouble.value) return html`<p class="error" role="alert">${told.error}</p>`;
  if (told.stopped) return html`<p class="row">stopped <button onClick=${told.start}>start again</button></p>`;
  if (told.found) return children(told.found);
  return html`<p class="row faint" role="status"><span class="busy" aria-hidden="true">
    </span> working … <${Elapsed} />
    ${told.stop ? html`<button onClick=${told.stop}>Stop</button>` : null}</p>`;
}

// Coverage ---------------------------------------------------------------------------------------------------------------

export const abstraction = signal("RSV");
const what = signal("classes");

const TABS = [["classes", "Kinds of scenes"], ["growth", "Growth"], ["matrix", "Matrix of gaps"],
  ["combos", "Combinations"]];
/** What scenes of one kind have in common: the name of the abstraction, and words. */
const ABSTRACTIONS = [["RSV", "objects, their relations and lanes"], ["ER", "objects and their relations"],
  ["EL", "objects and their lanes"], ["E", "objects"], ["junction", "objects, relations and all lanes of the place"]];

export function Coverage() {
  const told = useWork("api/coverage", { what: what.value, abstraction: abstraction.value });
  return html`<div class="sheet" tabindex="0"><div class="row wrap">
      ${TABS.map(([key, name]) => html`<button aria-pressed=${what.value === key}
        class=${what.value === key ? "main" : ""}
        onClick=${() => { what.value = key || ""; }}>${name}</button>`)}
      <label class="row">Scenes of one kind have the same <select value=${abstraction.value}
        onChange=${(/** @type {{target: HTMLInputElement}} */ e) => { abstraction.value = e.target.value; }}>
        ${ABSTRACTIONS.map(([name, words]) => html`<option value=${name}>${words} (${name})</option>`)}</select>
      </label></div>
    <${Waiting} told=${told}>${covered}</${Waiting}></div>`;
}

/** What was found, by its form. @param {any} found */
function covered(found) {
  if (found.names) return html`<${Matrix} found=${found} />`;
  if (found.missing) {
    return html`<h2>Combinations of two features</h2>
      <p class="faint">A feature is a fact of a frame, such as: car directly ahead of the ego.</p>
      <${Table} table=${found.shares} /><h2>Missing</h2>
      <p class="faint">Each is a query: what it finds would close the gap.</p><${Table} table=${found.missing} />
      <h2>Covered</h2><${Table} table=${found.covered} />`;
  }
  if (!found.words) {
    return html`<h2>Does more data bring more kinds of scenes?</h2>
      <${Chart} table=${found} x="frames" lines=${["classes", "at_random"]} /><${Table} table=${found} />`;
  }
  return html`<h2>Kinds of scenes, the most frequent first</h2>
    <${Chart} table=${found} x="rank" lines=${["frames"]} />
    <p class="faint">The words name the objects near the ego, and the lanes and junctions that the ego is in.
      Objects farther away are not named.</p>
    <${Classes} found=${found} /><${Table} table=${found} />`;
}

const CARDS = 60;

/** Kinds of scenes with a picture of their first frame, and in words. @param {{found: any}} props */
function Classes({ found }) {
  const rows = found.rows.slice(0, CARDS);
  useEffect(() => wantThumbs(rows.flatMap((/** @type {any[]} */ row) => {
    const one = frameNamed(row[5]);
    return one ? [one] : [];
  })), [found]);
  return html`<div class="cards classes">${rows.map((/** @type {any[]} */ [rank, code, frames, share, , frame],
    /** @type {number} */ i) => {
    const [trace, seq] = frameNamed(frame) || ["", 0];
    return html`<button class="card" key=${frame} title=${`class ${code} of ${abstraction.value}`}
      onClick=${() => go(frame)}><${Thumb} trace=${trace} frame=${seq} />
      <h3>${rank}. <span class="grow"></span><span class="faint">
        ${frames.toLocaleString("en")} frames, ${(share * 100).toFixed(1)} %</span></h3>
      <p>${found.words[i].replace(/_/g, " ")}</p></button>`;
  })}</div>`;
}

/** How often two features are in the same frame; a gap is its query.
 * @param {{found: {words: string[], frames: number[][], queries: Record<string, string>}}} props */
function Matrix({ found: { words: names, frames, queries } }) {
  const size = 17, left = 12 + 6.2 * Math.min(42, Math.max(...names.map((name) => name.length)));
  const most = Math.max(...frames.flat(), 1), gaps = Object.keys(queries).length;
  const [at, point] = useState(/** @type {[number, number] | null} */ (null));
  const cells = names.flatMap((_, i) => names.slice(0, i + 1).map((_, j) => {
    const many = frames[i]?.[j] || 0, query = queries[`${j} ${i}`],
      place = { x: left + j * size, y: 4 + i * size, width: size - 1, height: size - 1 };
    const on = { onPointerEnter: () => point([i, j]), onFocus: () => point([i, j]) };
    if (many) return html`<rect ...${place} ...${on} fill="var(--accent)"
      opacity=${(0.12 + 0.88 * (Math.log(many + 1) / Math.log(most + 1))).toFixed(3)} />`;
    return html`<rect ...${place} ...${on} class="gap-cell" role="button" tabindex="0"
      aria-label=${`${names[j]} with ${names[i]}: in no frame`}
      onClick=${() => query && ask(query)} onKeyDown=${(/** @type {KeyboardEvent} */ e) => { if (e.key === "Enter"
        && query) ask(query); }} />`;
  }));
  const told = at ? html`<b>${names[at[1]]}</b> with <b>${names[at[0]]}</b>: ${(frames[at[0]]?.[at[1]]
    || 0).toLocaleString("en")} frames` : "point at a cell";
  if (!names.length) return html`<p class="faint">The objects alone have no relations to the ego: choose another entry
    above.</p>`;
  return html`<h2>Pairs of features: ${gaps} ${gaps === 1 ? "gap" : "gaps"}</h2>
    <p class="faint">Each cell is a pair of the most frequent features: facts of a frame, relative to the ego.
      A strong colour means many frames.
      No frame has the pair of a red cell; click it for its query.</p>
    <p role="status">${told}</p>
    <div class="matrix" tabindex="0"><svg width=${left + names.length * size + 4} height=${names.length * size + 8}
      role="group" aria-label="Matrix of gaps">
      ${names.map((name, i) => html`<text class="axis-text" x=${left - 6} y=${16 + i * size} text-anchor="end">
        ${name.slice(0, 42)}</text>`)}${cells}</svg></div>`;
}
