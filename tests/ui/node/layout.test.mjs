import assert from "node:assert/strict";
import test from "node:test";
import { match } from "./page.mjs";

const { ordered, ORDERS } = await import("../../../sgstore/apps/explorer/page/js/order.js");
const { layout, moved } = await import("../../../sgstore/apps/explorer/page/js/gallery.js");

test("tiles stand in rows below the name of their trace", () => {
  const found = [...Array(5).keys()].map((i) => match(i, i)).concat(match(9, 9, {}, { trace: "b" }));
  const { rows, across, wide, height } = layout(found, 700);
  assert.equal(across, 3);
  assert.ok(3 * (wide + 12) + 12 <= 700);
  assert.deepEqual(rows.map((row) => [row.group, row.first, row.last]),
    [["run", 0, 0], ["", 0, 3], ["", 3, 5], ["b", 5, 5], ["", 5, 6]]);
  rows.slice(1).forEach((row, i) => assert.ok(row.top >= rows[i].top + rows[i].height));
  assert.ok(height >= rows.at(-1).top + rows.at(-1).height);
  assert.equal(layout(found, 100).across, 1);
  assert.ok(layout(found, 2560).wide > 300);
  assert.equal(layout([], 700).rows.length, 0);
});

test("arrow keys lead through the rows", () => {
  const { rows } = layout([...Array(8).keys()].map((i) => match(i, i)), 700);
  const to = (at, key) => moved(rows, at, key, 2);
  assert.deepEqual([to(1, "ArrowDown"), to(4, "ArrowDown"), to(7, "ArrowUp"), to(0, "ArrowLeft")], [4, 7, 4, 0]);
  assert.deepEqual([to(0, "End"), to(5, "Home"), to(0, "PageDown")], [7, 0, 6]);
});

test("each order has all matches, and sorts them as its word says", () => {
  const found = [...Array(40).keys()].map((i) => match(i, i + ((i * 7) % 13), {}, { trace: i < 30 ? "a" : i < 38 ? "b" : "c",
    start: i, end: i + ((i * 7) % 13) }));
  const places = (order) => ordered(found, order).map((m) => m.index), lasts = (order) => ordered(found, order)
    .map((m) => m.end - m.start), upward = (all) => all.every((one, i) => !i || all[i - 1] <= one);
  for (const order of Object.keys(ORDERS)) {
    assert.deepEqual(places(order).toSorted((a, b) => a - b), found.map((m) => m.index));
    assert.deepEqual(places(order), places(order)); // the same each time
  }
  assert.deepEqual(places(""), found.map((m) => m.index));
  assert.ok(upward(lasts("short")) && upward(lasts("long").toReversed()));
  assert.ok(!upward(places("random")) && !upward(places("random").toReversed()));
  // Spread: the first ones are of all traces, and from the middle of each.
  assert.deepEqual(ordered(found, "spread").slice(0, 3).map((m) => m.trace).toSorted(), ["a", "b", "c"]);
  assert.deepEqual(ordered(found, "spread").slice(0, 2).map((m) => m.index), [15, 34]);
});
