import assert from "node:assert/strict";
import test from "node:test";
import { about, asked, match, server, settled, TIMES } from "./page.mjs";

const state = await import("../../../sgstore/apps/explorer/page/js/state.js");
const data = await import("../../../sgstore/apps/explorer/page/js/data.js");
const api = await import("../../../sgstore/apps/explorer/page/js/api.js");
const clock = await import("../../../sgstore/apps/explorer/page/js/clock.js");

test("each frame has its own time, which is asked for once", async () => {
  state.store.value = about;
  assert.ok(Number.isNaN(data.timeAt("run", 3)));
  await settled();
  assert.deepEqual(TIMES.map((_, frame) => data.timeAt("run", frame)), TIMES);
  assert.deepEqual(data.timesOf(match(1, 3)), [0.1, 5]);
  assert.deepEqual(data.timesOf(match(1, 3, {}, { start: 0.1, end: 4.9 })), [0.1, 4.9]);
  assert.equal(asked.filter((path) => path.startsWith("api/static")).length, 1);
});

test("a time has its place among the frames", () => {
  const places = [[-1, 0], [0.05, 0.5], [0.2, 2], [2.6, 2.5], [5, 3], [9, 4]];
  for (const [time, place] of places) assert.ok(Math.abs(data.seqAt("run", time) - place) < 1e-9, `${time}`);
});

test("a second further is a second of the recording", () => {
  state.openFrame("run", 2);
  clock.goBy(1);
  assert.equal(state.seq.value, 3);
  clock.goBy(-1);
  assert.equal(state.seq.value, 2);
  clock.goBy(-1);
  assert.equal(state.seq.value, 0);
});

test("a report keeps to the time around its match", () => {
  state.offline.value = true;
  state.store.value = { ...about, around: 0.1 };
  state.openMatch(match(2, 2));
  clock.goTo(4);
  assert.equal(state.seq.value, 2);
  clock.goTo(0);
  assert.equal(state.seq.value, 1);
  state.offline.value = false;
});

test("what failed for a time is asked again", async () => {
  server.fails = true;
  data.forget();
  assert.equal(data.stillOf("run"), null);
  await settled();
  assert.match(api.trouble.value, /no network/);
  assert.equal(data.failureOf("run"), ""); // the page says it once
  server.fails = false;
  data.retry();
  data.stillOf("run");
  await settled();
  assert.equal(data.timeAt("run", 4), 5.1);
});

test("a busy server is no trouble, and is asked again", async () => {
  await api.look();
  const before = api.returns.value;
  server.busy = true;
  await assert.rejects(api.json("api/x"), (error) => state.isLost(error) && /are under way/.test(error.message));
  assert.equal(api.trouble.value, "");
  assert.equal(await api.look(), null);
  server.busy = false;
  await api.look();
  await api.look();
  assert.equal(api.returns.value, before + 1);
});
