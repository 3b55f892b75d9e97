// @ts-check
// A match, or a frame: camera, view from above, the pattern, lanes of truth, all by one clock.
import { effect, h, htm, signal, useEffect, useLayoutEffect, useRef, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { copyCommand, copyLink } from "./address.js";
import { asked, askWhy, beside, camera, frame, holdsAt, lanes, nextMatch, others, panel, series, showSeries,
  why } from "./clock.js";
import { arrived, failureOf, kindOf, lightOf, nameOf, pictureAt, placeOf, seconds, statesAt,
  timeAt } from "./data.js";
import { egoRow, fitted, legendOf, lookAt, nodeAt, paintScene, rowOf } from "./draw.js";
import { hop, Neighbours } from "./neighbours.js";
import { PatternDrawing } from "./pattern.js";
import { linesOf } from "./relations.js";
import { ask, chosen, find, inOther, lit, live, offline, open, openFrame, paints, playing, rate, reasonOf, say,
  store, text, traces } from "./state.js";
import { Timeline } from "./timeline.js";

/** @typedef {import("./data.js").States} States */

const html = htm.bind(h);

/** What the user set of the view: how near, and how far aside. */
const zoom = signal({ factor: 1, dx: 0, dy: 0, north: false });
effect(() => { open.value?.trace; zoom.value = { ...zoom.peek(), dx: 0, dy: 0 }; });

/** Let a number be what it must be so that this frame may match, and ask again. @param {any} change */
function relax(change) {
  const query = [...text.value.trim()],
    now = open.value; // places count characters, strings of this page halves of some
  text.value = [...query.slice(0, change.start), change.text, ...query.slice(change.end)].join("");
  find({ keep: true }).then(() => { if (now) { why.value = null; openFrame(now.trace, frame.value, null); } });
}

// Camera ------------------------------------------------------------------------------------------------------

function Camera() {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const now = open.value, about = traces.value.get(now?.trace || "");
  arrived.value;
  const ahead = playing.value ? Math.max(1, Math.round(rate.value)) : 1;
  const picture = now && camera.value ? pictureAt(now.trace, camera.value, frame.value, ahead) : null;
  // What plays is never quite in time: there, a picture is late if more than two pictures are missing.
  const late = !picture?.failed && !(picture && frame.value - picture.seq <= (playing.value || live.value ? 2 * ahead
    : 0));
  useLayoutEffect(() => {
    const ctx = canvas.current?.getContext("2d");
    if (!canvas.current || !ctx || !picture?.image) return;
    const { width, height, ratio } = fitted(canvas.current), image = picture.image;
    const scale = Math.min(width / image.width, height / image.height);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    ctx.drawImage(image, (width - image.width * scale) / 2, (height - image.height * scale) / 2, image.width * scale,
      image.height * scale);
  });
  return html`<div class="panel camera">
    <div class="caption">${(about?.cameras.length || 0) > 1
      ? html`<select aria-label="Camera" value=${camera.value}
        onChange=${(/** @type {{target: HTMLInputElement}} */ e) => { camera.value = e.target.value; }}>
          ${about?.cameras.map((c) => html`<option>${c}</option>`)}</select>`
      : html`<span class="chip">${camera.value}</span>`}</div>
    <canvas ref=${canvas} class=${picture?.failed ? "failed" : late ? "late" : ""} role="img" aria-busy=${late}
      aria-label=${late ? "Camera picture of an earlier frame" : "Camera picture"} data-frame=${picture?.seq}></canvas>
    ${picture?.failed ? html`<div class="none">${reasonOf(picture.failed)}</div>` : null}
  </div>`;
}

// View from above ---------------------------------------------------------------------------------------------------

const legend = signal(false);

/** The node under the pointer, with its variable: its name may have no room in the view.
 * @param {{x: number, y: number, node: number, trace: string, states: States | null}} props */
function Tip({ x, y, node, trace, states }) {
  const row = states ? rowOf(states, node) : -1, c = states?.columns;
  if (row < 0 || !c) return null;
  const kind = kindOf(c.kind[row]), speed = Number.isFinite(c.speed[row]) ? ` · ${c.speed[row].toFixed(1)} m/s` : "";
  const more = kind === "traffic_light" ? ` · ${lightOf(c.light?.[row] ?? 0)}` : speed;
  const key = Object.entries(open.value?.binding || {}).find(([, bound]) => bound === node)?.[0];
  return html`<div class="tip" role="tooltip" style=${{ left: `${x + 12}px`, top: `${y + 12}px` }}>
    ${key ? `${key} · ` : ""}${nameOf(trace, node)}${more}</div>`;
}

/** What the colours and forms stand for. @param {{trace: string, states: States | null}} props */
const Legend = ({ trace, states }) => html`<ul class="legend" aria-label="Legend" tabindex="0">
  ${legendOf(trace, states).map(([colour, form, word]) => html`<li>
  <svg viewBox="0 0 22 12" aria-hidden="true">${form === "line" || form === "dashed"
    ? html`<path d="M1 6H21" stroke=${colour} stroke-width="2.4" stroke-dasharray=${form === "line" ? "" : "4 3"} />`
    : form === "dot" ? html`<circle cx="11" cy="6" r="5" fill=${colour} />`
    : html`<rect x="2" y="1" width="18" height="10" rx=${form === "area" ? 0 : 3}
      fill=${form === "outline" ? "none" : colour} stroke=${form === "outline" ? colour : "var(--line)"}
      stroke-width=${form === "outline" ? 2.4 : 1} />`}</svg>${word}</li>`)}</ul>`;

/** @param {{trace: string}} props */
function Above({ trace }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const look = useRef(/** @type {any} */ (null)), drag = useRef(/** @type {any} */ (null));
  const now = open.value, at = frame.value;
  const [, redraw] = useState(0),
    [tip, showTip] = useState(/** @type {{x: number, y: number, node: number} | null} */ (null));
  const states = statesAt(trace, at), about = traces.value.get(trace);
  const seen = useRef(/** @type {any} */ (null));
  if (states || seen.current?.trace !== trace) seen.current = states && { ...states, trace };
  useEffect(() => {
    const watch = new ResizeObserver(() => redraw((/** @type {number} */ n) => n + 1));
    if (canvas.current) watch.observe(canvas.current);
    return () => watch.disconnect();
  }, []);
  arrived.value; paints.value;
  const { factor, dx, dy, north } = zoom.value, marks = lit.value, picked = chosen.value,
    known = about?.side ? others.value : lanes.value;
  const bound = (about?.side ? known?.binding : now?.binding) || {},
    near = panel.value === "near" && !about?.side ? hop.value : [];
  useLayoutEffect(() => {
    const ctx = canvas.current?.getContext("2d");
    if (!canvas.current || !ctx || !now || !seen.current) return;
    const { width, height, ratio } = fitted(canvas.current), nodes = /** @type {number[]} */ (Object.values(bound));
    const base = lookAt(trace, seen.current, nodes, width, height);
    if (north) base.turn = 0;
    // The scale stays while it plays: it is that of the whole match.
    const kept = look.current?.key === `${now.trace} ${now.match?.index} ${width} ${height}` ? look.current : null;
    const reach = kept ? kept.base : base.scale;
    const cos = Math.cos(base.turn), sin = Math.sin(base.turn);
    const mine = { ...base, scale: reach * factor, x: base.x - (dx * cos + dy * sin),
      y: base.y - (-dx * sin + dy * cos) };
    look.current = { ...mine, base: reach, key: `${now.trace} ${now.match?.index} ${width} ${height}` };
    const holds = holdsAt(at, known), names = new Map(), edges = /** @type {any[]} */ ([...near]);
    for (const [key, node] of Object.entries(bound)) names.set(node,
      `${key} · ${(node < 0 && now.match?.names[key]) || nameOf(trace, node)}`);
    if (picked !== null && !names.has(picked)) names.set(picked, nameOf(trace, picked));
    (known?.lanes || []).forEach((/** @type {any} */ lane, /** @type {number} */ i) => {
      for (const edge of lane.edges) {
        const src = bound[edge.src], dst = bound[edge.dst];
        if (src !== undefined && dst !== undefined) edges.push({ ...edge, src, dst, holds: holds[i] });
      }
    });
    paintScene(ctx, trace, seen.current, mine, ratio, {
      marked: new Set(nodes), lit: marks, chosen: picked, names, edges,
        track: picked === null ? undefined : trackOf(trace, picked, at),
    });
  });
  const wheel = (/** @type {WheelEvent} */ e) => {
    if (document.documentElement.scrollHeight > innerHeight
      && !e.ctrlKey) return; // of a page in one column the wheel scrolls it
    e.preventDefault();
    zoom.value = { ...zoom.value, factor: Math.max(0.15, Math.min(12, factor * Math.exp(-e.deltaY / 500))) };
  };
  const down = (/** @type {PointerEvent} */ e) => {
    drag.current = { x: e.clientX, y: e.clientY, dx, dy, moved: false };
    canvas.current?.setPointerCapture(e.pointerId);
  };
  const move = (/** @type {PointerEvent} */ e) => {
    if (!drag.current && look.current && seen.current && canvas.current
      && e.pointerType === "mouse") { // what is under the pointer
      const box = canvas.current.getBoundingClientRect(), x = e.clientX - box.left, y = e.clientY - box.top,
        node = nodeAt(seen.current, look.current, x, y);
      if (node >= 0 || tip) showTip(node < 0 ? null : { x, y, node });
    }
    if (!drag.current || !look.current) return;
    const mx = e.clientX - drag.current.x, my = e.clientY - drag.current.y;
    if (Math.abs(mx) + Math.abs(my) > 4) drag.current.moved = true;
    if (drag.current.moved) zoom.value = { ...zoom.value, dx: drag.current.dx + mx / look.current.scale,
      dy: drag.current.dy - my / look.current.scale };
  };
  const up = (/** @type {PointerEvent} */ e) => {
    const held = drag.current;
    drag.current = null;
    if (!held || held.moved || !seen.current || !canvas.current) return;
    const box = canvas.current.getBoundingClientRect();
    const node = nodeAt(seen.current, look.current, e.clientX - box.left, e.clientY - box.top);
    chosen.value = node < 0 ? null : node;
    if (node >= 0) choose(node);
  };
  return html`<div class="panel above">
    <div class="caption">
      <button class="small" aria-pressed=${north} onClick=${() => { zoom.value = { ...zoom.value, north: !north }; }}>
        ${north ? "north up" : "heading up"}</button>
      <button class="small" aria-label="Nearer" onClick=${() => { zoom.value = { ...zoom.value,
        factor: factor * 1.4 }; }}>+</button>
      <button class="small" aria-label="Farther" onClick=${() => { zoom.value = { ...zoom.value,
        factor: factor / 1.4 }; }}>−</button>
      <button class="small" aria-pressed=${legend.value}
        onClick=${() => { legend.value = !legend.value; }}>legend</button>
      ${beside.value ? html`<span class="chip">${about?.side ? store.value.other.store : store.value.store}</span>`
        : null}
      ${factor !== 1 || dx || dy ? html`<button class="small"
        onClick=${() => { zoom.value = { factor: 1, dx: 0, dy: 0, north }; }}>reset</button>` : null}
    </div>
    <canvas ref=${canvas} role="img" aria-label=${about?.side ? "View from above, second store" : "View from above"}
      onWheel=${wheel} onPointerDown=${down} onPointerMove=${move} onPointerUp=${up}
      onPointerLeave=${() => showTip(null)}></canvas>
    ${!states && failureOf(trace) ? html`<div class="none" role="status">${failureOf(trace)}</div>` : null}
    ${tip ? html`<${Tip} ...${tip} trace=${trace} states=${seen.current} />` : null}${legend.value
      ? html`<${Legend} trace=${trace} states=${seen.current} />` : null}
  </div>`;
}

/** Places of a node around now, where they are known. @param {string} trace @param {number} node
 * @param {number} at */
function trackOf(trace, node, at) {
  const found = [];
  for (let s = Math.max(0, at - 100); s <= at + 100; s += 4) {
    const states = statesAt(trace, s), row = states ? rowOf(states, node) : -1;
    if (states && row >= 0) found.push([states.columns.x[row], states.columns.y[row]]);
  }
  return found;
}

// Pattern, tables ---------------------------------------------------------------------------------------------------

const OF_NODE = { speed: "m/s", accel: "m/s²", yaw_rate: "°/s", heading: "°", steer: "", brake: "" };
const PAIRS = { distance: "m", gap: "m", ttc: "s", headway: "s", bearing: "°", closing_speed: "m/s" };

function Details() {
  const tabs = [["pattern", "pattern"], ...(offline.value && !live.value ? []
    : [["near", "neighbours"], ["nodes", "nodes"], ["edges", "edges"]]),
    ...(chosen.value === null ? [] : [["node", nameOf(open.value?.trace || "", chosen.value)]])];
  const now = panel.value === "node" && chosen.value === null ? "pattern" : panel.value;
  return html`<div class="panel pattern">
    <div class="tabs" role="tablist">${tabs.map(([key, name]) => html`<button role="tab" aria-selected=${now === key}
      onClick=${() => { panel.value = key || "pattern"; }}>${name}</button>`)}</div>
    ${now === "pattern" ? html`<${PatternDrawing} lanes=${lanes.value} holds=${holdsAt(frame.value)} />`
      : now === "node" ? html`<${NodePanel} />` : html`<${GraphTable} what=${now} />`}
  </div>`;
}

function NodePanel() {
  const now = open.value, node = chosen.value, states = now ? statesAt(now.trace, frame.value) : null;
  if (!now || node === null) return null;
  const row = states ? rowOf(states, node) : -1, c = states?.columns, ego = states ? egoRow(states) : -1;
  const light = row >= 0 && c && kindOf(c.kind[row]) === "traffic_light";
  /** A value in words, of numbers; none where one of them is unknown. */
  const told = (/** @type {string} */ name, /** @type {number[]} */ values, /** @type {number} */ digits,
    /** @type {string} */ between, /** @type {string} */ unit) => (values.every(Number.isFinite)
    ? [[name, values.map((v) => v.toFixed(digits)).join(between) + unit]] : []);
  const about = row < 0 || !c ? [] : [...(light ? [["light", lightOf(c.light?.[row] ?? 0)]]
    : told("speed", [c.speed[row]], 2, "", " m/s")),
    ...told("heading", [(c.heading[row] * 180) / Math.PI], 1, "", "°"),
    ...told("size", [c.length[row], c.width[row]], 1, " × ", " m"),
    ...told("place", placeOf(now.trace, c, row), 2, ", ", " m")];
  const has = (/** @type {string} */ name,
    /** @type {number} */ of) => series.value.some((one) => one.attribute === name && one.node === of);
  const other = ego >= 0 && c && c.node[ego] !== node ? c.node[ego] : undefined;
  return html`<div class="scroll" style=${{ padding: "8px 12px" }}>
    <table><tbody>${about.map(([name, value]) => html`<tr><td class="faint">${name}</td><td>${value}</td>
      </tr>`)}</tbody></table>
    ${offline.value && !live.value ? null : html`<div class="row wrap" style=${{ marginTop: "8px" }}>
      ${light ? null : Object.entries(OF_NODE).map(([name, unit]) => html`<button class="small"
        aria-pressed=${has(name, node)} onClick=${() => showSeries(name, unit, node)}>${name}</button>`)}
      ${other === undefined ? null : Object.entries(PAIRS).map(([name, unit]) => html`<button class="small"
        aria-pressed=${has(name, other)} onClick=${() => showSeries(name, unit, other, node)}>
        ${name} from ego</button>`)}
    </div>
    ${live.value ? null : html`<p class="row wrap"><button class="small"
      onClick=${() => ask(`MATCH (e:Ego), (x) WHERE x.id = ${node} AND trace.name = '${now.trace.replace(/'/g,
      "\\'")}' AND dist(e, x) < 30`)}>as a query</button></p>`}`}
  </div>`;
}

/** Show a node: its values and its speed. @param {number} node */
function choose(node) {
  chosen.value = node;
  panel.value = "node";
  const states = open.value ? statesAt(open.value.trace, frame.value) : null, row = states ? rowOf(states, node) : -1;
  if (!states || row < 0 || kindOf(states.columns.kind[row]) !== "traffic_light") {
    showSeries("speed", "m/s", node, undefined, true); // a traffic light has no speed
  }
}

/** What lets nodes light up in the view while a row has the pointer or the focus. @param {number[]} nodes */
function lights(nodes) {
  const on = () => { lit.value = new Set(nodes); }, off = () => { lit.value = new Set(); };
  return { onMouseEnter: on, onMouseLeave: off, onFocusIn: on, onFocusOut: off };
}

/** A node in a table; parts of the map have no values. @param {{node: number, name: any}} props */
const NodeButton = ({ node, name }) => (node < 0 ? name : html`<button class="quiet small"
  onClick=${() => choose(node)}>${name}</button>`);

/** The nodes at one end of a line; several open to their names. @param {import("./relations.js").End} props */
const NodesCell = ({ name, ids }) => (ids.length < 2 ? html`<${NodeButton} node=${ids[0] || 0} name=${name} />`
  : html`<details><summary>${ids.length} × ${name}</summary>${ids.map((node) => html`<${NodeButton} node=${node}
    name=${nameOf(open.value?.trace || "", node)} />`)}</details>`);

/** @param {{what: string}} props */
function GraphTable({ what }) {
  const [graph, setGraph] = useState(/** @type {any} */ (null));
  const now = open.value, at = playing.value ? -1 : frame.value, want = useRef(""), busy = useRef(false);
  useEffect(() => { // one request at a time: of a monitor that goes on, the next one is for the frame of then
    if (!now || at < 0) return;
    want.current = api.address("api/frame", { trace: now.trace, seq: at });
    const ask = async () => {
      const asked = want.current;
      busy.current = true;
      try { setGraph(await api.json(asked)); } catch (error) { say(reasonOf(error)); }
      busy.current = false;
      if (want.current !== asked) ask();
    };
    if (!busy.current) ask();
  }, [now?.trace, at]);
  if (!graph) return html`<p class="faint" style=${{ padding: "8px 12px" }}>
    ${playing.value ? "pause to read the graph of a frame" : "…"}</p>`;
  if (what === "near") return html`<${Neighbours} graph=${graph}
    states=${now ? statesAt(now.trace, frame.value) : null} north=${zoom.value.north} />`;
  const bound = new Set(Object.values(now?.binding || {}));
  if (what === "edges") {
    const some = graph.edges.filter((/** @type {any} */ e) => !bound.size || bound.has(e.src) || bound.has(e.dst));
    const lines = linesOf(some, graph.nodes, bound);
    return html`<div class="scroll" tabindex="0"><table><thead><tr><th>from</th><th>relation</th><th>to</th></tr>
      </thead><tbody>
      ${lines.slice(0, 600).map(({ src, relation, dst, count }) => html`<tr ...${lights([...src.ids, ...dst.ids])}>
        <td><${NodesCell} ...${src} /></td><td>${relation}${count > Math.max(src.ids.length,
          dst.ids.length) ? ` ×${count}` : null}</td>
        <td><${NodesCell} ...${dst} /></td></tr>`)}</tbody></table>
      ${lines.length > 600 ? html`<p class="faint">600 of ${lines.length} lines</p>` : null}</div>`;
  }
  const listed = graph.nodes.filter((/** @type {any} */ n) => n.id >= 0).sort((/** @type {any} */ a,
    /** @type {any} */ b) => Number(bound.has(b.id)) - Number(bound.has(a.id)));
  return html`<div class="scroll" tabindex="0"><table><thead><tr><th>node</th><th>kind</th>
    <th class="number">speed (m/s)</th></tr></thead><tbody>
    ${listed.map((/** @type {any} */ n) => html`<tr class=${chosen.value === n.id ? "chosen" : ""}
      ...${lights([n.id])} onClick=${() => choose(n.id)}>
      <td><${NodeButton} node=${n.id} name=${n.name || n.id} /></td><td>${n.kind}</td><td class="number">
        ${n.speed === undefined || n.speed === null ? "" : `${n.speed.toFixed(1)}`}</td></tr>`)}</tbody></table>
        </div>`;
}

// All of it -----------------------------------------------------------------------------------------------------------

/** @param {{path: string}} props */
const Icon = ({ path }) => html`<svg class="icon" viewBox="0 0 14 14" aria-hidden="true">
  <path d=${path} fill="currentColor" /></svg>`;

function Transport() {
  const now = open.value, t = arrived.value >= 0 && now ? timeAt(now.trace, frame.value) : NaN;
  const told = why.value?.at === frame.value ? why.value : null,
    failing = told?.steps?.findIndex((/** @type {any} */ s) => s.failed) ?? -1, of = told?.steps?.length || 0,
    gap = told?.steps ? told.steps[failing] : told;
  return html`<div class="transport">
    <button aria-label="Match before" title="match before (p)" onClick=${() => nextMatch(-1)}>
      <${Icon} path="M3 2h2v10H3zM13 2v10L5.5 7z" /></button>
    <button class="main" aria-label=${playing.value ? "Pause" : "Play"} title="space"
      onClick=${() => { playing.value = !playing.value; }}><${Icon}
      path=${playing.value ? "M2 2h3.6v10H2zM8.4 2H12v10H8.4z" : "M3 1.5v11L12.5 7z"} /></button>
    <button aria-label="Next match" title="next match (n)" onClick=${() => nextMatch(1)}>
      <${Icon} path="M9 2h2v10H9zM1 2v10l7.5-5z" /></button>
    <select aria-label="Speed" value=${rate.value}
      onChange=${(/** @type {{target: HTMLInputElement}} */ e) => { rate.value = Number(e.target.value); }}>
      ${[0.25, 0.5, 1, 2, 4].map((r) => html`<option value=${r}>${r}×</option>`)}</select>
    <span class="time"><b>${now?.trace}</b>#${frame.value} · ${seconds(t)} s</span>
    <span class="grow"></span>
    ${traces.value.has(inOther(now?.trace || "")) ? html`<button aria-pressed=${beside.value}
      title="the second store by the same clock" onClick=${() => { beside.value = !beside.value; }}>Beside</button>`
      : null}
    ${offline.value && !now?.match?.pattern ? null : html`<button title="why does this frame match, or not (w)"
      aria-expanded=${told ? "true" : "false"}
      onClick=${() => { if (told) why.value = null; else askWhy(); }}>Why?</button>`}
    ${offline.value ? null : html`<button title="copy a link (y)" onClick=${copyLink}>Link</button>
      <button title="copy the command that opens this view (Y)" onClick=${copyCommand}>Command</button>`}
    ${live.value ? null : html`<button aria-label="Close" title="close (Esc)"
      onClick=${() => { playing.value = false; open.value = null; }}>×</button>`}
    ${told ? html`<span class="gap" role="status">${gap?.failed
      ? html`<span>${failing > 0 ? `step ${failing > 1 ? `1 to ${failing}` : "1"} of ${of} holds ·` : null}${" "}
        <b>${failing >= 0 ? `step ${failing + 1} of ${of} ` : null}fails</b> <code>${gap.failed}</code>
        ${gap.found ? html` · found <code>${gap.found}</code>` : null}</span>`
      : told.error ? told.error.reason : "all of it holds in this frame"}
      ${(told.relax || []).map((/** @type {any} */ change) => html`<button class="small"
        onClick=${() => relax(change)}>${[...asked.value].slice(change.start,
        change.end).join("")} → ${change.text}</button>`)}</span>` : null}
  </div>`;
}

export function Scene() {
  const trace = open.value?.trace || "", seen = traces.value.get(trace)?.cameras.length, other = inOther(trace);
  const both = beside.value && traces.value.has(other), place = useRef(/** @type {HTMLElement | null} */ (null)),
    now = open.value;
  useEffect(() => { // in one column it comes into sight
    if (document.documentElement.scrollHeight > innerHeight) place.current?.scrollIntoView({ block: "start" });
    if (document.activeElement?.closest(".gallery")) place.current?.focus({ preventScroll: true }); // opened by a key
  }, [now?.match, trace]);
  return html`<section class=${seen ? "scene" : "scene blind"} aria-label="Scene" tabindex="-1" ref=${place}>
    ${seen ? html`<${Camera} />` : null}<div class=${both ? "views both" : "views"}>
    <${Above} key=${trace} trace=${trace} />${both ? html`<${Above} key=${other} trace=${other} />` : null}</div>
    <${Details} /><${Timeline} /><${Transport} /></section>`;
}
