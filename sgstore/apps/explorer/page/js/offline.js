// @ts-check
// What a report has instead of a server: the same answers, kept in the file. It stands in for api.js there.
import { bytesOf, unpacked } from "./wire.js";

/** @typedef {Record<string, any>} Plain */

const text = document.getElementById("kept")?.textContent || "{}";
/** @type {Plain & {made: string, query: string, find: Plain[], columns: Record<string, string>,
 *   pictures: Record<string, Record<string, string>>}} */
export const kept = JSON.parse(text);

/** Why the server does not answer: there is none. */
export const trouble = { value: "" };

/** The key under which an answer is kept. @param {string} path @param {Plain} values */
export function address(path, values) {
  return JSON.stringify([path, ...Object.values(values)]);
}

/** @param {string} path @param {Plain} [body] @returns {Promise<any>} */
export async function json(path, body) {
  if (path === "api/check" && kept.check) return kept.check;
  if (path !== "api/parts") throw new Error("the report does not hold this");
  return kept.parts[JSON.stringify([body?.trace, body?.binding])] || { error: {} };
}

/** Columns that are kept. @param {string} key */
export async function columns(key) {
  const [path, trace] = JSON.parse(key);
  const map = path === "api/map" ? kept.about.traces.find((/** @type {any} */ one) => one.name === trace)?.map_key
    : null;
  const found = kept.columns[map ? JSON.stringify([path, map]) : key];
  if (!found) throw new Error("the report does not hold this");
  const plain = new Blob([bytesOf(found)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return unpacked(await new Response(plain).arrayBuffer());
}

/** The picture of a camera at a frame, or the last one before it. @param {string} key */
export async function blob(key) {
  const [, trace, channel, seq] = JSON.parse(key), all = kept.pictures[JSON.stringify([trace, channel])] || {};
  const at = Math.max(...Object.keys(all).map(Number).filter((one) => one <= seq));
  if (!Number.isFinite(at)) throw new Error("the report has no picture of this time");
  return new Blob([bytesOf(all[at] || "")]);
}

/** What was found, as it was told. @param {string} _ */
export async function* lines(_) { yield* kept.find; }
