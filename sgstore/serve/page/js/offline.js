// @ts-check
// What a report has instead of a server: the same answers, kept in the file. It stands in for api.js there.
import { bytesOf, unpacked } from "./wire.js";

/** @typedef {Record<string, any>} Plain */

const text = document.getElementById("kept")?.textContent || "{}";
/** @type {{about: Plain, query: string, parameters: Plain, made: string, around: number, find: Plain[], check: Plain | null, parts: Plain,
 *   notes: any[][], words: Plain, columns: Record<string, string>, pictures: Record<string, Record<string, string>>}} */
export const kept = JSON.parse(text);

export class Refused extends Error {}

/** The key under which an answer is kept. @param {string} path @param {Plain} values */
export function address(path, values) {
  return JSON.stringify([path, ...Object.values(values)]);
}

/** @param {string} path @param {Plain} [body] @returns {Promise<any>} */
export async function json(path, body) {
  if (path === "api/check" && kept.check) return kept.check;
  if (path !== "api/parts") throw new Refused("the report does not hold this");
  return kept.parts[JSON.stringify([body?.trace, body?.binding])] || { error: {} };
}

/** Columns that are kept; small pictures are rows of the states. @param {string} key @param {Plain} [body] */
export async function columns(key, body) {
  if (body?.frames) return thumbs(body.frames);
  const [path, trace] = JSON.parse(key);
  const map = path === "api/map" ? kept.about.traces.find((/** @type {any} */ one) => one.name === trace)?.map_key : null;
  const found = kept.columns[map ? JSON.stringify([path, map]) : key];
  if (!found) throw new Refused("the report does not hold this");
  const plain = new Blob([bytesOf(found)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return unpacked(await new Response(plain).arrayBuffer());
}

/** @type {Map<string, Promise<import("./wire.js").Columns>>} */
const chunks = new Map();
/** @type {[string, number, number, string][]} */
const states = Object.keys(kept.columns).map((key) => [key, JSON.parse(key)]).filter(([, of]) => of[0] === "api/states").map(([key, of]) => [of[1], of[2], of[3], key]);

/** States in some frames, as the server packs them: `at` says which of them a row is of. @param {[string, number][]} frames */
async function thumbs(frames) {
  const parts = await Promise.all(frames.map(async ([trace, frame]) => {
    const key = states.find(([name, first, last]) => name === trace && first <= frame && frame <= last)?.[3] || "";
    if (!chunks.has(key)) chunks.set(key, columns(key));
    const { columns: found, header } = /** @type {any} */ (await chunks.get(key));
    const row = frame - header.first;
    return { found, from: found["frame.start"][row], to: found["frame.start"][row + 1] };
  }));
  /** @type {Plain} */
  const told = { at: Uint32Array.from(parts.flatMap((part, at) => Array(part.to - part.from).fill(at))) };
  for (const name of Object.keys(parts[0]?.found || {})) {
    if (name.startsWith("frame.")) continue;
    told[name] = new (/** @type {any} */ (parts[0]).found[name].constructor)(told.at.length);
    let place = 0;
    for (const { found, from, to } of parts) { told[name].set(found[name].subarray(from, to), place); place += to - from; }
  }
  return { header: {}, columns: told };
}

/** The picture of a camera at a frame, or the last one before it. @param {string} key */
export async function blob(key) {
  const [, trace, channel, seq] = JSON.parse(key), all = kept.pictures[JSON.stringify([trace, channel])] || {};
  const at = Math.max(...Object.keys(all).map(Number).filter((one) => one <= seq));
  if (!Number.isFinite(at)) throw new Refused("the report has no picture of this time");
  return new Blob([bytesOf(all[at] || "")]);
}

/** What was found, as it was told. @param {string} _ */
export async function* lines(_) { yield* kept.find; }

/** @returns {Promise<any>} */
export async function work() { throw new Refused("a report holds no measures"); }
