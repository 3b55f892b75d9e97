// @ts-check
// What the page asks the server: plain values, columns as typed arrays, lines and events as they come.
import { signal } from "../vendor/core.js";
import { unpacked } from "./wire.js";

/** @typedef {Record<string, any>} Plain */

/** Why the server does not answer; empty: it does. */
export const trouble = signal("");
/** Counts how often it answered again after that, or after it was busy. */
export const returns = signal(0);

let missed = false;

/** A request that failed; `lost`: for a time only; `down`: the server does not answer at all. */
class Failed extends Error {
  /** @param {string} reason @param {boolean} lost @param {boolean} [down] */
  constructor(reason, lost, down = lost) {
    super(reason);
    this.lost = lost;
    missed ||= lost;
    if (down) trouble.value = reason;
  }
}

/** Look whether the server answers, and what it says of its stores. @returns {Promise<Plain | null>} */
export async function look() {
  let found = null;
  try { found = await json("api/stamp"); } catch { return null; }
  if (missed) { missed = false; trouble.value = ""; returns.value++; }
  return found;
}

/** @param {string} path @param {Plain} [body] @param {RequestInit} [how] */
async function send(path, body, how = {}) {
  const given = body === undefined
    ? {}
    : { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } };
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...given, ...how });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    const reason = error instanceof Error ? error.message : String(error);
    throw new Failed(`The server does not answer (${reason}). Does it still run? The page tries again.`, true);
  }
  if (answer.ok) return answer;
  const { status } = answer, told = await answer.text().catch(() => "");
  if (status === 403 && !told.startsWith("{")) {
    throw new Failed("The server has started again: open the address that it printed, in this browser.", true);
  }
  /** @type {Plain} */
  let about = {};
  try { about = JSON.parse(told); } catch { /* no JSON */ }
  throw new Failed(about.reason || `the server answered ${status}: ${told.slice(0, 200)}`, status === 503, false);
}

/** @param {string} path @param {Plain} values */
export function address(path, values) {
  return `${path}?${new URLSearchParams(Object.entries(values).map(([k, v]) => [k, String(v)]))}`;
}

/** @typedef {Parameters<typeof send>} Asked */
/** @param {Asked} asked @returns {Promise<any>} */
export const json = async (...asked) => (await send(...asked)).json();
/** @param {Asked} asked */
export const blob = async (...asked) => (await send(...asked)).blob();
/** @param {Asked} asked */
export const columns = async (...asked) => unpacked(await (await send(...asked)).arrayBuffer());

/** Lines of an answer, as they come. @param {string} path @param {Plain} body @param {RequestInit} [how] */
export async function* lines(path, body, how) {
  const answer = await send(path, body, how);
  if (!answer.body) return;
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read().catch((error) => {
      if (how?.signal?.aborted) throw error;
      throw new Failed(`The answer broke off (${error.message}).`, true);
    });
    const parts = (rest + (value || "")).split("\n");
    rest = parts.pop() || "";
    for (const part of parts) yield JSON.parse(part);
    if (done) return;
  }
}

/** The result of a longer piece of work.
 * @param {string} path @param {Plain} body @param {(done: number, of: number) => void} [progress]
 * @param {RequestInit} [how] */
export async function work(path, body, progress, how) {
  for await (const { progress: done, error, result } of lines(path, body, how)) {
    if (done) progress?.(done[0], done[1]);
    else if (error) throw new Error(error.reason);
    else return result;
  }
  throw new Failed("The server ended before it was done.", true);
}
