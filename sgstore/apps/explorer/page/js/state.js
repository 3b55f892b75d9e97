// @ts-check
// What the page knows and shows, as signals.
import { batch, computed, signal } from "../vendor/core.js";
import * as api from "./api.js";
import { ordered } from "./order.js";

/** A match: a run of frames of a trace, and the nodes that are bound.
 * @typedef {{trace: string, first: number, last: number, start: number, end: number,
 *   binding: Record<string, number>, names: Record<string, string>, values: Record<string, any>, index: any,
 *   pattern?: string, group?: string, go?: () => void}} Match */
/** @typedef {{name: string, frames: number, seconds: number, period: number, map: string, map_key: string,
 *   origin: [number, number], cameras: string[], side?: string}} Trace */

export const store = signal(/** @type {any} */ (null));
export const words = signal(/** @type {any} */ (null));
export const library = signal(/** @type {any[]} */ ([]));
/** How often each pattern of the library is found, and where. */
export const tally = signal(
  /** @type {Record<string, {count: number, more: string, spots: number[], reason: string}>} */ ({}));
export const view = signal("find");
export const text = signal("");
/** Words that are sought in the library and the vocabulary. */
export const sought = signal("");
/** Values of $name. */
export const values = signal(/** @type {Record<string, string>} */ ({}));
const NO_ANSWER = { state: "idle", matches: [], names: [], reasons: {}, notes: [], lists: "" };
export const answer = signal(/** @type {any} */ (NO_ANSWER));
export const filter = signal({ trace: "", map: "" });
export const order = signal("");
/** What is open: trace, frame (with its fraction), the match, the nodes. */
/** @typedef {{trace: string, match: Match | null, binding: Record<string, number> | null}} Opened */
export const open = signal(/** @type {Opened | null} */ (null));
export const seq = signal(0);
export const playing = signal(false);
export const rate = signal(1);
export const ticked = signal(/** @type {Map<string, Match>} */ (new Map()));
export const notes = signal(/** @type {any[][]} */ ([]));
export const lit = signal(/** @type {Set<number>} */ (new Set()));
export const chosen = signal(/** @type {number | null} */ (null));
export const toast = signal("");
/** What stays in sight until it is read, such as a fault of a link. */
export const notice = signal("");
/** The second query of Compare, and the store that it is asked of; empty: as the first. */
export const second = signal("");
export const side = signal("");
/** Whether the store has changed since what is shown was asked; and how often it was asked again. */
export const changed = signal(false);
export const again = signal(0);
/** How often the server answered again after a time without an answer: what failed is asked once more. */
export const retries = signal(0);
export const dialog = signal("");
/** Frames that the form for tags is for; null: the frame that is shown. */
export const tagged = signal(/** @type {{trace: string, first: number, last: number} | null} */ (null));
/** True in a report, which has no server, and of a monitor, whose server knows the last frames only. */
export const offline = signal(false);
/** True of a monitor that runs; and the first and last frame of it that are kept. */
export const live = signal(false);
/** Whether the page shows the newest frame of a running monitor as it comes. */
export const following = signal(false);
export const span = signal(/** @type {[number, number]} */ ([0, 0]));
export const theme = signal(remembered("theme"));

/** Counts changes of colours: what is painted is painted again. */
export const paints = signal(0);

/** How a trace of the second store is called here. @param {string} trace */
export const inOther = (trace) => `${trace}\n${store.value?.other?.store}`;
/** Traces of the store by name; those of the second store have `side`. */
export const traces = computed(() => new Map(/** @type {[string, Trace][]} */ ([
  ...(store.value?.traces || []).map((/** @type {Trace} */ t) => [t.name, t]),
  ...(store.value?.other?.traces || []).map((/** @type {Trace} */ t) => [inOther(t.name), { ...t, side: "b" }]),
])));
export const matches = computed(() => {
  const { trace, map } = filter.value;
  const some = /** @type {Match[]} */ (answer.value.matches)
    .filter((m) => (!trace || m.trace === trace) && (!map || traces.value.get(m.trace)?.map === map));
  return ordered(some, order.value);
});
/** How many matches the filter hides. */
export const hidden = computed(() => answer.value.matches.length - matches.value.length);
/** Frames that match, each once. */
export const framesFound = computed(() => {
  const ends = new Map();
  let frames = 0;
  for (const { trace, first, last } of [...matches.value].sort((a, b) => a.first - b.first)) {
    const end = ends.get(trace) ?? -1;
    frames += Math.max(0, last - Math.max(first, end + 1) + 1);
    ends.set(trace, Math.max(end, last));
  }
  return { frames, traces: ends.size };
});

/** Trace and number of a frame by its name, TRACE#SEQ; null: it names none.
 * @param {string} name @returns {[string, number] | null} */
export function frameNamed(name) {
  const found = /^(.*)#(\d+)$/s.exec(name);
  return found && [found[1] || "", Number(found[2])];
}

/** @param {Match} m */
export const keyOf = (m) => `${m.trace}#${m.first}-${m.last}:${Object.values(m.binding).join(",")}`;

/** A text without its comments, and without what is in quotes. @param {string} query */
const bare = (query) => query.replace(/'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|--[^\n]*/g, " ");

/** True for checks, or the name of one. Settings (USING) and definitions may stand before a check.
 * @param {string} query */
export function isCheck(query) {
  const text = bare(query).replace(/\bDEFINE\b[^;]*;/gi, " ").trim();
  return /\b(?:CHECK|MATCH|SELECT|FROM)\b/i.exec(text)?.[0].toUpperCase() === "CHECK"
    || library.value.some((one) => one.kind === "property" && one.name === text);
}

/** True for a pattern, or the name of one: no check, and no SQL. @param {string} query */
export const isPattern = (query) => !isCheck(query) && (/\bMATCH\b/i.test(query)
  || /^\s*(?!SELECT|FROM)\w+\s*(?:\([^)]*\))?\s*$/i.test(query));

/** The last word of the page on a fault or an act. @param {string} message */
export function say(message) {
  if (message === api.trouble.value) return; // it stands above the page
  toast.value = message;
  setTimeout(() => { if (toast.value === message) toast.value = ""; }, 3500);
}

/** @param {unknown} error */
export const reasonOf = (error) => (error instanceof Error ? error.message : String(error));

let number = 0;
/** @type {AbortController | null} */
let under = null;
/** What is asked while nothing else is: it ends where somebody asks. */
export const idle = { stop: () => {} };

/** What the browser kept for the page; nothing where it may keep nothing. @param {string} name */
function remembered(name) {
  try { return localStorage.getItem(`sgstore ${name}`) || ""; } catch { return ""; }
}

/** @param {string} name @param {string} value */
export function keep(name, value) {
  try { localStorage.setItem(`sgstore ${name}`, value); } catch { /* no room, or not allowed */ }
}

/** @returns {string[]} */
export function history() {
  try { return JSON.parse(remembered("history") || "[]"); } catch { return []; }
}

/** Values of the parameters of a text, as numbers where they are numbers.
 * @param {string} query */
export function parametersOf(query) {
  const plain = (/** @type {string} */ told) => (told === "true" || told === "false" ? told === "true"
    : Number.isFinite(Number(told)) ? Number(told) : told);
  return Object.fromEntries(namesIn(query).flatMap((name) => (values.value[name]
    ? [[name, plain(values.value[name])]] : [])));
}

/** Names of parameters in a text, those in quotes and comments left out.
 * @param {string} query */
export function namesIn(query) {
  return [...new Set([...bare(query).matchAll(/\$(\w+)/g)].map((m) => /** @type {string} */ (m[1])))];
}

export function cancel() {
  if (!under) return;
  fetch(`api/find/${answer.value.id}`, { method: "DELETE" }).catch(() => {});
  under.abort();
  under = null;
  if (answer.value.state === "busy") answer.value = { ...answer.value, state: "cancelled" };
}

/** Stop the query, and drop its answer. */
export function drop() {
  cancel();
  answer.value = NO_ANSWER;
  changed.value = false;
}

/** Ask for a pattern of the library, or of a table. @param {string} query */
export function ask(query) {
  batch(() => {
    values.value = {};
    text.value = query;
  });
  return find();
}

/** Ask for the matches of the text in the editor, or for its rows; true: no other query came meanwhile.
 * @param {{keep?: boolean, rows?: boolean}} [how] */
export async function find(how = {}) {
  const query = text.value.trim();
  if (!query) {
    drop();
    return true;
  }
  cancel();
  idle.stop();
  const id = `q${Date.now().toString(36)}${number++}`, parameters = parametersOf(query);
  const mine = (under = new AbortController());
  const began = performance.now();
  /** @type {any} */
  const told = { state: "busy", id, query, parameters, matches: [], names: [], reasons: {}, notes: [], columns: [],
    rows: null, lists: "" };
  batch(() => {
    answer.value = { ...told };
    if (!how.keep) open.value = null;
    view.value = "find";
    changed.value = false;
  });
  remember(query);
  try {
    if (isCheck(query)) {
      const found = await api.json("api/check", { text: query, parameters }, { signal: mine.signal });
      if (mine.signal.aborted) return false;
      await follow(found.stamp);
      told.ms = performance.now() - began;
      answer.value = fromVerdicts({ ...told, state: found.error ? "error" : "done" }, found);
      return true;
    }
    let last = 0;
    const body = { text: query, parameters, id, ...(how.rows ? { ask: "rows" } : {}) };
    for await (const line of api.lines("api/find", body, { signal: mine.signal })) {
      await follow(line.stamp);
      if (line.names) told.names = line.names;
      if (line.matches) for (const row of line.matches) told.matches.push(matchOf(row, told));
      for (const name of ["reasons", "columns", "rows", "notes", "count", "truncated", "lists", "error"]) {
        if (line[name] !== undefined) told[name] = name === "error" ? here(line.error) : line[name];
      }
      if (performance.now() - last > 120) { last = performance.now(); answer.value = { ...told }; }
    }
    told.ms = performance.now() - began;
    told.state = told.error ? "error" : "done";
  } catch (error) {
    if (mine.signal.aborted) return false;
    told.state = "error";
    told.error = { reason: reasonOf(error) };
    told.lost = isLost(error);
  }
  if (under !== mine) return false;
  under = null;
  answer.value = { ...told };
  return true;
}

/** Whether a request failed for a time only, so that it is asked again. @param {any} error @returns {boolean} */
export const isLost = (error) => error?.lost === true;

/** Know the store as it is now: its traces, and what it counts. */
export async function refresh() {
  const now = await api.json("api/store"), same = (/** @type {any} */ one) => `${one?.stamp} ${one?.other?.stamp}`;
  if (same(now) === same(store.value)) return;
  batch(() => {
    store.value = now;
    tally.value = {};
    changed.value = answer.value.state !== "idle" || view.value !== "find";
    const trace = open.value?.trace;
    if (trace && !traces.value.has(trace)) {
      open.value = null;
      notice.value = `The store no longer has the trace ${trace}.`;
    }
  });
}

/** Know the store that an answer is of. @param {string | undefined} stamp */
async function follow(stamp) {
  if (!stamp || offline.value || stamp === store.value.stamp) return;
  await refresh();
  changed.value = stamp !== store.value.stamp;
}

/** Ask again what is shown, because the store has changed. */
export function askAgain() {
  changed.value = false;
  again.value++;
  if (answer.value.query) find({ keep: true });
}

/** An error with what helps on this page: its fields are the place for values. @param {any} error */
const here = (error) => (/^the parameter \$/.test(error.reason)
  ? { ...error, hint: "write one into its field above" } : error);

/** Matches among the lines of an answer; `more` hears of those that it lacks. @param {AsyncIterable<any>} lines
 * @param {(many: number) => void} more @returns {AsyncGenerator<Match>} */
export async function* matchesIn(lines, more) {
  const told = { names: [], matches: { length: 0 } };
  for await (const line of lines) {
    if (line.error) throw new Error(line.error.reason);
    if (line.rows) throw new Error("The query returns values of several matches: remove RETURN, LIMIT and ORDER BY.");
    if (line.names) told.names = line.names;
    for (const row of line.matches || []) { yield matchOf(row, told); told.matches.length++; }
    if (line.truncated) more(told.matches.length);
  }
}

/** @param {any[]} row @param {any} told @returns {Match} */
function matchOf(row, told) {
  const [trace, first, last, start, end, ...rest] = row;
  /** @type {Match} */
  const match = { trace, first, last, start, end, binding: {}, names: {}, values: {}, index: told.matches.length };
  told.names.forEach((/** @type {string} */ name, /** @type {number} */ i) => {
    if (name.endsWith(".name")) match.names[name.slice(0, -5)] = rest[i];
    else if (Number.isInteger(rest[i]) && told.names.includes(`${name}.name`)) match.binding[name] = rest[i];
    else match.values[name] = rest[i];
  });
  return match;
}

/** Violations of checks as matches. @param {any} told @param {any} found */
function fromVerdicts(told, found) {
  if (found.error) return { ...told, error: here(found.error) };
  Object.assign(told, { verdicts: found.verdicts, notes: found.notes || [], truncated: found.truncated });
  for (const v of found.verdicts) {
    for (const [first, last, start, end, held] of v.spans) {
      /** @type {Match} */
      const match = { trace: v.trace, first, last, start, end, binding: {}, names: { check: v.check }, values: {},
        index: told.matches.length };
      for (const [name, value] of Object.entries(held)) {
        if (Number.isInteger(value)) match.binding[name] = value;
        else match.names[name.replace(/\.name$/, "")] = value;
      }
      told.matches.push(match);
    }
  }
  return told;
}

/** @param {string} query */
function remember(query) {
  const kept = [query, ...history().filter((one) => one !== query)].slice(0, 40);
  if (!offline.value) keep("history", JSON.stringify(kept));
}

/** Open a match, or a frame of a trace. @param {Match} match @param {number} [at] */
export function openMatch(match, at) {
  batch(() => {
    open.value = { trace: match.trace, match, binding: Object.keys(match.binding).length ? match.binding : null };
    seq.value = at ?? match.first;
    lit.value = new Set();
    chosen.value = null;
  });
}

/** @param {string} trace @param {number} at @param {Record<string, number> | null} [binding] */
export function openFrame(trace, at, binding = null) {
  batch(() => { open.value = { trace, match: null, binding }; seq.value = at; view.value = "find"; });
}

/** @param {Match} match */
export function tick(match) {
  const next = new Map(ticked.value), key = keyOf(match);
  if (!next.delete(key)) next.set(key, match);
  ticked.value = next;
}

/** Tick many matches in one step. @param {Match[]} all */
export function tickAll(all) {
  const next = new Map(ticked.value);
  for (const match of all) next.set(keyOf(match), match);
  ticked.value = next;
}

/** @param {Record<string, any>} body */
export async function tag(body) {
  const told = await api.json("api/notes", body);
  notes.value = told.notes;
}
