// @ts-check
// The whole trace in time: matches, a lane for each part of the pattern, tags, values; drag to go there.
import { computed, effect, h, htm, signal, useRef, useState } from "../vendor/core.js";
import { frame, goTo, holdsAt, lanes, range, series } from "./clock.js";
import { arrived, seconds, seqAt, timeAt } from "./data.js";
import { allHold, common, written } from "./lanes.js";
import { answer, dialog, keyOf, lit, live, matches, notes, offline, open, playing, tagged, traces } from "./state.js";

const html = htm.bind(h);

/** Frames of the timeline that are in sight; null: all of them. */
const zoomed = signal(/** @type {[number, number] | null} */ (null));
/** Frames that the user marked: first and last; null: none. */
const brush = signal(/** @type {[number, number] | null} */ (null));
const shown = computed(() => zoomed.value || range.value);
effect(() => { open.value?.trace; zoomed.value = brush.value = null; });
effect(() => { // what plays stays in sight
  const at = frame.value, window = zoomed.peek();
  if (!window || (at >= window[0] && at <= window[1])) return;
  const wide = window[1] - window[0], [low, high] = range.peek(),
    from = Math.max(low, Math.min(high - wide, at < window[0] ? at - wide : at));
  zoomed.value = [from, from + wide];
});

/** Show less or more of the trace, around a frame. @param {number} factor @param {number} [around] */
function zoomBy(factor, around = frame.value) {
  const [low, high] = range.value, [from, to] = shown.value,
    wide = Math.min(Math.max((to - from) * factor, 10), high - low);
  const begin = Math.max(low, Math.min(high - wide, around - (around - from) * (wide / Math.max(to - from, 1))));
  zoomed.value = wide >= high - low ? null : [Math.round(begin), Math.round(begin + wide)];
}

/** Show the whole trace. */
const zoomOut = () => { zoomed.value = null; };

/** Mark frames from the one that is shown. @param {number} by */
function extendBrush(by) {
  const at = frame.value, now = brush.value || [at, at], fixed = now[0] === at ? now[1] : now[0];
  goTo(at + by);
  brush.value = [Math.min(fixed, frame.value), Math.max(fixed, frame.value)];
}

/** Keys of the timeline. @type {[string, string, Record<string, (event: KeyboardEvent) => void>][]} */
export const timelineKeys = [
  ["+ −", "less or more of the timeline", { "+": () => zoomBy(0.5), "-": () => zoomBy(2) }],
  ["0", "the whole trace", { 0: zoomOut }],
  ["Shift ← →", "mark frames, to zoom in or to tag them", {
    ArrowLeft: (e) => { if (e.shiftKey) extendBrush(-1); else goTo(frame.value - 1); },
    ArrowRight: (e) => { if (e.shiftKey) extendBrush(1); else goTo(frame.value + 1); },
  }],
];

/** The frame at a place of a bar. @param {MouseEvent} e */
function frameAt(e) {
  const box = /** @type {Element} */ (e.currentTarget).getBoundingClientRect(), [from, to] = shown.value;
  return Math.max(from, Math.min(to, from + Math.floor(((e.clientX - box.left) / box.width) * (to - from + 1))));
}

/** Drag goes there, and marks frames with the shift key; the wheel zooms. */
function useDrag() {
  const from = useRef(/** @type {number | null} */ (null)), marks = useRef(false);
  const at = (/** @type {PointerEvent} */ e) => {
    const here = frameAt(e), begun = from.current ?? here;
    if (marks.current) brush.value = [Math.min(begun, here), Math.max(begun, here)]; else goTo(here);
  };
  return {
    onPointerDown: (/** @type {PointerEvent} */ e) => {
      from.current = frameAt(e);
      marks.current = e.shiftKey;
      playing.value = false;
      /** @type {Element} */ (e.currentTarget).setPointerCapture(e.pointerId);
      at(e);
    },
    onPointerMove: (/** @type {PointerEvent} */ e) => { if (from.current !== null) at(e); },
    onPointerUp: () => { from.current = null; },
    onWheel: (/** @type {WheelEvent} */ e) => {
      if (!e.ctrlKey && !e.shiftKey) return; // scrolls the lanes
      e.preventDefault();
      zoomBy(Math.exp((e.deltaY || e.deltaX) / 300), frameAt(e));
    },
  };
}

/** What all bars have: the frames that are marked, and the one that is shown. @param {{height: number}} props */
function Over({ height }) {
  const marked = brush.value, at = frame.value + 0.5;
  return html`${marked ? html`<rect class="brush" x=${marked[0]} y="0" width=${marked[1] - marked[0] + 1}
    height=${height} />` : null}
    <line class="cursor" x1=${at} x2=${at} y1="0" y2=${height} vector-effect="non-scaling-stroke" />`;
}

/** @param {{spans: number[][], kind: (i: number) => string, height?: number}} props */
export function Bars({ spans, kind, height = 21 }) {
  const [from, to] = shown.value, frames = to - from + 1, least = frames / 500, drag = useDrag();
  return html`<svg viewBox=${`${from} 0 ${frames} ${height}`} preserveAspectRatio="none" aria-hidden="true"
    ...${drag}>
    <rect class="bar-back" x=${from} y="4" width=${frames} height=${height - 8} />
    ${spans.map(([a = 0, z = 0], i) => (z < from || a > to ? null
      : html`<rect class=${kind(i)} x=${a} y="4" width=${Math.max(z - a + 1, least)} height=${height - 8} />`))}
    <${Over} height=${height} /></svg>`;
}

const HIGH = 84, CURVES = ["var(--accent)", "var(--ego)", "var(--hold)", "var(--code-key)", "var(--fail)",
  "var(--faint)"];
/** Limits that the user set, by attribute. */
const limits = signal(/** @type {Record<string, string>} */ ({}));

/** The limit of an attribute: what the user set, or the number that the query compares it with.
 * @param {string} attribute */
function limitOf(attribute) {
  const set = limits.value[attribute];
  if (set !== undefined) return set === "" ? NaN : Number(set);
  const found = new RegExp(`\\b${attribute === "distance" ? "dist"
    : attribute}(?:\\([^)]*\\))?\\s*[<>]=?\\s*(-?\\d+(?:\\.\\d+)?)`).exec(answer.value.query || "");
  return found ? Number(found[1]) : NaN;
}

/** Curves of one attribute, with their axis and a limit.
 * @param {{attribute: string, curves: import("./clock.js").Curve[]}} props */
function Series({ attribute, curves }) {
  const [from, to] = shown.value, limit = limitOf(attribute), unit = curves[0]?.unit || "", drag = useDrag();
  let low = Number.isFinite(limit) ? limit : Infinity, high = Number.isFinite(limit) ? limit : -Infinity;
  for (const { columns } of curves) for (const v of columns.value) if (Number.isFinite(v)) { low = Math.min(low,
    v); high = Math.max(high, v); }
  const known = Number.isFinite(low);
  if (high === low) { high += 1; low -= 1; }
  const y = (/** @type {number} */ v) => (HIGH - 6 - ((v - low) / (high - low)) * (HIGH - 14)).toFixed(2);
  const drawn = curves.map(({ columns, label }) => {
    let path = "", pen = false, now = NaN;
    columns.value.forEach((/** @type {number} */ v, /** @type {number} */ i) => {
      const at = columns.seq[i];
      if (at === frame.value || (live.value && at < frame.value)) now = v; // of a monitor the last that came
      if (!Number.isFinite(v)) { pen = false; return; }
      path += `${pen ? "L" : "M"}${at} ${y(v)}`;
      pen = true;
    });
    return { path, now, label };
  });
  const digits = Math.abs(high - low) < 5 ? 2 : 1;
  return html`<div class="lane tall"><div class="label">${drawn.map(({ label, now }, k) => html`<div title=${label}>
    <i style=${{ background: CURVES[k % 6] }}></i>
        <b>${Number.isFinite(now) ? `${now.toFixed(2)} ${unit}` : "–"}</b> ${label}${" "}
        <button class="quiet small" aria-label=${`Remove ${label}`}
          onClick=${() => { series.value = series.value.filter((one) => one.label !== label); }}>×</button></div>`)}
      <label>limit <input size="5" inputmode="decimal" aria-label=${`Limit of ${attribute}`}
        value=${Number.isFinite(limit) ? limit : ""}
        onInput=${(/** @type {InputEvent} */ e) => { limits.value = { ...limits.value,
          [attribute]: /** @type {HTMLInputElement} */ (e.target).value }; }} /></label></div>
    <div class="axis-box">${known ? html`<span class="axis-high">${high.toFixed(digits)} ${unit}</span>
      <span class="axis-low">${low.toFixed(digits)}</span>` : html`<span class="axis-high">never known</span>`}
      <svg viewBox=${`${from} 0 ${to - from + 1} ${HIGH}`} preserveAspectRatio="none" aria-hidden="true" ...${drag}>
      ${[y(high), y(low)].map((at) => html`<line class="axis" x1=${from} x2=${to + 1} y1=${at} y2=${at}
        vector-effect="non-scaling-stroke" />`)}
      ${Number.isFinite(limit) ? html`<line class="limit" x1=${from} x2=${to + 1} y1=${y(limit)} y2=${y(limit)}
        vector-effect="non-scaling-stroke" />` : null}
      ${drawn.map(({ path }, k) => html`<path class="series" d=${path} style=${{ stroke: CURVES[k % 6] }}
        vector-effect="non-scaling-stroke" />`)}
      <${Over} height=${HIGH} /></svg></div></div>`;
}

/** What can be done with the frames that are marked, and with the part of the trace in sight. */
function Marked() {
  const marked = brush.value, trace = open.value?.trace || "", part = zoomed.value;
  const tagThem = () => { if (marked) { tagged.value = { trace, first: marked[0],
    last: marked[1] }; dialog.value = "tag"; } };
  return html`<div class="marked">
    <button class="small" aria-label="Less of the timeline" title="less of the timeline (+)"
      onClick=${() => zoomBy(0.5)}>+</button>
    <button class="small" aria-label="More of the timeline" title="more of the timeline (−)"
      onClick=${() => zoomBy(2)} disabled=${!part}>−</button>
    ${part ? html`<button class="small" onClick=${zoomOut}>whole trace</button>` : null}
    ${marked ? html`<span class="faint">#${marked[0]}–${marked[1]}</span> <button class="small"
      onClick=${() => { zoomed.value = [marked[0], Math.max(marked[1],
      marked[0] + 10)]; brush.value = null; }}>zoom in</button>
      ${offline.value ? null : html`<button class="small" onClick=${tagThem}>tag</button>`} <button class="small"
        aria-label="Unmark" onClick=${() => { brush.value = null; }}>×</button>` : null}</div>`;
}

/** Tags of a trace as runs of frames. @param {any[][]} all @param {string} trace */
export function runsOfTags(all, trace) {
  /** @type {{tag: string, note: string, who: string, first: number, last: number}[]} */
  const runs = [], ends = new Map();
  for (const [, seq, tag, note, who] of all.filter((n) => n[0] === trace).sort((a, b) => a[1] - b[1])) {
    const before = ends.get(`${tag}\n${note}`);
    if (before && before.last + 1 >= seq) { before.last = seq; continue; }
    const one = { tag, note, who, first: seq, last: seq };
    ends.set(`${tag}\n${note}`, one);
    runs.push(one);
  }
  return runs;
}

/** The lane of a part as written; that of a word of the library opens to the lanes of its meaning.
 * @param {{part: import("./lanes.js").Written, all: import("./lanes.js").Lane[], holds: (boolean | null)[],
 *   steps: boolean}} props */
function Part({ part, all, holds, steps }) {
  const [isOpen, turn] = useState(false), bound = open.value?.binding || {}, lanes = part.of.flatMap((at) => all[at] || []);
  const row = (/** @type {typeof lanes} */ some, /** @type {string} */ text, /** @type {boolean | null} */ now,
    /** @type {any} */ before) => {
    const nodes = some.flatMap((lane) => Object.keys(lane.nodes)).flatMap((key) => bound[key] ?? []);
    const unknown = some.flatMap((lane) => lane.unknown);
    return html`<div class="lane" data-holds=${String(now)} onMouseEnter=${() => { lit.value = new Set(nodes); }}
      onMouseLeave=${() => { lit.value = new Set(); }}>
      <div class="label mono" title=${unknown.length ? `nothing is known of ${unknown.join(", ")}` : text}>
        <span class=${`now ${now ? "holds" : "fails"}`}>${now === null ? "?" : now ? "✓" : "✗"}</span>${before}${text}
        </div><${Bars} spans=${common(some.map((lane) => lane.spans))} kind=${() => "bar-hold"} /></div>`;
  };
  const step = steps ? `${part.step}. ` : "", now = allHold(part.of.map((at) => holds[at]));
  if (lanes.length < 2) return row(lanes, part.text, now, step);
  return html`${row(lanes, part.text, now, html`${step}<button class="quiet small opener" aria-expanded=${isOpen}
    aria-label=${`Parts of ${part.text}`} onClick=${() => turn(!isOpen)}>${isOpen ? "▾" : "▸"}</button>`)}
    ${isOpen ? part.of.map((at) => row([all[at]].flatMap((one) => one || []),
      all[at]?.text || "", holds[at] ?? null, html`<span class="inner"></span>`)) : null}`;
}

export function Timeline() {
  const now = open.value, about = traces.value.get(now?.trace || "");
  if (!now || !about) return null;
  const [from, to] = shown.value, frames = to - from + 1, mine = matches.value.filter((m) => m.trace === now.trace);
  const tags = runsOfTags(notes.value, now.trace), holds = holdsAt(frame.value),
    word = live.value ? "event" : answer.value.verdicts ? "violation" : "match";
  const words = mine.length === 1 ? word : word === "match" ? "matches" : `${word}s`;
  const all = lanes.value?.lanes || [], steps = new Set(all.map((/** @type {any} */ l) => l.step)).size > 1;
  const first = [...mine].sort((a, b) => Number(a.index === now.match?.index) - Number(b.index === now.match?.index));
  const [begun, end] = arrived.value >= 0 ? [timeAt(now.trace, from), timeAt(now.trace, to)] : [0, 0];
  const every = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((s) => (end - begun) / s < 9) || 5000;
  const low = Math.ceil(begun / every - 1e-6), many = Math.max(Math.floor(end / every + 1e-6) - low + 1, 0) || 0;
  const ticks = [...Array(many).keys()].map((i) => (low + i) * every);
  return html`<div class="timeline" role="group" aria-label="Timeline" tabindex="0">
    <div class="lane"><div class="label">${mine.length} ${words} <span class="faint">in this trace</span></div>
      <${Bars} spans=${first.map((m) => [m.first, m.last])}
        kind=${(/** @type {number} */ i) => (first[i] && now.match && keyOf(first[i]) === keyOf(now.match)
          ? "bar-match" : "bar-match other")} /></div>
    ${written(all).map((one) => html`<${Part} key=${`${one.step} ${one.of[0]}`} part=${one} all=${all} holds=${holds}
      steps=${steps} />`)}
    ${tags.length ? html`<div class="lane"><div class="label">
      ${tags.length} ${tags.length === 1 ? "tag" : "tags"}</div>
      <${Bars} spans=${tags.map((n) => [n.first, Math.max(n.last, n.first + frames / 200)])}
      kind=${() => "bar-tag"} /></div>` : null}
    ${[...new Set(series.value.map((one) => one.attribute))].map((name) => html`<${Series} key=${name}
      attribute=${name} curves=${series.value.filter((one) => one.attribute === name)} />`)}
    <div class="lane"><${Marked} /><div class="ticks" role="slider" tabindex="0" aria-label="Frame"
      aria-valuemin=${range.value[0]} aria-valuemax=${range.value[1]}
        aria-valuenow=${frame.value}
        aria-valuetext=${`frame ${frame.value}, ${seconds(timeAt(now.trace, frame.value))} s`}
        onKeyDown=${(/** @type {KeyboardEvent} */ e) => { const to = { Home: range.value[0],
          End: range.value[1] }[e.key]; if (to !== undefined) { e.preventDefault(); goTo(to); } }}>
      ${ticks.map((t) => html`<span style=${{ left: `${(100 * (seqAt(now.trace, t) - from + 0.5)) / frames}%` }}>
        ${Number(t.toFixed(1))} s</span>`)}</div></div>
  </div>`;
}
