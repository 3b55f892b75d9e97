// @ts-check
// The whole trace in time: matches, a lane for each part of the pattern, tags, values; drag to go there.
import { h, htm, useRef } from "../vendor/core.js";
import { frame, goTo, holdsAt, lanes, range, series } from "./clock.js";
import { arrived, seqAt, timeAt } from "./data.js";
import { answer, keyOf, lit, live, matches, notes, open, playing, traces } from "./state.js";

const html = htm.bind(h);

/** @param {{spans: number[][], kind: (i: number) => string, height?: number}} props */
export function Bars({ spans, kind, height = 21 }) {
  const [from, to] = range.value, frames = to - from + 1;
  const drag = useRef(false);
  const at = (/** @type {any} */ e) => {
    const box = e.currentTarget.getBoundingClientRect();
    goTo(from + Math.round(((e.clientX - box.left) / box.width) * (frames - 1)));
  };
  const least = frames / 500;
  return html`<svg viewBox=${`${from} 0 ${frames} ${height}`} preserveAspectRatio="none" aria-hidden="true"
      onPointerDown=${(/** @type {any} */ e) => { drag.current = true; playing.value = false; e.currentTarget.setPointerCapture(e.pointerId); at(e); }}
      onPointerMove=${(/** @type {any} */ e) => { if (drag.current) at(e); }} onPointerUp=${() => { drag.current = false; }}>
    <rect class="bar-back" x=${from} y="4" width=${frames} height=${height - 8} />
    ${spans.map(([a, z], i) => html`<rect class=${kind(i)} x=${a} y="4" width=${Math.max((z || 0) - (a || 0) + 1, least)} height=${height - 8} />`)}
    <line class="cursor" x1=${frame.value + 0.5} x2=${frame.value + 0.5} y1="0" y2=${height} vector-effect="non-scaling-stroke" /></svg>`;
}

function Series() {
  const { columns, label, unit } = series.value, [from, to] = range.value;
  let low = Infinity, high = -Infinity;
  for (const v of columns.value) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  if (high === low) { high += 1; low -= 1; }
  let path = "", pen = false, now = NaN;
  columns.value.forEach((/** @type {number} */ v, /** @type {number} */ i) => {
    if (columns.seq[i] === frame.value || (live.value && columns.seq[i] < frame.value)) now = v; // of a monitor the last that came
    if (!Number.isFinite(v)) { pen = false; return; }
    path += `${pen ? "L" : "M"}${columns.seq[i]} ${(48 - ((v - low) / (high - low)) * 42).toFixed(2)}`;
    pen = true;
  });
  return html`<div class="lane tall"><div class="label" title=${label}>${label}<br /><b>${Number.isFinite(now) ? `${now.toFixed(2)} ${unit}` : "–"}</b>
      <span class="faint"> ${Number.isFinite(low) ? `${low.toFixed(1)} … ${high.toFixed(1)}` : "never known"}</span></div>
    <svg viewBox=${`${from} 0 ${to - from + 1} 54`} preserveAspectRatio="none" aria-hidden="true"><path class="series" d=${path} vector-effect="non-scaling-stroke" />
      <line class="cursor" x1=${frame.value + 0.5} x2=${frame.value + 0.5} y1="0" y2="54" vector-effect="non-scaling-stroke" /></svg></div>`;
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

export function Timeline() {
  const now = open.value, about = traces.value.get(now?.trace || "");
  if (!now || !about) return null;
  const [from, to] = range.value, frames = to - from + 1, mine = matches.value.filter((m) => m.trace === now.trace);
  const tags = runsOfTags(notes.value, now.trace), holds = holdsAt(frame.value), word = live.value ? "event" : answer.value.verdicts ? "violation" : "match";
  const all = lanes.value?.lanes || [], steps = new Set(all.map((/** @type {any} */ l) => l.step)).size > 1;
  const first = [...mine].sort((a, b) => Number(a.index === now.match?.index) - Number(b.index === now.match?.index));
  const [begun, end] = arrived.value >= 0 ? [timeAt(now.trace, from), timeAt(now.trace, to)] : [0, 0];
  const every = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((s) => (end - begun) / s < 9) || 5000;
  const low = Math.ceil(begun / every - 1e-6), many = Math.max(Math.floor(end / every + 1e-6) - low + 1, 0) || 0;
  const ticks = [...Array(many).keys()].map((i) => (low + i) * every);
  return html`<div class="timeline" role="group" aria-label="Timeline" tabindex="0">
    <div class="lane"><div class="label">${mine.length} ${word}${mine.length === 1 ? "" : word === "match" ? "es" : "s"} <span class="faint">in this trace</span></div>
      <${Bars} spans=${first.map((m) => [m.first, m.last])}
        kind=${(/** @type {number} */ i) => (first[i] && now.match && keyOf(first[i]) === keyOf(now.match) ? "bar-match" : "bar-match other")} /></div>
    ${all.map((/** @type {any} */ lane, /** @type {number} */ i) => {
      const nodes = Object.keys(lane.nodes).map((key) => now.binding?.[key]).filter((n) => n !== undefined);
      return html`<div class="lane" key=${i} data-holds=${String(holds[i])} onMouseEnter=${() => { lit.value = new Set(/** @type {number[]} */ (nodes)); }} onMouseLeave=${() => { lit.value = new Set(); }}>
        <div class="label mono" title=${lane.unknown.length ? `nothing is known of ${lane.unknown.join(", ")}` : lane.text}><span class=${`now ${holds[i] ? "holds" : "fails"}`}>${holds[i] === null ? "?" : holds[i] ? "✓" : "✗"}</span>${steps ? `${lane.step}. ` : ""}${lane.text}</div>
        <${Bars} spans=${lane.spans} kind=${() => "bar-hold"} /></div>`;
    })}
    ${tags.length ? html`<div class="lane"><div class="label">${tags.length} ${tags.length === 1 ? "tag" : "tags"}</div><${Bars} spans=${tags.map((n) => [n.first, Math.max(n.last, n.first + frames / 200)])} kind=${() => "bar-tag"} /></div>` : null}
    ${series.value ? html`<${Series} />` : null}
    <div class="lane"><div class="label"></div><div class="ticks">
      ${ticks.map((t) => html`<span style=${{ left: `${(100 * (seqAt(now.trace, t) - from + 0.5)) / frames}%` }}>${Number(t.toFixed(1))} s</span>`)}</div></div>
  </div>`;
}
