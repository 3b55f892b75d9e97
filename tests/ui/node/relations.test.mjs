import assert from "node:assert/strict";
import test from "node:test";

const { linesOf } = await import("../../../sgstore/apps/explorer/page/js/relations.js");

const KINDS = ["car", "traffic_light", "lane"], STATES = ["red", "green", null];
/** Whole numbers below a limit, the same in each run. */
function* random(seed = 5) {
  for (let at = seed; ; at = (at * 48271) % 2147483647) yield at;
}
const next = random(), below = (limit) => next.next().value % limit;

/** A frame of 12 nodes with 60 edges, each of them once. */
function frame() {
  const nodes = Array.from({ length: 12 }, (_, id) => {
    const kind = KINDS[below(3)];
    return { id, kind, name: below(9) ? `${kind} ${id}` : undefined,
      ...(kind === "traffic_light" ? { light_state: STATES[below(3)] } : {}) };
  });
  const edges = new Map(Array.from({ length: 60 }, () => {
    const edge = { src: below(12), relation: ["near", "sees"][below(2)], dst: below(12) };
    return [JSON.stringify(edge), edge];
  }));
  return { nodes, edges: [...edges.values()] };
}

test("traffic lights of the same state at a node are one line with their count", () => {
  const nodes = [{ id: 1, kind: "car", name: "car 0" }, { id: -9, kind: "lane", name: "1/0/-1" },
    ...["red", "red", "green", "red"].map((light_state, i) => ({ id: 5 + i, kind: "traffic_light",
      name: `traffic_light ${5 + i}`, light_state }))];
  const edges = [5, 6, 7, 8].map((src) => ({ src, relation: "controlsTrafficOf", dst: -9 }));
  const told = linesOf([...edges, { src: 1, relation: "isIn", dst: -9 }], nodes, new Set([8, 1]));
  assert.deepEqual(told.map(({ src, relation, dst, count }) => [src.name, src.ids, relation, dst.name, count]), [
    ["traffic light · red", [5, 6], "controlsTrafficOf", "1/0/-1", 2],
    ["traffic_light 7", [7], "controlsTrafficOf", "1/0/-1", 1],
    ["traffic_light 8", [8], "controlsTrafficOf", "1/0/-1", 1], // bound: its own line
    ["car 0", [1], "isIn", "1/0/-1", 1]]);
});

test("no two lines say the same, and each edge is in one of them", () => {
  for (let round = 0; round < 200; round++) {
    const { nodes, edges } = frame(), bound = new Set([below(12)]), lines = linesOf(edges, nodes, bound);
    const texts = lines.map(({ src, relation, dst }) => `${src.name} ${relation} ${dst.name}`);
    assert.equal(new Set(texts).size, lines.length);
    assert.equal(lines.reduce((sum, { count }) => sum + count, 0), edges.length);
    for (const { src, relation, dst } of edges) {
      assert.equal(lines.filter((line) => line.relation === relation && line.src.ids.includes(src)
        && line.dst.ids.includes(dst)).length, 1);
    }
  }
});
