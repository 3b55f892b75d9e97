// @ts-check
// One clock over all that is open: the frame, whether it plays, and what the server says of it.
import { computed, effect, signal } from "../vendor/core.js";
import * as api from "./api.js";
import { nameOf, stillOf } from "./data.js";
import { answer, inOther, live, matches, offline, open, openMatch, parametersOf, playing, rate, reasonOf, say, seq, span, store, text, traces, writeAddress } from "./state.js";

/** Lanes of truth of what is open: answers of the server. */
export const lanes = signal(/** @type {any} */ (null));
export const why = signal(/** @type {any} */ (null));
export const camera = signal("");
export const panel = signal("pattern");
/** Whether the second store is shown beside the first, by the same clock. */
export const beside = signal(false);
/** An attribute over time. */
export const series = signal(/** @type {any} */ (null));

export const frame = computed(() => Math.round(seq.value));
export const asked = computed(() => answer.value.query || text.value.trim());

/** The trace that is open. */
export const about = computed(() => traces.value.get(open.value?.trace || ""));
/** First and last frame of the timeline: of the trace; of a monitor of what is kept. */
export const range = computed(/** @returns {[number, number]} */ () => (live.value ? span.value : [0, (about.value?.frames || 1) - 1]));

/** First and last frame that can be shown: of the timeline; in a report of what it holds around the match. */
const bounds = computed(/** @returns {[number, number]} */ () => {
  const [first, last] = range.value, match = open.value?.match;
  if (live.value || !offline.value || !match) return [first, last];
  const around = Math.floor(store.value.around / (about.value?.period || 0.1));
  return [Math.max(match.first - around, first), Math.min(match.last + around, last)];
});

/** Which parts hold now, by lane; of a monitor whose last frames were not looked at yet, in the last that was. @param {number} now @param {any} [of] */
export const holdsAt = (now, of = lanes.value) => (of?.lanes || []).map((/** @type {any} */ lane) => (lane.unknown.length || (of.known && now < of.known[0]) ? null
  : lane.spans.some((/** @type {number[]} */ [a, z]) => (a ?? 0) <= Math.min(now, of.known?.[1] ?? now) && Math.min(now, of.known?.[1] ?? now) <= (z ?? 0))));

/** What the server is asked for the lanes of what is open; null: there are none.
 * @param {NonNullable<typeof open.value>} now @param {string} query @returns {any} */
function lanesWanted(now, query) {
  if (live.value) return now.match?.pattern ? { text: now.match.pattern, binding: now.binding } : null;
  if (!/\bMATCH\b/i.test(query)) return null;
  return { text: query, parameters: parametersOf(query), trace: now.trace, seq: Math.round(seq.peek()), binding: now.binding };
}

/** Ask for the lanes and for the curve again, of a monitor that goes on. */
export async function refresh() {
  const now = open.value, body = now && lanesWanted(now, ""), curve = series.value;
  const found = body && (await api.json("api/parts", body).catch(() => null));
  if (found && open.value === now) lanes.value = found;
  const more = curve && (await api.columns(curve.path).catch(() => null));
  if (more && series.value === curve) series.value = { ...curve, columns: more.columns };
}

let answered = /** @type {any} */ (null);
// Lanes are asked for when another match is opened, not when their answer said which nodes are bound.
effect(() => {
  const now = open.value, query = asked.value;
  if (now && now === answered) return;
  lanes.value = why.value = series.value = null;
  const body = now && lanesWanted(now, query), current = () => open.value === now && asked.value === query;
  if (!body) return;
  api.json("api/parts", body).then((found) => {
    if (found.error || !current()) return;
    lanes.value = found;
    if (!now.binding && Object.keys(found.binding).length) open.value = answered = { ...now, binding: found.binding };
  }).catch((error) => { if (current()) say(reasonOf(error)); });
});

/** Lanes of the same match in the second store, while that is shown beside. */
export const others = signal(/** @type {any} */ (null));
effect(() => {
  const now = open.value, query = asked.value;
  others.value = null;
  const other = inOther(now?.trace || "");
  if (!now || !beside.value || !traces.value.has(other) || !/\bMATCH\b/i.test(query)) return;
  const body = { text: query, parameters: parametersOf(query), trace: now.trace, seq: Math.round(seq.peek()), binding: sameIn(other, now) };
  api.json("api/parts", { ...body, side: "b" }).then((found) => { if (open.value === now && !found.error) others.value = found; }).catch((error) => say(reasonOf(error)));
});

/** The nodes of a match in the second store, by the ids that the simulator gave them; null: not all are known there.
 * @param {string} other @param {NonNullable<typeof open.value>} now */
function sameIn(other, now) {
  const here = stillOf(now.trace)?.header.names, there = stillOf(other)?.header.names;
  const sameMap = traces.value.get(other)?.map_key === traces.value.get(now.trace)?.map_key;
  if (!here || !there || !now.binding) return null;
  const ids = new Map(Object.entries(there).map(([node, about]) => [about[1], Number(node)]));
  const found = Object.entries(now.binding).map(([key, node]) => [key, node < 0 ? (sameMap ? node : undefined) : here[node]?.[1] ? ids.get(here[node][1]) : undefined]);
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

export function copyLink() {
  writeAddress();
  navigator.clipboard.writeText(location.href).then(() => say("link copied"), () => say(location.href));
}

let last = 0;
/** @param {number} now */
function step(now) {
  const next = seq.value + ((now - last) / 1000) * rate.value / (about.value?.period || 0.1);
  if (playing.value) goTo(next);
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

/** @param {string} attribute @param {string} unit @param {number} node @param {number} [other] */
export async function showSeries(attribute, unit, node, other) {
  const trace = open.value?.trace;
  if (!trace || (offline.value && !live.value)) return;
  try {
    const body = { trace, attribute, node, ...(other === undefined ? {} : { other }) };
    const path = api.address("api/series", body), { columns } = await api.columns(path);
    series.value = { path, attribute, unit, node, other, columns, label: `${attribute} · ${nameOf(trace, node)}${other === undefined ? "" : ` → ${nameOf(trace, other)}`}` };
  } catch (error) { say(reasonOf(error)); }
}

/** Jump to an end of the match. @param {number} side */
export function matchEnd(side) {
  const m = open.value?.match;
  if (m) goTo(side < 0 ? m.first : m.last);
  else if (matches.value[0]) openMatch(matches.value[0]);
}
