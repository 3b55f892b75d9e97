// @ts-check
// Lanes of truth as the query writes its parts: the parts of one word of the library are one lane, which opens.

/** @typedef {{text: string, step: number, call: string, conditions: string[], meanings: string[], spans: number[][],
 *   unknown: string[], nodes: Record<string, string>}} Lane */
/** A part as written, and the numbers of its lanes. @typedef {{text: string, step: number, of: number[]}} Written */

/** Parts as written, each with its lanes. @param {Lane[]} lanes @returns {Written[]} */
export function written(lanes) {
  /** @type {Written[]} */
  const found = [], known = new Map();
  lanes.forEach(({ text, step, call }, at) => {
    const key = `${step} ${call}`, before = call ? known.get(key) : undefined;
    if (before) { before.of.push(at); return; }
    const one = { text: call || text, step, of: [at] };
    known.set(key, one);
    found.push(one);
  });
  return found;
}

/** Frames of all of some lanes. @param {number[][][]} all runs of frames of each, in order @returns {number[][]} */
export function common([first = [], ...others]) {
  return others.reduce((found, other) => found.flatMap(([a = 0, z = 0]) => other.flatMap(([low = 0, high = 0]) => (
    Math.max(a, low) <= Math.min(z, high) ? [[Math.max(a, low), Math.min(z, high)]] : []))), first);
}

/** Whether all of some lanes hold; null: of one nothing is known. @param {(boolean | null | undefined)[]} holds */
export const allHold = (holds) => (holds.includes(false) ? false : holds.every(Boolean) ? true : null);
