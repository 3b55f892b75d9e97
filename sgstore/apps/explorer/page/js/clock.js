// @ts-check
// One clock over all that is open: the frame, whether it plays, and what the server says of it.
import { batch, computed, effect, signal, untracked } from "../vendor/core.js";
import * as api from "./api.js";
import { nameOf, seqAt, stillOf, timeAt } from "./data.js";
import {
  again, answer, following, inOther, isPattern, isLost, live, matches, offline, open, openMatch, parametersOf, playing,
  rate, reasonOf, say, seq, span, retries, store, text, traces,
} from "./state.js";

/** Lanes of truth of what is open: answers of the server. */
export const lanes = signal(/** @type {any} */ (null));
export const why = signal(/** @type {any} */ (null));
export const camera = signal("");
export const panel = signal("pattern");
/** Whether the second store is shown beside the first, by the same clock. */
export const beside = signal(false);
/** An attribute over time. */
/** @typedef {{path: string, attribute: string, unit: string, node: number, other: number | undefined, label: string,
 *   auto: boolean, columns: Record<string, any>}} Curve */
export const series = signal(/** @type {Curve[]} */ ([]));

export const frame = computed(() => Math.round(seq.value));
export const asked = computed(() => answer.value.query || text.value.trim());

/** The trace that is open. */
export const about = computed(() => traces.value.get(open.value?.trace || ""));
/** First and last frame of the timeline: of the trace; of a monitor of what is kept. */
export const range = computed(/** @returns {[number, number]} */ () => (
  live.value ? span.value : [0, (about.value?.frames || 1) - 1]));

/** First and last frame that can be shown: of the timeline; in a report of what it holds around the match. */
const bounds = computed(/** @returns {[number, number]} */ () => {
  const [first, last] = range.value, match = open.value?.match;
  if (live.value || !offline.value || !match) return [first, last];
  const { trace } = match, around = store.value.around + 1e-6; // times have six decimals
  const low = Math.ceil(seqAt(trace, timeAt(trace, match.first) - around));
  const high = Math.floor(seqAt(trace, timeAt(trace, match.last) + around));
  return Number.isFinite(low) ? [low, high] : [match.first, match.last];
});

/** Which parts hold now, by lane; of a monitor whose last frames were not looked at yet, in the last that was.
 * @param {number} now @param {any} [of] */
export function holdsAt(now, of = lanes.value) {
  const at = Math.min(now, of?.known?.[1] ?? now), gone = of?.known && now < of.known[0];
  return (of?.lanes || []).map((/** @type {any} */ lane) => (lane.unknown.length || gone ? null
    : lane.spans.some((/** @type {number[]} */ [a, z]) => (a ?? 0) <= at && at <= (z ?? 0))));
}

/** What the server is asked for the lanes of what is open; null: there are none.
 * @param {NonNullable<typeof open.value>} now @param {string} query @returns {any} */
function lanesWanted(now, query) {
  if (live.value) return now.match?.pattern ? { text: now.match.pattern, binding: now.binding } : null;
  if (!isPattern(query)) return null;
  const parameters = parametersOf(query), at = Math.round(seq.peek());
  return { text: query, parameters, trace: now.trace, seq: at, binding: now.binding };
}

/** Ask for the lanes and for the curve again, of a monitor that goes on. */
export async function refresh() {
  const now = open.value, body = now && lanesWanted(now, ""), curves = series.value;
  const found = body && (await api.json("api/parts", body).catch(() => null));
  if (found && open.value === now) {
    batch(() => {
      const known = measured.value;
      if (known?.of === lanes.value) measured.value = known && { ...known, of: found };
      lanes.value = found;
    });
  }
  if (!curves.length) return;
  const more = await Promise.all(curves.map(async (one) => ({ ...one,
    columns: (await api.columns(one.path)).columns }))).catch(() => null);
  if (more && series.value === curves) series.value = more;
}

let answered = /** @type {any} */ (null), missed = false, tried = 0;
// Lanes are asked for when another match is opened, not when their answer said which nodes are bound.
effect(() => {
  const now = open.value, query = asked.value, retried = retries.value !== tried;
  again.value;
  tried = retries.value;
  if ((retried && !missed) || (now && now === answered)) return;
  missed = false;
  lanes.value = why.value = null;
  series.value = [];
  const body = now && lanesWanted(now, query), current = () => open.value === now && asked.value === query;
  if (!body) return;
  api.json("api/parts", body).then((found) => {
    if (!current()) return;
    if (found.error?.reason) say(`no lanes: ${found.error.reason}`);
    if (found.error) return;
    lanes.value = found;
    if (!now.binding && Object.keys(found.binding).length) open.value = answered = { ...now, binding: found.binding };
  }).catch((error) => {
    if (!current()) return;
    missed = isLost(error);
    say(reasonOf(error));
  });
});

/** Values in the conditions of what is open, at a frame: by lane and condition. They come while nothing plays.
 * @typedef {{name: string, value: number | string | null, unit: string}} Measured */
export const measured = signal(/** @type {{of: any, at: number, values: Measured[][][]} | null} */ (null));
let measuring = false;

/** Ask for the values of the frame that is shown: one request at a time, the next one for the frame of then. */
async function measure() {
  const of = lanes.peek(), at = frame.peek(), now = open.peek(), known = measured.peek();
  if (known?.of === of && known?.at === at) return;
  if (measuring || playing.peek() || following.peek() || (offline.peek() && !live.peek()) || !now || !of) return;
  const body = lanesWanted(now, asked.peek());
  if (!body || !of.lanes.some((/** @type {any} */ lane) => lane.conditions.length)) return;
  measuring = true;
  try {
    const found = await api.json("api/values", { ...body, seq: at, binding: of.binding });
    if (found.error) say(`no values: ${found.error.reason}`);
    measured.value = { of, at, values: found.values || [] };
  } catch (error) {
    say(reasonOf(error));
    if (!isLost(error)) measured.value = { of, at, values: [] };
  }
  measuring = false;
  if (lanes.peek() !== of || frame.peek() !== at) measure();
}
effect(() => {
  lanes.value; frame.value; playing.value; following.value; retries.value;
  untracked(measure);
});

/** Lanes of the same match in the second store, while that is shown beside. */
export const others = signal(/** @type {any} */ (null));
effect(() => {
  const now = open.value, query = asked.value, other = inOther(now?.trace || "");
  again.value;
  others.value = null;
  if (!now || !beside.value || !traces.value.has(other)) return;
  const wanted = lanesWanted(now, query);
  if (!wanted) return;
  api.json("api/parts", { ...wanted, binding: sameIn(other, now), side: "b" }).then((found) => {
    if (open.value !== now) return;
    if (found.error) say(`no lanes of the second store: ${found.error.reason}`); else others.value = found;
  }).catch((error) => say(reasonOf(error)));
});

/** The nodes of a match in the second store, by the ids that the simulator gave them; null: not all are known there.
 * @param {string} other @param {NonNullable<typeof open.value>} now */
function sameIn(other, now) {
  const here = stillOf(now.trace)?.header.names, there = stillOf(other)?.header.names;
  const sameMap = traces.value.get(other)?.map_key === traces.value.get(now.trace)?.map_key;
  if (!here || !there || !now.binding) return null;
  const ids = new Map(Object.entries(there).map(([node, about]) => [about[1], Number(node)]));
  const same = (/** @type {number} */ node) => (here[node]?.[1] ? ids.get(here[node][1]) : undefined);
  const found = Object.entries(now.binding).map(([key, node]) => [key,
    node >= 0 ? same(node) : sameMap ? node : undefined]);
  return found.every(([, node]) => node !== undefined) ? Object.fromEntries(found) : null;
}

// The first camera of a trace, unless one was chosen that it has.
effect(() => {
  const cameras = about.value?.cameras || [];
  if (!cameras.includes(camera.peek())) camera.value = cameras[0] || "";
});

export async function askWhy() {
  const now = open.value, query = live.value ? now?.match?.pattern : asked.value;
  if (!now || !query) return;
  try {
    why.value = { at: frame.value, ...(await api.json("api/why", {
      text: query, parameters: parametersOf(query), trace: now.trace, seq: frame.value })) };
  } catch (error) { say(reasonOf(error)); }
}

/** The frame asked for by keys and buttons, inside the trace. @param {number} to */
export function goTo(to) {
  const [first, last] = bounds.value;
  seq.value = Math.max(first, Math.min(last, to));
}

/** Move by a time. @param {number} time s */
export function goBy(time) {
  const trace = open.value?.trace || "", to = seqAt(trace, timeAt(trace, frame.value) + time);
  if (!Number.isFinite(to)) return;
  const next = Math.round(to); // in a gap to its other side
  goTo(next === frame.value ? next + Math.sign(time) : next);
}

let last = 0;
/** @param {number} now */
function step(now) {
  const trace = open.value?.trace || "", at = seq.value, low = Math.floor(at), begun = timeAt(trace, low);
  const here = begun + (at - low) * ((timeAt(trace, low + 1) - begun) || 0);
  const next = seqAt(trace, here + ((now - last) / 1000) * rate.value);
  if (playing.value && Number.isFinite(next)) goTo(next);
  if (next >= bounds.value[1]) playing.value = false;
  last = now;
  if (playing.value) requestAnimationFrame(step);
}
effect(() => {
  if (!playing.value) return;
  last = performance.now();
  requestAnimationFrame(step);
});

/** @param {number} direction */
export function nextMatch(direction) {
  const all = matches.value, now = open.value;
  if (!all.length) return;
  const at = now?.match ? all.findIndex((m) => m.index === now.match?.index)
    : all.findIndex((m) => m.trace === now?.trace && m.first >= seq.value) - (direction > 0 ? 1 : 0);
  const next = all[Math.max(0, Math.min(all.length - 1, at + direction))];
  if (next) openMatch(next);
}

const MOST_CURVES = 8;

/** Add a curve, or remove it; the one that a chosen node has of itself is replaced by the next.
 * @param {string} attribute @param {string} unit @param {number} node @param {number} [other]
 * @param {boolean} [auto] */
export async function showSeries(attribute, unit, node, other, auto = false) {
  const trace = open.value?.trace;
  if (!trace || (offline.value && !live.value)) return;
  try {
    const body = { trace, attribute, node, ...(other === undefined ? {} : { other }) };
    const path = api.address("api/series", body), { columns } = await api.columns(path);
    const label = `${attribute} · ${nameOf(trace, node)}${other === undefined ? "" : ` → ${nameOf(trace, other)}`}`;
    const rest = series.value.filter((one) => one.path !== path && !(auto && one.auto));
    const known = !auto && rest.length < series.value.length;
    series.value = known ? rest : [...rest, { path, attribute, unit, node, other, columns, label,
      auto }].slice(-MOST_CURVES);
  } catch (error) { say(reasonOf(error)); }
}

/** Jump to an end of the match. @param {number} side */
export function matchEnd(side) {
  const m = open.value?.match;
  if (m) goTo(side < 0 ? m.first : m.last);
  else if (matches.value[0]) openMatch(matches.value[0]);
}
