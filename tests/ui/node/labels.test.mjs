import assert from "node:assert/strict";
import test from "node:test";
import { match } from "./page.mjs";

const { meet, placed } = await import("../../../sgstore/apps/explorer/page/js/labels.js");
const { allHold, common, written } = await import("../../../sgstore/apps/explorer/page/js/lanes.js");
const { conditionsOf } = await import("../../../sgstore/apps/explorer/page/js/pattern.js");
const state = await import("../../../sgstore/apps/explorer/page/js/state.js");

/** Numbers from 0 to 1, the same in each run. */
function* random(seed = 7) {
  for (let at = seed; ; at = (at * 48271) % 2147483647) yield at / 2147483647;
}

test("no label lies on another one, and one without room is dropped", () => {
  const next = random(), one = () => next.next().value;
  for (let round = 0; round < 200; round++) {
    const box = () => ({ x: one() * 300, y: one() * 200, wide: 20 + one() * 60, high: 18 });
    const taken = [box(), box(), box()], before = [...taken];
    const labels = Array.from({ length: 14 }, () => [box(), box(), box()]);
    const found = placed(labels, taken, 2), shown = found.filter(Boolean);
    const apart = (a, b) => a.x + a.wide + 2 <= b.x || b.x + b.wide + 2 <= a.x || a.y + a.high + 2 <= b.y
      || b.y + b.high + 2 <= a.y;
    shown.forEach((a, i) => [...before, ...shown.slice(0, i)].forEach((b) => assert.ok(apart(a, b))));
    // What is dropped had no room beside those of higher priority.
    found.forEach((a, i) => { if (!a) for (const spot of labels[i]) {
      assert.ok([...before, ...found.slice(0, i).filter(Boolean)].some((b) => meet(spot, b, 2)));
    } });
    assert.deepEqual(taken, [...before, ...shown]);
  }
});

const lane = (text, more = {}) => ({ text, step: 0, call: "", conditions: [text], meanings: [text], spans: [],
  unknown: [], nodes: {}, ...more });

test("parts of one word of the library are one part as written", () => {
  const lanes = [lane("(a)-[:near]->(b)", { conditions: [], meanings: [] }), lane("a.speed > 1", { call: "moves(a)" }),
    lane("slow(b)", { meanings: ["b.speed < 3"] }), lane("NOT a.parked", { call: "moves(a)" }),
    lane("a.speed > 1", { call: "moves(a)", step: 1 })];
  assert.deepEqual(written(lanes).map(({ text, of }) => [text, of]),
    [["(a)-[:near]->(b)", [0]], ["moves(a)", [1, 3]], ["slow(b)", [2]], ["moves(a)", [4]]]);
  assert.deepEqual(conditionsOf(lanes).map(({ text, meanings }) => [text, meanings.map((one) => one.text)]),
    [["moves(a)", ["a.speed > 1", "NOT a.parked"]], ["slow(b)", ["b.speed < 3"]], ["moves(a)", ["a.speed > 1"]]]);
});

test("a part holds where all its lanes hold", () => {
  const runs = (bits) => {
    const found = [];
    bits.forEach((on, i) => { if (on && bits[i - 1]) found.at(-1)[1] = i; else if (on) found.push([i, i]); });
    return found;
  };
  const next = random(11);
  for (let round = 0; round < 200; round++) {
    const all = Array.from({ length: 3 }, () => Array.from({ length: 30 }, () => next.next().value > 0.3));
    assert.deepEqual(common(all.map(runs)), runs(all[0].map((_, i) => all.every((one) => one[i]))));
  }
  assert.deepEqual([allHold([true, true]), allHold([true, false, null]), allHold([true, null])], [true, false, null]);
});

test("the answer of a query with an order keeps it", () => {
  const found = [match(9, 9), match(1, 1, {}, { trace: "b" }), match(4, 4)];
  state.answer.value = { ...state.answer.value, matches: found, lists: "chosen" };
  assert.deepEqual(state.matches.value.map((m) => m.first), [9, 1, 4]);
});
