// @ts-check
// Lines of the list of relations: those that say the same are one line.

/** @typedef {{src: number, dst: number, relation: string}} Edge */
/** @typedef {{id: number, kind: string, name?: string, light_state?: string | null}} Node */
/** Nodes at an end of a line: what they are called together, and their ids.
 * @typedef {{name: string, ids: number[]}} End */

/** Edges as lines. Unbound traffic lights of the same state with the same relation to the same node are one line.
 * @param {Edge[]} edges @param {Node[]} nodes @param {Set<number>} bound nodes that have their own lines
 * @returns {{src: End, relation: string, dst: End, count: number}[]} */
export function linesOf(edges, nodes, bound) {
  const known = new Map(nodes.map((node) => [node.id, node])), lines = new Map();
  const nameOf = (/** @type {number} */ id) => known.get(id)?.name || String(id);
  const wordsOf = (/** @type {number} */ id) => {
    const node = known.get(id);
    return node?.kind === "traffic_light" && !bound.has(id) ? `traffic light · ${node.light_state || "unknown"}` : "";
  };
  for (const { src, relation, dst } of edges) {
    const key = JSON.stringify([wordsOf(src) || nameOf(src), relation, wordsOf(dst) || nameOf(dst)]);
    const line = lines.get(key) || { src: new Set(), relation, dst: new Set(), count: 0 };
    line.src.add(src);
    line.dst.add(dst);
    line.count++;
    lines.set(key, line);
  }
  const end = (/** @type {Set<number>} */ all) => {
    const ids = [...all], [first = 0] = ids;
    return { ids, name: ids.length > 1 ? wordsOf(first) || nameOf(first) : nameOf(first) };
  };
  return [...lines.values()].map((line) => ({ ...line, src: end(line.src), dst: end(line.dst) }));
}
