// @ts-check
// A monitor that runs: the scene of each frame as it comes, what checks and patterns become, lanes of what was found.
import { batch, effect, h, htm, render, signal } from "../vendor/core.js";
import * as api from "./api.js";
import { frame, range, refresh } from "./clock.js";
import { feed, feedStill, keepThumb, retry, timeAt } from "./data.js";
import { Gallery } from "./gallery.js";
import { Above, keys } from "./keys.js";
import { Scene } from "./scene.js";
import { answer, dialog, following, live, offline, open, playing, reasonOf, seq, span, store } from "./state.js";
import { Bars } from "./timeline.js";
import { bytesOf, unpacked } from "./wire.js";

const html = htm.bind(h);
const TILES = 300; // events that are shown as small pictures, the last ones

/** What is told of each check and pattern, by name: its state, and where it was violated or found. */
/** @typedef {{state: string, many: number, spans: number[][], open: Map<string, number[]>}} Told */
const told = signal(/** @type {Record<string, Told>} */ ({}));
const ended = signal(/** @type {any} */ (null));
const lost = signal(false);
let count = 0;

const of = (/** @type {string} */ name) => told.value[name] || { state: "", many: 0, spans: [], open: new Map() };

/** What the server says first, and again if the line was cut. @param {any} hello */
function begin(hello) {
  const again = store.value !== null;
  batch(() => {
    feedStill(hello.about.store, hello.still, hello.names);
    lost.value = false;
    if (again) { retry(); return; }
    live.value = offline.value = following.value = true;
    store.value = hello.about;
    told.value = Object.fromEntries([...hello.about.checks, ...hello.about.patterns].map((name) => [name, of(name)]));
    answer.value = { ...answer.value, state: "live", matches: [] };
    open.value = { trace: hello.about.store, match: null, binding: null };
  });
}

/** @param {import("./wire.js").Columns} found */
function step({ header, columns }) {
  const trace = store.value.store, at = header.seq;
  if (at <= span.value[1] && count) return; // the line was cut, and this was told before
  count++;
  const kept = feed(trace, at, header, columns);
  feedStill(trace, header.still, header.names);
  batch(() => {
    const trace = { ...store.value.traces[0], frames: at + 1, seconds: header.t, origin: header.origin };
    store.value = { ...store.value, traces: [trace] };
    span.value = [kept, at];
    for (const [name,
      state] of Object.entries(header.status)) if (of(name).state !== state) told.value = { ...told.value,
      [name]: { ...of(name), state } };
    take(header.events);
    if (following.value) seq.value = at;
  });
}

/** Events become tiles, and stretches of the lanes of what they are of. @param {any[]} events */
function take(events) {
  if (!events.length) return;
  const tiles = [], next = { ...told.value };
  for (const event of events) {
    const one = (next[event.name] = { ...of(event.name), ...next[event.name] }), key = JSON.stringify(event.nodes);
    if (event.kind === "kept again") {
      const begun = one.open.get(key);
      if (begun) begun[1] = event.last - 1;
      one.open.delete(key);
      continue;
    }
    const stretch = [event.first, event.kind === "violated" ? Infinity : event.last];
    if (event.kind === "violated") one.open.set(key, stretch);
    one.spans = [...one.spans.slice(-500), stretch];
    one.many++;
    keepThumb(store.value.store, event.first);
    tiles.unshift({
      trace: store.value.store, first: event.first, last: event.last, start: event.start, end: event.end,
        binding: event.nodes,
      names: { statement: event.name, ...event.names }, values: event.values, index: event.name + key + event.first,
        pattern: event.kind === "found" ? event.name : "",
    });
  }
  told.value = next;
  answer.value = { ...answer.value, matches: [...tiles, ...answer.value.matches].slice(0, TILES) };
}

function Head() {
  const [from, to] = span.value, kept = timeAt(store.value.store, to) - timeAt(store.value.store, from);
  return html`<header><span class="brand"><img src="static/icon.svg" alt="" />sgstore</span>
    <h1>${store.value.store} · ${ended.value ? "it has ended" : lost.value ? "the monitor does not answer"
      : "live"} · ${(to + 1).toLocaleString("en")} frames${from > 0 ? `, the last ${kept.toFixed(0)} s are kept`
      : ""}</h1>
    <span class="grow"></span>
    ${ended.value ? null : html`<button class=${following.value ? "main" : ""} aria-pressed=${following.value}
      onClick=${follow}>${following.value ? "Live" : "Back to live"}</button>`}
    <button class="quiet" onClick=${() => { dialog.value = "keys"; }}><kbd>?</kbd> keys</button></header>`;
}

function follow() {
  batch(() => { playing.value = false; following.value = true; seq.value = span.value[1]; });
}

/** A lane for each check and pattern: where it was violated, or found. */
function Statements() {
  const [from, to] = range.value, checks = new Set(store.value.checks);
  const verdicts = new Map((ended.value?.verdicts || []).map((/** @type {any[]} */ one) => [one[0], one]));
  return html`<section class="timeline statements" aria-label="Checks and patterns">
    ${Object.entries(told.value).map(([name, one]) => {
    const check = checks.has(name), state = verdicts.get(name)?.[1] || one.state, bad = /false/.test(state);
    const spans = one.spans.filter(([, z]) => (z ?? 0) >= from).map(([a, z]) => [Math.max(a ?? 0, from),
      Math.min(z ?? 0, to)]);
    return html`<div class="lane" key=${name} data-statement=${name}>
      <div class="label" title=${verdicts.get(name)?.[3] || ""}><b>${name}</b>
        <span class=${!check || state === "unknown" ? "faint" : bad ? "fails" : "holds"}> ${check
          ? `${state.replace("_", " ")}${one.many ? ` · ${one.many} ${one.many === 1 ? "violation" : "violations"}`
          : ""}` : `${one.many} found`}</span></div>
      <${Bars} spans=${spans} kind=${() => (check ? "bar-fail" : "bar-match")} /></div>`;
  })}</section>`;
}

function Live() {
  return html`<${Head} /><${Statements} /><main class="open">
    <${Gallery} found=${answer.value.matches} word=${["event", "events"]}
    none=${"What is found, and what is violated, stands here as it comes."} /><${Scene} /></main><${Above} />`;
}

keys.splice(keys.findIndex(([one]) => one === "x"), 1);
keys.push(["l", "follow what comes", { l: follow }]);

async function run() {
  const place = /** @type {HTMLElement} */ (document.getElementById("app"));
  const events = new EventSource("api/live");
  events.addEventListener("hello",
    (event) => {
      begin(JSON.parse(event.data));
      if (place.dataset.on) return;
      place.dataset.on = "1";
      place.textContent = "";
      render(html`<${Live} />`, place);
    });
  events.addEventListener("frame", (event) => step(unpacked(bytesOf(event.data).buffer)));
  events.addEventListener("end",
    (event) => {
      ended.value = JSON.parse(event.data);
      following.value = false;
      take(ended.value.events);
      events.close();
    });
  events.addEventListener("error", () => { lost.value = !ended.value; });
  // Whoever looks at another frame does not follow; whoever plays to the end does again.
  effect(() => { const at = frame.value,
    last = span.peek()[1]; if (at !== last) following.value = false; else if (playing.peek()) follow(); });
  effect(() => { if (!open.value && store.value) open.value = { trace: store.value.store, match: null,
    binding: null }; });
  setInterval(() => { if (!ended.value) refresh(); }, 500);
}

api.json("api/store").then(run,
  (error) => { const place = document.getElementById("app"); if (place) place.textContent = reasonOf(error); });
