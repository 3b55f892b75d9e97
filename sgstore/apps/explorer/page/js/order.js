// @ts-check
// The order of matches: by trace, by length, random, or spread over traces.

/** @typedef {import("./state.js").Match} Match */

/** The word of the order of the store, if the query has one of its own. */
export const BY_QUERY = "as the query orders them";

/** Orders by their words. @type {Record<string, string>} */
export const ORDERS = { "": "by trace", long: "longest first", short: "shortest first", random: "random",
  spread: "spread over traces" };

/** Numbers from 0 to 1 that are the same for the same number. @param {number} seed */
function shuffled(seed) {
  const mixed = Math.imul(seed ^ (seed >>> 15), 0x2c1b3c6d) ^ 0x9e3779b9;
  return ((Math.imul(mixed ^ (mixed >>> 12), 0x297a2d39) ^ (mixed >>> 15)) >>> 0) / 2 ** 32;
}

/** Matches in an order; the same ones in the order of the store if it is empty.
 * @param {Match[]} found @param {string} order */
export function ordered(found, order) {
  if (!(order in ORDERS) || !order) return found;
  /** @type {(m: Match, at: number) => number} */
  let rank = (m, at) => shuffled(at);
  if (order === "long" || order === "short") rank = (m) => (order === "long" ? m.start - m.end : m.end - m.start);
  if (order === "spread") {
    const many = new Map(), before = new Map();
    for (const { trace } of found) many.set(trace, (many.get(trace) || 0) + 1);
    rank = ({ trace }) => { // the middle of each trace first, then its quarters, …
      const n = before.get(trace) || 0;
      before.set(trace, n + 1);
      return halving(n, many.get(trace));
    };
  }
  return found.map((m, at) => ({ m, rank: rank(m, at), at })).sort((a, b) => a.rank - b.rank
    || a.at - b.at).map(({ m }) => m);
}

/** When the place n of many is reached if the longest gap is halved again and again. @param {number} n
 * @param {number} many */
function halving(n, many) {
  let low = 0, high = many, depth = 0;
  for (;;) {
    const middle = Math.floor((low + high) / 2);
    if (n === middle || high - low <= 1) return depth;
    if (n < middle) high = middle; else low = middle + 1;
    depth++;
  }
}

/** Matches of the same frames and the same nodes in another order, (a, b) and (b, a), as one with a count.
 * @param {Match[]} found @returns {{shown: Match[], many: Map<any, number>}} */
export function merged(found) {
  const first = new Map(), many = new Map(), shown = [];
  for (const m of found) {
    const nodes = Object.values(m.binding);
    if (nodes.length < 2) { shown.push(m); continue; }
    const key = `${m.trace}#${m.first}-${m.last}:${nodes.sort((a, b) => a - b).join()}`, known = first.get(key);
    if (known === undefined) { first.set(key, m.index); shown.push(m); } else many.set(known,
      (many.get(known) || 1) + 1);
  }
  return { shown: many.size ? shown : found, many };
}
