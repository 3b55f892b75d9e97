import assert from "node:assert/strict";
import test from "node:test";
import "./page.mjs";

const { conditionsOf, valueText } = await import("../../../sgstore/apps/explorer/page/js/pattern.js");

const of = (name, value, unit = "") => ({ name, value, unit });
const lane = (text, more = {}) => ({ text, step: 0, call: "", conditions: [text], meanings: [text], spans: [],
  unknown: [], nodes: {}, ...more });

test("the value of a condition has its unit, and its name where it is not clear", () => {
  assert.equal(valueText("dist(e, v) < 10", [of("dist(e, v)", 7.30001, "m")]), "7.3 m");
  assert.equal(valueText("slow(v)", [of("v.speed", 12345.67, "m/s")]), "v.speed: 12350 m/s");
  assert.equal(valueText("a.speed > b.speed", [of("a.speed", 2, "m/s"), of("b.speed", null)]),
    "a.speed: 2 m/s, b.speed: unknown");
  assert.equal(valueText("bearing(e, v) < 45", [of("bearing(e, v)", -3.25, "°")]), "-3.25°");
  assert.equal(valueText("v.parked", []), "");
});

test("a condition has the places of its values, a word of the library those of all its parts", () => {
  const lanes = [lane("(a)-[:near]->(b)", { conditions: [], meanings: [] }), lane("a.speed > 1", { call: "moves(a)" }),
    lane("slow(b) AND b.x > 2", { conditions: ["slow(b)", "b.x > 2"], meanings: ["b.speed < 3", "b.x > 2"] }),
    lane("NOT a.parked", { call: "moves(a)" })];
  assert.deepEqual(conditionsOf(lanes).map(({ text, at, meanings }) => [text, at, meanings.map((one) => one.at)]), [
    ["moves(a)", [[1, 0], [3, 0]], [[[1, 0]], [[3, 0]]]],
    ["slow(b)", [[2, 0]], [[[2, 0]]]],
    ["b.x > 2", [[2, 1]], []]]);
});
