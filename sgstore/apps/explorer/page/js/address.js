// @ts-check
// The address of what is shown: all behind '#', so that it never reaches the server; back and forward; links.
import { batch, computed, effect, signal } from "../vendor/core.js";
import * as api from "./api.js";
import { frame } from "./clock.js";
import { placeIn } from "./data.js";
import {
  answer, drop, find, isLost, keyOf, matches, notice, open, openFrame, openMatch, parametersOf, playing, reasonOf,
    refresh, say,
    second,
  seq, side, store, text, ticked, traces, values, view,
} from "./state.js";

/** @typedef {import("./state.js").Match} Match */

// Ticked matches as text ----------------------------------------------------------------------------------------

/** @param {string} name */
const escaped = (name) => encodeURIComponent(name).replace(/[*._]/g, (sign) => `%${sign.charCodeAt(0).toString(16)}`);

/** @param {string} word */
function plain(word) {
  try { return decodeURIComponent(word); } catch { return word; }
}

/** Ticked matches as a short text: groups by trace and variables; numbers of base 36, frames from the match before.
 * @param {Iterable<Match>} all */
export function textOfTicks(all) {
  /** @type {Map<string, {last: number, parts: string[]}>} */
  const groups = new Map();
  for (const { trace, first, last, binding } of all) {
    const head = `${escaped(trace)}*${Object.keys(binding).map(escaped).join(".")}`;
    const group = groups.get(head) || { last: 0, parts: [] };
    const numbers = [first - group.last, last - first, ...Object.values(binding)];
    group.parts.push(numbers.map((one) => one.toString(36)).join("."));
    group.last = first;
    groups.set(head, group);
  }
  return [...groups].map(([head, { parts }]) => `${head}*${parts.join("_")}`).join("*_*");
}

/** Ticked matches of a text; what is none is left out. @param {string} text @returns {Map<string, Match>} */
export function ticksOf(text) {
  const found = new Map();
  for (const group of text ? text.split("*_*") : []) {
    const [told = "", listed = "", parts = ""] = group.split("*");
    const trace = plain(told), names = listed ? listed.split(".").map(plain) : [];
    let before = 0;
    for (const part of parts.split("_")) {
      const [step = NaN, more = NaN, ...nodes] = part.split(".").map((one) => parseInt(one, 36));
      const first = before + step;
      if (![first, more, ...nodes].every(Number.isInteger) || nodes.length !== names.length) continue;
      const binding = Object.fromEntries(names.map((name, i) => [name, nodes[i] ?? 0]));
      /** @type {Match} */
      const match = {
        trace, first, last: first + more, start: NaN, end: NaN, binding, names: {}, values: {},
          index: `t${found.size}`,
      };
      found.set(keyOf(match), match);
      before = first;
    }
  }
  return found;
}

const ticks = computed(() => textOfTicks(ticked.value.values()));

// The last selection of the store -----------------------------------------------------------------------------------

/** Matches of the last selection that are not ticked; they are offered again. */
export const offered = signal(/** @type {Map<string, Match>} */ (new Map()));

/** Offer the last selection of the store, and keep each one from now on. What is offered stays part of it. */
export async function followSelection() {
  const { ticks: told } = await api.json("api/selection");
  const left = [...ticksOf(told)].filter(([key, { trace, last }]) => !ticked.value.has(key)
    && last < (traces.value.get(trace)?.frames || 0));
  offered.value = new Map(left);
  let known = told, waits = /** @type {any} */ (0), begun = false, stop = () => {};
  const save = async (/** @type {string} */ ticks) => {
    try { await api.json("api/selection", { ticks }); known = ticks; } catch (error) {
      if (isLost(error)) return; // the next one is kept
      say(`the selection is not kept: ${reasonOf(error)}`);
      stop();
    }
  };
  stop = effect(() => {
    const now = textOfTicks(new Map([...offered.value, ...ticked.value]).values());
    clearTimeout(waits);
    if (begun && now !== known) waits = setTimeout(save, 400, now);
    begun = true;
  });
}

/** Tick the matches of the last selection again. */
export function tickOffered() {
  batch(() => {
    ticked.value = new Map([...offered.value, ...ticked.value]);
    offered.value = new Map();
  });
}

// Written ---------------------------------------------------------------------------------------------------------

/** What is shown, in the form of an address. */
function shown() {
  const parts = new URLSearchParams(), query = text.value.trim(), now = open.value;
  if (view.value !== "find") parts.set("show", view.value);
  if (query) parts.set("q", query);
  for (const [name, value] of Object.entries(values.value)) if (value) parts.set(`$${name}`, value);
  if (now) {
    parts.set("at", `${now.trace}#${frame.value}`);
    const bind = Object.entries(now.binding || {}).map(([key, node]) => `${key}:${node}`);
    if (bind.length) parts.set("bind", bind.join(","));
  }
  if (second.value) parts.set("b", second.value);
  if (side.value) parts.set("of", side.value);
  if (ticks.value) parts.set("tick", ticks.value);
  return String(parts);
}

/** Where the user is: back leads to the place before. */
const place = computed(() => JSON.stringify([view.value, answer.value.query || "", open.value?.trace || "",
  open.value?.match ? keyOf(open.value.match) : "", second.value, side.value]));

let last = "", reads = 0, reading = false, due = false;

/** Write the address: of another place as a new entry of the history. */
function write() {
  due = false;
  if (reading) return;
  const entry = place.peek() === last ? "replaceState" : "pushState";
  last = place.peek();
  window.history[entry]({ place: last }, "", `#${shown()}`);
}

/** @type {any} */
let soon = 0;

/** Write another place at once, and what changes in it after a while: browsers allow few changes in a short time. */
export function followPlace() {
  last = place.peek();
  addEventListener("popstate", (event) => { readAddress(!event.state); });
  effect(() => {
    if (place.value === last || due) return;
    due = true;
    queueMicrotask(write); // all of an act is one entry
  });
  effect(() => {
    const changes = [seq.value, open.value, values.value, ticked.value];
    clearTimeout(soon);
    if (!playing.value && changes) soon = setTimeout(write, 400);
  });
}

// Read ------------------------------------------------------------------------------------------------------------

/** The frame that an address names: TRACE#SEQ, or TRACE@12.3s as in older links.
 * @param {string} at @returns {Promise<[string, number] | null>} */
async function frameOf(at) {
  const named = /^(.*)([#@])(\d+(?:\.\d+)?)s?$/s.exec(at);
  if (!named) {
    if (at) notice.value = `The link names no frame: ${at}`;
    return null;
  }
  const [, name = "", sign = "#", number = "0"] = named;
  if (!traces.value.has(name)) await refresh();
  const trace = traces.value.get(name);
  if (!trace) {
    notice.value = `The link names the trace ${name}, which the store ${store.value.store} does not have.`;
    return null;
  }
  if (sign === "#") {
    if (Number(number) >= trace.frames) {
      notice.value = `The link names ${name}#${number}; the trace has the frames #0 … #${trace.frames - 1}.`;
    }
    return [name, Math.min(Math.trunc(Number(number)), trace.frames - 1)];
  }
  const { columns } = await api.columns(api.address("api/static", { trace: name })), times = columns.t;
  return [name, Math.floor(placeIn(0, times.length, Number(number) + 0.0005, (at) => times[at]))];
}

/** Show what the address says. A step back keeps what is ticked. @param {boolean} [whole] */
export async function readAddress(whole = true) {
  const parts = new URLSearchParams(location.hash.slice(1)), query = parts.get("q") || "";
  const mine = ++reads, current = () => mine === reads, told = parts.get("tick") || "";
  reading = true;
  batch(() => {
    text.value = query;
    values.value = Object.fromEntries([...parts].filter(([n]) => n.startsWith("$")).map(([n, v]) => [n.slice(1), v]));
    view.value = parts.get("show") || "find";
    second.value = parts.get("b") || "";
    side.value = parts.get("of") || "";
    if (whole && told && told !== ticks.peek()) ticked.value = ticksOf(told);
    notice.value = "";
  });
  const { query: asked = "", parameters = {} } = answer.value;
  const other = query !== asked || JSON.stringify(parametersOf(query)) !== JSON.stringify(parameters);
  if (other) drop(); // another view does not ask
  try {
    const done = view.value !== "find" || !other || (await find());
    if (done && current()) await showFrame(parts.get("at") || "", parts.get("bind") || "", current);
  } catch (error) {
    say(reasonOf(error));
  }
  if (!current()) return;
  reading = false;
  last = place.peek();
  write();
}

/** Open the frame of an address with its match. @param {string} at @param {string} told
 * @param {() => boolean} current */
async function showFrame(at, told, current) {
  const here = await frameOf(at);
  if (!current()) return;
  if (!here) { open.value = null; return; }
  const [trace, number] = here, pairs = told.split(",").filter(Boolean).map((one) => one.split(":"));
  const bind = Object.fromEntries(pairs.map(([key = "", node]) => [key, Number(node)]));
  const same = (/** @type {Match} */ m) => m.trace === trace && m.first <= number && number <= m.last
    && Object.entries(bind).every(([key, node]) => m.binding[key] === node);
  const now = open.value?.match, match = now && same(now) ? now : matches.value.find(same), before = view.value;
  batch(() => {
    if (match && match === now) seq.value = number;
    else if (match) openMatch(match, number);
    else openFrame(trace, number, pairs.length ? bind : null);
    view.value = before;
  });
}

// Links -------------------------------------------------------------------------------------------------------------

/** @param {string} words @param {string} done */
export const copy = (words, done) => navigator.clipboard.writeText(words).then(() => say(done), () => say(words));

export function copyLink() {
  write();
  copy(location.href, "link copied");
}

/** A text as one word of a shell. @param {string} word */
export const quoted = (word) => (/^[\w./:@%+=-]+$/.test(word) ? word : `'${word.replace(/'/g, "'\\''")}'`);

/** Copy the command that opens this page with this view, on any machine that has the store. */
export function copyCommand() {
  const { path, other } = store.value, more = other ? ` --compare ${quoted(other.path)}` : "";
  copy(`sgstore serve ${quoted(path)}${more} --open --link ${quoted(`#${shown()}`)}`, "command copied");
}
