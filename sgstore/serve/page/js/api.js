// @ts-check
// What the page asks the server: plain values, columns as typed arrays, lines and events as they come.
import { unpacked } from "./wire.js";

/** @typedef {Record<string, any>} Plain */

export class Refused extends Error {
  /** @param {string} reason @param {Plain} about */
  constructor(reason, about = {}) {
    super(reason);
    this.about = about;
  }
}

/** @param {string} path @param {Plain | undefined} body @param {RequestInit} [how] */
async function send(path, body, how = {}) {
  const given = body === undefined
    ? {}
    : { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } };
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...given, ...how });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw new Refused("The server does not answer. Is 'sgstore serve' still running?");
  }
  if (answer.ok) return answer;
  /** @type {Plain} */
  let about = {};
  try { about = await answer.json(); } catch { /* no JSON */ }
  throw new Refused(about.reason || `the server answered ${answer.status}`, about);
}

/** @param {string} path @param {Plain} values */
export function address(path, values) {
  return `${path}?${new URLSearchParams(Object.entries(values).map(([k, v]) => [k, String(v)]))}`;
}

/** @param {string} path @param {Plain} [body] @param {RequestInit} [how] @returns {Promise<any>} */
export async function json(path, body, how) {
  return (await send(path, body, how)).json();
}

/** @param {string} path @param {Plain} [body] @param {RequestInit} [how] */
export async function blob(path, body, how) {
  return (await send(path, body, how)).blob();
}

/** @param {string} path @param {Plain} [body] @param {RequestInit} [how] */
export async function columns(path, body, how) {
  return unpacked(await (await send(path, body, how)).arrayBuffer());
}

/** Parts of an answer, as they come, cut where a separator stands.
 * @param {Response} answer @param {string} separator */
async function* cut(answer, separator) {
  if (!answer.body) return;
  const reader = answer.body.getReader(), decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    rest += decoder.decode(value, { stream: !done });
    const parts = rest.split(separator);
    rest = parts.pop() || "";
    for (const part of parts) if (part) yield part;
    if (done) break;
  }
  if (rest.trim()) yield rest;
}

/** @param {string} path @param {Plain} body @param {AbortSignal} signal */
export async function* lines(path, body, signal) {
  for await (const line of cut(await send(path, body, { signal }), "\n")) yield JSON.parse(line);
}

/** The result of a longer piece of work.
 * @param {string} path @param {Plain} body @param {(done: number, of: number) => void} [progress] @param {RequestInit} [how] */
export async function work(path, body, progress, how) {
  for await (const part of cut(await send(path, body, how), "\n\n")) {
    const [event, data] = part.split("\ndata: ");
    const value = JSON.parse(data || "null");
    if (event === "event: progress") progress?.(value[0], value[1]);
    else if (event === "event: error") throw new Refused(value.reason, value);
    else return value;
  }
  throw new Refused("the server ended before it was done");
}
