// @ts-check
// The matches as small pictures, grouped by trace; only what is in sight is there.
import { h, htm, useEffect, useLayoutEffect, useMemo, useRef, useState } from "../vendor/core.js";
import { arrived, mapOf, seconds, stillOf, thumbOf, timesOf, wantThumbs } from "./data.js";
import { fitted, lookAt, paintScene } from "./draw.js";
import { shown } from "./verdicts.js";
import { BY_QUERY, merged, ORDERS } from "./order.js";
import { answer, dialog, keyOf, notes, offline, open, openMatch, order, paints, tagged, tick, ticked,
  traces } from "./state.js";

const html = htm.bind(h);
const GAP = 12, HEAD = 32;
const REST = 100; // ms without a jump, after which what flew past stands

/** What the matches before and behind are grouped by. @param {import("./state.js").Match | undefined} match */
const groupOf = (match) => match?.group ?? (order.value ? ORDERS[order.value] : isOrdered() ? BY_QUERY
  : match?.trace) ?? "";
/** True if the query itself orders or chooses its matches. */
const isOrdered = () => answer.value.lists === "chosen";

/** Where everything stands: groups and rows, by their heights.
 * @param {import("./state.js").Match[]} found @param {number} width */
export function layout(found, width) {
  const across = Math.max(1, Math.floor((width - GAP) / Math.max(214, width / 8))), wide = (width - GAP) / across - GAP,
    high = Math.round(wide * 0.62) + 27;
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

/** Index of the match that an arrow key leads to.
 * @param {ReturnType<typeof layout>["rows"]} rows @param {number} at @param {string} key
 * @param {number} page rows in sight */
export function moved(rows, at, key, page) {
  const lines = rows.filter((row) => !row.group), line = lines.findIndex((row) => at < row.last),
    last = (lines.at(-1)?.last || 1) - 1;
  const here = lines[line], down = { ArrowUp: -1, ArrowDown: 1, PageUp: -page, PageDown: page }[key];
  if (key === "Home" || key === "End") return key === "Home" ? 0 : last;
  if (key === "ArrowLeft" || key === "ArrowRight") return Math.max(0,
    Math.min(last, at + (key === "ArrowLeft" ? -1 : 1)));
  const to = down && here ? lines[Math.max(0, Math.min(lines.length - 1, line + down))] : undefined;
  return to && here ? Math.min(to.first + at - here.first, to.last - 1) : null;
}

/** @param {{match: import("./state.js").Match, at: number, x: number, y: number, wide: number, high: number,
 *   flies: boolean, turn: boolean, many: number}} props */
function Tile({ match, at, x, y, wide, high, flies, turn, many }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const painted = useRef("");
  const waits = arrived.value, look = paints.value;
  useLayoutEffect(() => {
    const thumb = thumbOf(match.trace, match.first), about = traces.value.get(match.trace);
    const map = mapOf(match.trace), still = stillOf(match.trace);
    // What stands and moves first, the map when it has come.
    const key = `${keyOf(match)} ${!!thumb} ${!!map} ${!!still} ${wide} ${look} ${flies}`,
      ctx = canvas.current?.getContext("2d");
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
  const [start, end] = timesOf(match).map((t) => seconds(t, 1)), when = start === end ? end : `${start}–${end}`;
  const isOpen = open.value?.match && keyOf(open.value.match) === keyOf(match), on = ticked.value.has(keyOf(match));
  const tags = notes.value.filter((n) => n[0] === match.trace && n[1] >= match.first && n[1] <= match.last);
  const who = Object.entries(match.names).filter(([name]) => name !== "e"
    && name !== "ego").map(([, v]) => v).concat(Object.entries(match.values).filter(([, v]) => typeof v !== "object")
    .map(([name, v]) => `${name} ${shown(v)}`)).join(", ");
  return html`<div class=${`tile ${isOpen ? "chosen" : ""}`}
    style=${{ left: `${x}px`, top: `${y}px`, width: `${wide}px`, height: `${high}px` }}
      data-index=${match.index} data-at=${at} onClick=${match.go || (() => openMatch(match))}>
    <canvas ref=${canvas} aria-hidden="true"></canvas>
    <div class="about">
      ${offline.value || match.go ? null : html`<input type="checkbox" checked=${on} tabindex=${turn ? 0 : -1}
        aria-label=${`Select ${match.trace} ${start} s`}
        onClick=${(/** @type {any} */ event) => { event.stopPropagation(); tick(match); }} />`}
      <button class="quiet small" tabindex=${turn ? 0 : -1} aria-label=${`Open ${match.trace}, ${start}–${end} s`}>
        ${when} s</button>
      ${many > 1 ? html`<span class="faint" title="matches with the same nodes in another order">×${many}</span>`
        : null}
      ${[...new Set(tags.map((n) => n[2]))].map((one) => html`<span class="tag">${one}</span>`)}
      ${offline.value || match.go ? null : html`<button class="quiet small tagger" tabindex=${turn ? 0 : -1}
        title="tag this match" aria-label=${`Tag ${match.trace} ${start} s`}
        onClick=${(/** @type {Event} */ event) => { event.stopPropagation(); tagged.value = { trace: match.trace,
          first: match.first, last: match.last }; dialog.value = "tag"; }}>+ tag</button>`}
      ${order.value || (isOrdered() && !match.group) ? html`<span class="faint">${match.trace}</span>` : null}
      <span class="who" title=${who}>
        ${who}</span>
    </div></div>`;
}

/** A small picture of a frame, which was asked for. @param {{trace: string, frame: number}} props */
export function Thumb({ trace, frame }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  arrived.value; paints.value;
  useLayoutEffect(() => {
    const thumb = thumbOf(trace, frame), ctx = canvas.current?.getContext("2d");
    if (!canvas.current || !ctx || !thumb?.columns) return;
    mapOf(trace); stillOf(trace); // asked for
    const { width, height, ratio } = fitted(canvas.current);
    paintScene(ctx, trace, thumb, lookAt(trace, thumb, [], width, height, 45), ratio,
      { marked: new Set(), lit: new Set(), small: true });
  });
  return html`<canvas ref=${canvas} class="thumb" aria-hidden="true"></canvas>`;
}

/** @param {{found: import("./state.js").Match[], none?: string, word?: [string, string]}} props */
export function Gallery({ found: all, none, word = ["match", "matches"] }) {
  const { shown: found, many } = useMemo(() => merged(all), [all]);
  const place = useRef(/** @type {HTMLElement | null} */ (null));
  const [box, setBox] = useState({ width: 900, height: 600, top: 0 });
  const measure = () => {
    const seen = place.current;
    if (seen) setBox({ width: seen.clientWidth, height: seen.clientHeight, top: seen.scrollTop });
  };
  // The rows there are drawn at once, not after the scroll event: the focus has its tile before the next key.
  const scrollTo = (/** @type {number} */ top) => {
    if (place.current) place.current.scrollTop = top;
    measure();
  };
  useEffect(() => {
    const watch = new ResizeObserver(measure);
    if (place.current) watch.observe(place.current);
    return () => watch.disconnect();
  }, []);
  // Of thousands of matches it is made once, not while it is scrolled.
  const { rows, height, wide, high } = useMemo(() => layout(found, box.width), [found, box.width, order.value,
    isOrdered()]);
  const low = Math.max(0, rows.findIndex((row) => row.top + row.height >= box.top - 200)),
    end = box.top + box.height + 200;
  // As many rows each time: rows out of sight lend their elements to new ones, which would take most of the time.
  const most = useRef(0), was = useRef(0), jumped = useRef(false);
  const seen = rows.slice(low).filter((row, i) => i < most.current || row.top < end);
  most.current = Math.max(most.current, seen.length);
  // Of a jump the pictures are asked for at once; of what goes on flying past none, until it rests.
  const jumps = Math.abs(box.top - was.current) > high, flies = jumps && jumped.current;
  useEffect(() => {
    was.current = box.top;
    jumped.current = jumps;
    if (!flies) wantThumbs(seen.flatMap((row) => found.slice(row.first,
      row.last).map((m) => /** @type {[string, number]} */ ([m.trace, m.first]))));
    if (!jumps) return undefined;
    const rest = setTimeout(() => setBox((one) => ({ ...one })), REST); // then all of it stands in its order
    return () => clearTimeout(rest);
  });
  const drawn = seen.map((row, at) => ({ row, slot: (low + at) % most.current }));
  if (jumps) drawn.sort((a, b) => a.slot - b.slot);
  const now = open.value?.match;
  useEffect(() => { // what is open comes into sight, and stays there when the rows get another width
    if (!now || !place.current) return;
    const row = rows.find((one) => !one.group && found.slice(one.first,
      one.last).some((m) => keyOf(m) === keyOf(now)));
    if (row && (row.top < box.top
      || row.top + row.height > box.top + box.height)) scrollTo(row.top - box.height / 3);
  }, [now, box.width]);
  // One tile is in the order of the Tab key. It keeps the focus, though its elements show other matches after scrolling.
  const [active, setActive] = useState(0), held = useRef("");
  const turn = Math.min(active, found.length - 1), visible = drawn.some(({ row }) => !row.group && row.first <= turn
    && turn < row.last);
  const patching = useRef(true); // an element that is moved or removed loses the focus
  patching.current = true;
  useLayoutEffect(() => {
    patching.current = false;
    if (!held.current) return;
    const want = place.current?.querySelector(`[data-at="${turn}"] ${held.current}`) || place.current;
    if (want !== document.activeElement) /** @type {HTMLElement} */ (want).focus({ preventScroll: true });
  });
  useEffect(() => { if (now) setActive(Math.max(0, found.findIndex((m) => keyOf(m) === keyOf(now)))); }, [now]);
  const wasOpen = useRef(false), isOpen = open.value !== null;
  useEffect(() => {
    if (wasOpen.current && !isOpen
      && document.activeElement === document.body) { held.current = "button"; measure(); }
    wasOpen.current = isOpen;
  }, [isOpen]);
  const onFocus = (/** @type {FocusEvent} */ event) => {
    const at = /** @type {HTMLElement} */ (event.target),
      tile = /** @type {HTMLElement | null} */ (at.closest("[data-at]"));
    if (tile) { held.current = at.localName + (at.classList.contains("tagger") ? ".tagger"
      : ""); setActive(Number(tile.dataset.at)); }
  };
  const onBlur = (/** @type {FocusEvent} */ event) => {
    if (!patching.current
      && !place.current?.contains(/** @type {Node | null} */ (event.relatedTarget))) held.current = "";
  };
  const onKey = (/** @type {KeyboardEvent} */ event) => {
    const to = moved(rows, turn, event.key, Math.max(1, Math.floor(box.height / (high + GAP)))), match = found[turn];
    const opens = event.key === "Enter" && !/** @type {HTMLElement} */ (event.target).closest("button"),
      ticks = event.key === "x" && !match?.go && !offline.value;
    if (to === null && !opens && !ticks) return;
    event.preventDefault();
    event.stopPropagation();
    if (to === null) { if (match) (ticks ? tick : match.go || openMatch)(match); return; }
    held.current ||= "button";
    setActive(to);
    const row = rows.find((one) => !one.group && to < one.last), seen = place.current;
    if (!row || !seen) return;
    const below = row.top + row.height - seen.clientHeight;
    scrollTo(Math.max(Math.min(seen.scrollTop, row.top - HEAD), below));
  };
  return html`<section class="gallery" ref=${place} onScroll=${measure} aria-label="Matches"
    tabindex=${visible ? -1 : 0} onKeyDown=${onKey}
      onFocusIn=${onFocus} onFocusOut=${onBlur}>
    <div class="inner" style=${{ height: `${height}px` }}>
    ${found.length || !none ? null : html`<p class="faint none">${none}</p>`}
    ${drawn.map(({ row, slot }) => (row.group
      ? html`<div class="group" key=${`g ${slot}`} style=${{ top: `${row.top}px` }}>${row.group} <span>
        ${row.many} ${row.many === 1 ? word[0] : word[1]}</span></div>`
      : found.slice(row.first, row.last).map((match, i) => html`<${Tile} key=${`${slot} ${i}`} match=${match}
        many=${many.get(match.index) || 1} at=${row.first + i} turn=${row.first + i === turn} wide=${wide}
        high=${high} flies=${flies}
          x=${GAP + i * (wide + GAP)} y=${row.top} />`)))}
  </div></section>`;
}
