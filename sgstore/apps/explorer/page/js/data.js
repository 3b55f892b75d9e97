// @ts-check
// Columns of states, maps and pictures as the page needs them: asked for once, kept while they are near.
import { signal } from "../vendor/core.js";
import * as api from "./api.js";
import { isLost, live, offline, span, store, traces } from "./state.js";

/** @typedef {import("./state.js").Match} Match */
/** Columns of states by name, and the rows that are of a frame.
 * @typedef {Record<string, any>} Columns @typedef {{columns: Columns, from: number, to: number}} States */

const CHUNK = 300; // frames that are asked for together
const KEPT = 30; // chunks that are kept
const AHEAD = 12; // pictures that are asked for before they are shown
const PICTURES = 120;

/** Counts what has come, so that what waits for it is drawn again. */
export const arrived = signal(0);

/** The place of an answer that has not come yet. */
class Under {}

/** What the server was asked for, by key; of more than `most` those go that were not used for the longest time.
 * @extends {Map<string, any>} */
class Kept extends Map {
  /** @param {number} [most] @param {(value: any) => void} [end] */
  constructor(most = Infinity, end = () => {}) {
    super();
    this.most = most;
    this.end = end;
  }

  /** Forget what failed for a time only. */
  retry() {
    for (const [key, value] of this) if (value?.failed?.lost) this.delete(key);
  }

  /** What is known of a key; asks for it if nothing is. @param {string} key @param {() => Promise<any>} ask */
  known(key, ask) {
    const found = this.get(key);
    if (found === undefined) {
      const under = new Under(); // what was asked before it was forgotten is not kept
      const tell = (/** @type {any} */ told) => {
        if (this.get(key) === under) { this.set(key, told); arrived.value++; }
      };
      this.set(key, under);
      ask().then(tell, (failed) => tell({ failed }));
    } else { // the one that was used last is the last to go
      this.delete(key);
      this.set(key, found);
    }
    this.trim();
    return found instanceof Under || found?.failed ? null : found || null;
  }

  trim() {
    for (const [key, value] of this) {
      if (this.size <= this.most) break;
      this.end(value);
      this.delete(key);
    }
  }
}

const maps = new Kept(), still = new Kept(), chunks = new Kept(KEPT), thumbs = new Kept(6000);
/** A report keeps all that it holds. */
export const keepAll = () => { chunks.most = Infinity; };
const pictures = new Kept(PICTURES, (found) => found?.image?.close());

/** Ask again for what the server could not answer for a time. */
export function retry() {
  for (const all of [maps, still, chunks, pictures]) all.retry();
  arrived.value++;
  ask();
}

/** Ask anew for all that is of the traces of the store, because it has changed. */
export function forget() {
  for (const all of [still, chunks, thumbs]) all.clear();
  for (const one of pictures.values()) pictures.end(one);
  pictures.clear();
  arrived.value++;
  wantThumbs(inSight);
}

/** Why something near a trace cannot be shown; empty: nothing failed, or the page says it above. @param {string} trace */
export function failureOf(trace) {
  const keys = [...chunks.keys()].filter((key) => key.startsWith(`${trace}\n`)).map((key) => chunks.get(key));
  const failed = [still.get(trace), ...keys].find((one) => one?.failed)?.failed;
  const reason = failed ? String(failed.message || failed) : "";
  return reason === api.trouble.value ? "" : reason; // it stands above the page
}

/** What a request calls a trace. @param {import("./state.js").Trace} about */
const of = (about) => (about.side ? { trace: about.name, side: about.side } : { trace: about.name });

/** The road map of a trace: each ring with its path, its box and its node.
 * @param {string} trace */
export function mapOf(trace) {
  const about = traces.value.get(trace);
  if (!about?.map_key) return null;
  return maps.known(about.map_key, async () => {
    const { header, columns } = await api.columns(api.address("api/map", of(about)));
    if (!columns.x) return { origin: [0, 0], rings: [], nodes: new Map(), arrows: [] };
    const rings = [], nodes = new Map();
    for (let i = 0; i + 1 < columns.start.length; i++) {
      const path = new Path2D(), [xs, ys] = [columns.x, columns.y].map((all) => all.subarray(columns.start[i],
        columns.start[i + 1]));
      xs.forEach((/** @type {number} */ x, /** @type {number} */ k) => path.lineTo(x, ys[k]));
      const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
      if (columns.closed[i]) path.closePath();
      const stripes = header.words[columns.word[i]] === "crosswalk" ? stripesOf(xs, ys) : null;
      const ring = { stripes, path, box, word: header.words[columns.word[i]], closed: columns.closed[i],
        node: columns.node[i] };
      rings.push(ring);
      if (!nodes.has(ring.node)) nodes.set(ring.node, []);
      nodes.get(ring.node).push(ring);
    }
    return { origin: header.origin, rings, nodes, arrows: arrowsOf(columns) };
  });
}

/** Stripes of a crosswalk, across its longest side. @param {Float32Array} xs @param {Float32Array} ys */
function stripesOf(xs, ys) {
  let long = 0, ux = 1, uy = 0;
  for (let i = 0; i + 1 < xs.length; i++) {
    const dx = (xs[i + 1] || 0) - (xs[i] || 0), dy = (ys[i + 1] || 0) - (ys[i] || 0), far = Math.hypot(dx, dy);
    if (far > long) { long = far; ux = dx / far; uy = dy / far; }
  }
  const along = [...xs].map((x, i) => x * ux + (ys[i] || 0) * uy),
    across = [...xs].map((x, i) => (ys[i] || 0) * ux - x * uy);
  const path = new Path2D(), low = Math.min(...across), high = Math.max(...across), end = Math.max(...along);
  for (let s = Math.min(...along) + 0.3; s < end - 0.3; s += 1.1) {
    const corners = [[s, low], [s + 0.55, low], [s + 0.55, high], [s, high]];
    corners.forEach(([a = 0, b = 0], k) => path[k ? "lineTo" : "moveTo"](a * ux - b * uy, a * uy + b * ux));
    path.closePath();
  }
  return path;
}

const CELL = 64; // m, of the arrows that are painted together

/** Arrows of the driving direction, by squares of the map. @param {Record<string, any>} columns */
function arrowsOf(columns) {
  /** @type {Map<string, {x: number, y: number, path: Path2D}>} */
  const cells = new Map(), { "arrow.x": xs = [], "arrow.y": ys = [], "arrow.angle": angles = [] } = columns;
  xs.forEach((/** @type {number} */ x, /** @type {number} */ i) => {
    const y = ys[i], cos = Math.cos(angles[i]), sin = Math.sin(angles[i]), cx = Math.round(x / CELL),
      cy = Math.round(y / CELL);
    const cell = cells.get(`${cx} ${cy}`) || { x: cx * CELL, y: cy * CELL, path: new Path2D() };
    cells.set(`${cx} ${cy}`, cell);
    [[-0.5, 0.55], [0.4, 0], [-0.5, -0.55]].forEach(([a = 0, b = 0],
      k) => cell.path[k ? "lineTo" : "moveTo"](x + a * cos - b * sin, y + a * sin + b * cos));
  });
  return [...cells.values()];
}

/** What never moves in a trace, the names of its entities, and the times of its frames. @param {string} trace */
export function stillOf(trace) {
  const about = traces.value.get(trace);
  return about ? still.known(trace, () => api.columns(api.address("api/static", of(about)))) : null;
}

// Time: that of each frame, as the store has it; no frame is where the period says --------------------------------

/** The time of a frame since its trace began; NaN: not known yet. @param {string} trace @param {number} frame */
export function timeAt(trace, frame) {
  if (live.value) return /** @type {number} */ (fed.get(frame)?.t ?? NaN);
  return /** @type {number} */ (stillOf(trace)?.columns.t[frame] ?? NaN);
}

/** Where a time is among the frames of a trace, with its fraction; NaN: not known yet.
 * @param {string} trace @param {number} time */
export function seqAt(trace, time) {
  const [first, count] = live.value ? [span.value[0], span.value[1] + 1]
    : [0, /** @type {number} */ (stillOf(trace)?.columns.t.length ?? 0)];
  return placeIn(first, count, time, (at) => timeAt(trace, at));
}

/** The place of a time among frames, by their times in order.
 * @param {number} first @param {number} end @param {number} time @param {(frame: number) => number} timeOf */
export function placeIn(first, end, time, timeOf) {
  if (first >= end) return NaN;
  let low = first, high = end - 1;
  if (time <= timeOf(low)) return low;
  if (time >= timeOf(high)) return high;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (timeOf(middle) <= time) low = middle; else high = middle;
  }
  const from = timeOf(low), to = timeOf(high);
  return to > from ? low + (time - from) / (to - from) : low;
}

/** Begin and end of a match: as the answer has them, or of its frames.
 * @param {Match} match @returns {[number, number]} */
export const timesOf = (match) => (Number.isFinite(match.start) ? [match.start, match.end]
  : [timeAt(match.trace, match.first), timeAt(match.trace, match.last)]);

/** A time in words. @param {number} time @param {number} [digits] */
export const seconds = (time, digits = 2) => (Number.isFinite(time) ? time.toFixed(digits) : "…");

/** The place of an entity as in the store; m. @param {string} trace @param {any} columns @param {number} row */
export function placeOf(trace, columns, row) {
  const [x, y] = traces.value.get(trace)?.origin || [0, 0];
  return [x + columns.x[row], y + columns.y[row]];
}

/** A person's name of a node. @param {string} trace @param {number} node */
export function nameOf(trace, node) {
  const about = stillOf(trace)?.header.names[node];
  return about ? `${about[0]} ${node}` : node < 0 ? `map ${-node}` : `${node}`;
}

// Frames of a monitor, as they come ---------------------------------------------------------------------------

const FED = 3000; // frames that are kept
/** @type {Map<number, any>} */
const fed = new Map();

/** Keep the states of the next frame; the first frame that is kept. @param {string} trace @param {number} seq
 * @param {any} header @param {any} columns */
export function feed(trace, seq, header, columns) {
  fed.set(seq, { columns, from: 0, to: columns.node.length, t: header.t, ego: header.ego });
  for (const old of fed.keys()) { if (fed.size <= FED) return old; fed.delete(old); }
  return seq;
}

/** Keep what stands, and names. @param {string} trace @param {any[][]} rows
 * @param {Record<string, string[]>} names */
export function feedStill(trace, rows, names) {
  const known = still.get(trace) || { rows: new Map(), header: { names: {} }, columns: null };
  Object.assign(known.header.names, names);
  for (const row of rows) known.rows.set(row[0], row);
  if (rows.length || !known.columns) {
    const all = [...known.rows.values()];
    known.columns = Object.fromEntries(["node", "kind", "x", "y", "heading", "length",
      "width"].map((name, i) => [name, all.map((row) => row[i])]));
  }
  still.set(trace, known);
}

/** Keep the small picture of a frame, for longer than its states. @param {string} trace @param {number} frame */
export function keepThumb(trace, frame) {
  const found = fed.get(frame);
  if (found) thumbs.set(`${trace}#${frame}`, found);
  thumbs.trim();
}

/** States of a frame: arrays, and the rows that are of it. @param {string} trace @param {number} frame */
export function statesAt(trace, frame) {
  if (live.value) return fed.get(frame) || null;
  const number = Math.floor(frame / CHUNK), key = `${trace}\n${number}`;
  const about = traces.value.get(trace);
  if (!about) return null;
  const found = chunks.known(key, async () => {
    const first = number * CHUNK, last = Math.min(first + CHUNK, about.frames) - 1;
    return (await api.columns(api.address("api/states", { ...of(about), first, last }))).columns;
  });
  const next = (number + 1) * CHUNK;
  if (frame - number * CHUNK > CHUNK * 0.6 && next < about.frames && !chunks.has(`${trace}\n${number + 1}`)) {
    statesAt(trace, next);
  }
  if (!found) return null;
  const row = frame - number * CHUNK;
  if (row >= found["frame.seq"].length) return null;
  return {
    columns: found, from: found["frame.start"][row], to: found["frame.start"][row + 1], ego: found["frame.ego"][row],
  };
}

// Small pictures: one request under way, which asks for what is in sight --------------------------------------

/** @type {[string, number][]} */
let wanted = [];
/** @type {[string, number][]} */
let inSight = [];
let asking = false;
const MANY = 60;

/** @param {string} trace @param {number} frame */
export function thumbOf(trace, frame) {
  return offline.value && !live.value ? statesAt(trace, frame) : thumbs.get(`${trace}#${frame}`) || null;
}

/** @param {[string, number][]} frames what is in sight, the first first */
export function wantThumbs(frames) {
  inSight = frames;
  wanted = offline.value ? [] : frames.filter(([trace, frame]) => !thumbs.has(`${trace}#${frame}`));
  ask();
}

async function ask() {
  if (asking || !wanted.length) return;
  asking = true;
  const side = traces.value.get(wanted[0]?.[0] || "")?.side;
  const now = wanted.filter(([trace]) => traces.value.get(trace)?.side === side).slice(0, MANY);
  wanted = wanted.filter((one) => !now.includes(one));
  try {
    const frames = now.map(([trace, frame]) => [traces.value.get(trace)?.name || trace, frame]);
    const { columns } = await api.columns("api/thumbs", side ? { frames, side } : { frames });
    let row = 0;
    now.forEach(([trace, frame], at) => {
      const from = row;
      while (row < columns.at.length && columns.at[row] === at) row++;
      thumbs.set(`${trace}#${frame}`, { columns, from, to: row });
    });
    thumbs.trim();
  } catch (error) {
    if (isLost(error)) { // asked again when the server answers
      wanted = [...now, ...wanted];
      asking = false;
      return;
    }
    for (const [trace, frame] of now) thumbs.set(`${trace}#${frame}`, { columns: null, from: 0, to: 0 });
  }
  asking = false;
  arrived.value++;
  ask();
}

// Pictures of cameras, asked for ahead ---------------------------------------------------------------------------

/** Pictures that are under way: of a monitor few, so that what comes late does not come ever later. */
let fetching = 0;

/** The picture at a frame, or the last one before it that is there.
 * @param {string} trace @param {string} channel @param {number} frame
 * @param {number} ahead frames a picture, 0: none */
export function pictureAt(trace, channel, frame, ahead) {
  const about = traces.value.get(trace);
  if (!about) return null;
  for (let i = 0; i <= (ahead ? AHEAD : 0); i++) {
    const at = frame + i * Math.max(ahead, 1);
    if (at < about.frames && !(live.value && fetching > 2)) fetchPicture(trace, channel, at);
  }
  for (let i = 0; i < 8; i++) {
    const found = pictures.get(`${trace}\n${channel}\n${frame - i}`);
    if (found?.image) return found;
    if (i === 0 && found?.failed) return found;
  }
  return null;
}

/** @param {string} trace @param {string} channel @param {number} seq */
function fetchPicture(trace, channel, seq) {
  pictures.known(`${trace}\n${channel}\n${seq}`, async () => {
    fetching++;
    const data = await api.blob(api.address("api/picture", { trace, channel, seq })).finally(() => { fetching--; });
    if (!data.size) throw new Error("no picture of this frame is kept");
    return { image: await createImageBitmap(data), seq };
  });
}

/** Name of a kind by its number. @param {number} code @returns {string} */
export const kindOf = (code) => store.value.codes.kind[code] || "unknown";
/** @param {number} code @returns {string} */
export const lightOf = (code) => store.value.codes.light[code] || "unknown";
