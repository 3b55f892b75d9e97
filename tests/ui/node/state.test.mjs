import assert from "node:assert/strict";
import test from "node:test";
import { match } from "./page.mjs";

const state = await import("../../../sgstore/apps/explorer/page/js/state.js");
const { textOfTicks, ticksOf, quoted } = await import("../../../sgstore/apps/explorer/page/js/address.js");

test("parameters are words after $, but not in quotes and comments", () => {
  assert.deepEqual(state.namesIn("WHERE a.x > $low AND b = '$no' -- $not\n AND c < $low"), ["low"]);
  state.values.value = { low: "3.5", is: "true", name: "x y", other: "1" };
  assert.deepEqual(state.parametersOf("$low $is $name"), { low: 3.5, is: true, name: "x y" });
});

test("frames in several matches count once", () => {
  state.answer.value = { ...state.answer.value, matches: [match(0, 4), match(2, 6), match(9, 9, {}, { trace: "b" })] };
  assert.deepEqual(state.framesFound.value, { frames: 8, traces: 2 });
});

test("many matches are ticked in one update", () => {
  let updates = -1;
  const stop = state.ticked.subscribe(() => { updates++; });
  state.tickAll(Array.from({ length: 22560 }, (_, i) => match(i, i + 3, { a: i })));
  assert.deepEqual([updates, state.ticked.value.size], [1, 22560]);
  state.tick(match(5, 8, { a: 5 }));
  assert.equal(state.ticked.value.size, 22559);
  stop();
});

test("ticked matches survive as text", () => {
  const all = [match(10, 40, { e: 0, "a b": -3 }), match(7, 7, { e: 12345, "a b": 1 }), match(3, 5),
    match(1, 2, { x: 1 }, { trace: "*odd_name.*%2A #" })];
  const found = ticksOf(textOfTicks(all));
  assert.deepEqual([...found.keys()], all.map(state.keyOf));
  assert.deepEqual([...found.values()].map((one) => one.binding), all.map((one) => one.binding));
  assert.equal(ticksOf("%*x*zz.!_a").size, 0);
  assert.equal(ticksOf("").size, 0);
});

test("words of a shell are quoted where they must be", () => {
  assert.equal(quoted("/data/drives.sgstore"), "/data/drives.sgstore");
  assert.equal(quoted("it's here"), "'it'\\''s here'");
});

test("a check is told from a pattern, whatever stands before it", () => {
  state.library.value = [{ name: "phi1", kind: "property" }, { name: "cut_in", kind: "scenario" }];
  for (const text of ["CHECK ALWAYS a.x < 1", "USING RANGE 200\nCHECK c: ALWAYS a.x < 1", " phi1 ",
    "-- MATCH\nDEFINE f(a) AS EXISTS {MATCH (a)}; USING END pending CHECK f(ego)"]) {
    assert.ok(state.isCheck(text), text);
    assert.ok(!state.isPattern(text), text);
  }
  for (const text of ["MATCH (check:Car)", "cut_in", "USING RANGE 9 MATCH (x) WHERE x.name = 'CHECK' -- CHECK"]) {
    assert.ok(!state.isCheck(text), text);
    assert.ok(state.isPattern(text), text);
  }
  assert.ok(!state.isCheck("SELECT 1") && !state.isPattern("SELECT 1"));
  state.library.value = [];
});
