// @ts-check
// What the page asks the server: plain values, columns as typed arrays, lines and events as they come.
import { unpacked } from "./wire.js";

/** @typedef {Record<string, any>} Plain */

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
    throw new Error("The server does not answer. Is 'sgstore serve' still running?");
  }
  if (answer.ok) return answer;
  /** @type {Plain} */
  let about = {};
  try { about = await answer.json(); } catch { /* no JSON */ }
  throw new Error(about.reason || `the server answered ${answer.status}`);
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
    const { done, value } = await reader.read();
    const parts = (rest + (value || "")).split("\n");
    rest = parts.pop() || "";
    for (const part of parts) yield JSON.parse(part);
    if (done) return;
  }
}

/** The result of a longer piece of work.
 * @param {string} path @param {Plain} body @param {(done: number, of: number) => void} [progress] @param {RequestInit} [how] */
export async function work(path, body, progress, how) {
  for await (const { progress: done, error, result } of lines(path, body, how)) {
    if (done) progress?.(done[0], done[1]);
    else if (error) throw new Error(error.reason);
    else return result;
  }
  throw new Error("the server ended before it was done");
}
