// @ts-check
// The matches as small pictures, grouped by trace; only what is in sight is there.
import { h, htm, useEffect, useLayoutEffect, useMemo, useRef, useState } from "../vendor/core.js";
import { arrived, mapOf, stillOf, thumbOf, wantThumbs } from "./data.js";
import { fitted, lookAt, paintScene } from "./draw.js";
import { keyOf, notes, offline, open, openMatch, paints, tick, ticked, traces } from "./state.js";

const html = htm.bind(h);
const GAP = 12, HEAD = 32;
const REST = 100; // ms without a jump, after which what flew past stands

/** What the matches before and behind are grouped by. @param {import("./state.js").Match | undefined} match */
const groupOf = (match) => match?.group ?? match?.trace ?? "";

/** Where everything stands: groups and rows, by their heights.
 * @param {import("./state.js").Match[]} found @param {number} width */
function layout(found, width) {
  const across = Math.max(1, Math.floor((width - GAP) / 214)), wide = (width - GAP) / across - GAP, high = Math.round(wide * 0.62) + 27;
  const rows = [];
  let top = 4, at = 0;
  while (at < found.length) {
    const group = groupOf(found[at]);
    let end = at;
    while (end < found.length && groupOf(found[end]) === group) end++;
    rows.push({ top, height: HEAD, group, many: end - at, first: at, last: at });
    top += HEAD;
    for (let i = at; i < end; i += across) {
      rows.push({ top, height: high + GAP, group: "", many: 0, first: i, last: Math.min(i + across, end) });
      top += high + GAP;
    }
    top += 6;
    at = end;
  }
  return { rows, height: top, across, wide, high };
}

/** @param {{match: import("./state.js").Match, x: number, y: number, wide: number, high: number, flies: boolean}} props */
function Tile({ match, x, y, wide, high, flies }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const painted = useRef("");
  const waits = arrived.value, look = paints.value;
  useLayoutEffect(() => {
    const thumb = thumbOf(match.trace, match.first), about = traces.value.get(match.trace);
    const map = mapOf(match.trace), still = stillOf(match.trace);
    // What stands and moves first, the map when it has come.
    const key = `${keyOf(match)} ${!!thumb} ${!!map} ${!!still} ${wide} ${look} ${flies}`, ctx = canvas.current?.getContext("2d");
    if (!canvas.current || !ctx || painted.current === key) return;
    painted.current = key;
    if (!thumb?.columns || !about || flies) { // what it showed was another match: it is not seen, which costs least
      delete canvas.current.dataset.painted;
      return;
    }
    const { width, height, ratio } = fitted(canvas.current), nodes = Object.values(match.binding);
    paintScene(ctx, match.trace, thumb, lookAt(match.trace, thumb, nodes, width, height, 45), ratio,
      { marked: new Set(nodes), lit: new Set(), small: true });
    canvas.current.dataset.painted = "1";
  }, [match, wide, waits, look, flies]);
  const isOpen = open.value?.match && keyOf(open.value.match) === keyOf(match), on = ticked.value.has(keyOf(match));
  const tags = notes.value.filter((n) => n[0] === match.trace && n[1] >= match.first && n[1] <= match.last);
  const who = Object.entries(match.names).filter(([name]) => name !== "e" && name !== "ego").map(([, v]) => v).join(", ");
  return html`<div class=${`tile ${isOpen ? "chosen" : ""}`} style=${{ left: `${x}px`, top: `${y}px`, width: `${wide}px`, height: `${high}px` }}
      data-index=${match.index} onClick=${match.go || (() => openMatch(match))}>
    <canvas ref=${canvas} aria-hidden="true"></canvas>
    <div class="about">
      ${offline.value || match.go ? null : html`<input type="checkbox" checked=${on} aria-label=${`Select ${match.trace} ${match.start.toFixed(1)} s`}
        onClick=${(/** @type {any} */ event) => { event.stopPropagation(); tick(match); }} />`}
      <button class="quiet small" aria-label=${`Open ${match.trace}, ${match.start.toFixed(1)}–${match.end.toFixed(1)} s`}>${match.start.toFixed(1) === match.end.toFixed(1) ? "" : `${match.start.toFixed(1)}–`}${match.end.toFixed(1)} s</button>
      ${tags.map((n) => html`<span class="tag">${n[2]}</span>`)}<span class="who" title=${who}>${who}</span>
    </div></div>`;
}

/** @param {{found: import("./state.js").Match[], none?: string, word?: [string, string]}} props */
export function Gallery({ found, none, word = ["match", "matches"] }) {
  const place = useRef(/** @type {HTMLElement | null} */ (null));
  const [box, setBox] = useState({ width: 900, height: 600, top: 0 });
  const measure = () => {
    const seen = place.current;
    if (seen) setBox({ width: seen.clientWidth, height: seen.clientHeight, top: seen.scrollTop });
  };
  useEffect(() => {
    const watch = new ResizeObserver(measure);
    if (place.current) watch.observe(place.current);
    return () => watch.disconnect();
  }, []);
  // Of thousands of matches it is made once, not while it is scrolled.
  const { rows, height, wide, high } = useMemo(() => layout(found, box.width), [found, box.width]);
  const low = Math.max(0, rows.findIndex((row) => row.top + row.height >= box.top - 200)), end = box.top + box.height + 200;
  // As many rows each time: what leaves the sight lends its elements to what comes, for to make new ones takes most of the time.
  const most = useRef(0), was = useRef(0), jumped = useRef(false);
  const seen = rows.slice(low).filter((row, i) => i < most.current || row.top < end);
  most.current = Math.max(most.current, seen.length);
  // Of a jump the pictures are asked for at once; of what goes on flying past none, until it rests.
  const jumps = Math.abs(box.top - was.current) > high, flies = jumps && jumped.current;
  useEffect(() => {
    was.current = box.top;
    jumped.current = jumps;
    if (!flies) wantThumbs(seen.flatMap((row) => found.slice(row.first, row.last).map((m) => /** @type {[string, number]} */ ([m.trace, m.first]))));
    if (!jumps) return undefined;
    const rest = setTimeout(() => setBox((one) => ({ ...one })), REST); // then all of it stands in its order
    return () => clearTimeout(rest);
  });
  const drawn = seen.map((row, at) => ({ row, slot: (low + at) % most.current }));
  if (jumps) drawn.sort((a, b) => a.slot - b.slot);
  const now = open.value?.match;
  useEffect(() => { // what is open comes into sight
    if (!now || !place.current) return;
    const row = rows.find((one) => !one.group && found.slice(one.first, one.last).some((m) => keyOf(m) === keyOf(now)));
    if (row && (row.top < box.top || row.top + row.height > box.top + box.height)) place.current.scrollTop = row.top - box.height / 3;
  }, [now]);
  return html`<section class="gallery" ref=${place} onScroll=${measure} aria-label="Matches"><div class="inner" style=${{ height: `${height}px` }}>
    ${found.length || !none ? null : html`<p class="faint none">${none}</p>`}
    ${drawn.map(({ row, slot }) => (row.group
      ? html`<div class="group" key=${`g ${slot}`} style=${{ top: `${row.top}px` }}>${row.group} <span>${row.many} ${row.many === 1 ? word[0] : word[1]}</span></div>`
      : found.slice(row.first, row.last).map((match, i) => html`<${Tile} key=${`${slot} ${i}`} match=${match} wide=${wide} high=${high} flies=${flies}
          x=${GAP + i * (wide + GAP)} y=${row.top} />`)))}
  </div></section>`;
}
