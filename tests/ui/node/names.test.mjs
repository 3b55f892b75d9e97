import assert from "node:assert/strict";
import test from "node:test";
import { about, match, settled } from "./page.mjs";

const state = await import("../../../sgstore/apps/explorer/page/js/state.js");
const data = await import("../../../sgstore/apps/explorer/page/js/data.js");

test("an entity is called by its kind and its number in the store", async () => {
  state.store.value = about;
  data.stillOf("run");
  await settled();
  assert.deepEqual([7, 8, -3].map((node) => data.nameOf("run", node)), ["car 7", "8", "map 3"]);
});

test("places are those of the store", () => {
  assert.deepEqual(data.placeOf("run", { x: [0.25], y: [-8] }, 0), [100.25, 42]);
});

test("matches of other frames or nodes have other keys", () => {
  const all = [match(1, 2, { a: 1 }), match(1, 3, { a: 1 }), match(1, 2, { a: 2 }), match(1, 2, { a: 1 }, { trace: "b" })];
  assert.equal(new Set(all.map(state.keyOf)).size, 4);
});

test("a trace of the second store has its own name", () => {
  state.store.value = { ...about, other: { ...about, store: "b.sgstore" } };
  assert.equal(state.traces.value.get(state.inOther("run")).side, "b");
  assert.equal(state.traces.value.get("run").side, undefined);
});
