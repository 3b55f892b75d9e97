// @ts-check
// Columns of states, maps and pictures as the page needs them: asked for once, kept while they are near.
import { signal } from "../vendor/core.js";
import * as api from "./api.js";
import { live, store, traces } from "./state.js";

/** @typedef {import("./state.js").Match} Match */

const CHUNK = 300; // frames that are asked for together
const KEPT = 30; // chunks that are kept
const AHEAD = 12; // pictures that are asked for before they are shown
const PICTURES = 120;

/** Counts what has come, so that what waits for it is drawn again. */
export const arrived = signal(0);

/** @type {Map<string, any>} */
const maps = new Map();
/** @type {Map<string, any>} */
const still = new Map();
/** @type {Map<string, any>} */
const chunks = new Map();
/** @type {Map<string, any>} */
const thumbs = new Map();
/** @type {Map<string, any>} */
const pictures = new Map();

/** What a request calls a trace. @param {import("./state.js").Trace} about */
const of = (about) => (about.side ? { trace: about.name, side: about.side } : { trace: about.name });

/** What is known of a key; asks for it if nothing is. @param {Map<string, any>} kept @param {string} key @param {() => Promise<any>} ask */
function known(kept, key, ask) {
  if (!kept.has(key)) {
    kept.set(key, null);
    ask().then((found) => { kept.set(key, found); arrived.value++; })
      .catch((error) => { kept.set(key, { failed: error }); arrived.value++; });
  }
  const found = kept.get(key);
  return found && !found.failed ? found : null;
}

/** The road map of a trace: each ring with its path, its box and its node.
 * @param {string} trace */
export function mapOf(trace) {
  const about = traces.value.get(trace);
  if (!about?.map_key) return null;
  return known(maps, about.map_key, async () => {
    const { header, columns } = await api.columns(api.address("api/map", of(about)));
    if (!columns.x) return { origin: [0, 0], rings: [], nodes: new Map() };
    const rings = [], nodes = new Map();
    for (let i = 0; i + 1 < columns.start.length; i++) {
      const path = new Path2D(), from = columns.start[i], to = columns.start[i + 1];
      /** @type {[number, number, number, number]} */
      const box = [Infinity, Infinity, -Infinity, -Infinity];
      for (let k = from; k < to; k++) {
        const x = columns.x[k], y = columns.y[k];
        if (k === from) path.moveTo(x, y); else path.lineTo(x, y);
        box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
        box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
      }
      if (columns.closed[i]) path.closePath();
      const ring = { path, box, word: header.words[columns.word[i]], closed: columns.closed[i], node: columns.node[i] };
      rings.push(ring);
      if (!nodes.has(ring.node)) nodes.set(ring.node, []);
      nodes.get(ring.node).push(ring);
    }
    return { origin: header.origin, rings, nodes };
  });
}

/** What never moves in a trace, and the names of its entities. @param {string} trace */
export function stillOf(trace) {
  const about = traces.value.get(trace);
  return about ? known(still, trace, () => api.columns(api.address("api/static", of(about)))) : null;
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

/** Keep the states of the next frame; the first frame that is kept. @param {string} trace @param {number} seq @param {any} header @param {any} columns */
export function feed(trace, seq, header, columns) {
  fed.set(seq, { columns, from: 0, to: columns.node.length, t: header.t, ego: header.ego });
  for (const old of fed.keys()) { if (fed.size <= FED) return old; fed.delete(old); }
  return seq;
}

/** Keep what stands, and names. @param {string} trace @param {any[][]} rows @param {Record<string, string[]>} names */
export function feedStill(trace, rows, names) {
  const known = still.get(trace) || { rows: new Map(), header: { names: {} }, columns: null };
  Object.assign(known.header.names, names);
  for (const row of rows) known.rows.set(row[0], row);
  if (rows.length || !known.columns) {
    const all = [...known.rows.values()];
    known.columns = Object.fromEntries(["node", "kind", "x", "y", "heading", "length", "width"].map((name, i) => [name, all.map((row) => row[i])]));
  }
  still.set(trace, known);
}

/** Keep the small picture of a frame, for longer than its states. @param {string} trace @param {number} frame */
export function keepThumb(trace, frame) {
  const found = fed.get(frame);
  if (found) thumbs.set(`${trace}#${frame}`, found);
}

/** States of a frame: arrays, and the rows that are of it. @param {string} trace @param {number} frame */
export function statesAt(trace, frame) {
  if (live.value) return fed.get(frame) || null;
  const number = Math.floor(frame / CHUNK), key = `${trace}\n${number}`;
  const about = traces.value.get(trace);
  if (!about) return null;
  const found = known(chunks, key, async () => {
    const first = number * CHUNK, last = Math.min(first + CHUNK, about.frames) - 1;
    return (await api.columns(api.address("api/states", { ...of(about), first, last }))).columns;
  });
  if (found) { // the one that was used last is the last to go
    chunks.delete(key);
    chunks.set(key, found);
    for (const old of chunks.keys()) {
      if (chunks.size <= KEPT) break;
      if (chunks.get(old)) chunks.delete(old);
    }
  }
  const next = (number + 1) * CHUNK;
  if (frame - number * CHUNK > CHUNK * 0.6 && next < about.frames && !chunks.has(`${trace}\n${number + 1}`)) {
    statesAt(trace, next);
  }
  if (!found) return null;
  const row = frame - number * CHUNK;
  if (row >= found["frame.seq"].length) return null;
  return {
    columns: found, from: found["frame.start"][row], to: found["frame.start"][row + 1],
    t: found["frame.t"][row], ego: found["frame.ego"][row],
  };
}

// Small pictures: one request under way, which asks for what is in sight --------------------------------------

/** @type {[string, number][]} */
let wanted = [];
let asking = false;
const MANY = 60;

/** @param {string} trace @param {number} frame */
export function thumbOf(trace, frame) {
  return thumbs.get(`${trace}#${frame}`) || null;
}

/** @param {[string, number][]} frames what is in sight, the first first */
export function wantThumbs(frames) {
  wanted = live.value ? [] : frames.filter(([trace, frame]) => !thumbs.has(`${trace}#${frame}`));
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
    if (thumbs.size > 6000) for (const key of [...thumbs.keys()].slice(0, 2000)) thumbs.delete(key);
  } catch (error) {
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
 * @param {string} trace @param {string} channel @param {number} frame @param {number} ahead frames a picture, 0: none */
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
  known(pictures, `${trace}\n${channel}\n${seq}`, async () => {
    fetching++;
    const data = await api.blob(api.address("api/picture", { trace, channel, seq })).finally(() => { fetching--; });
    if (!data.size) throw new Error("no picture of this frame is kept");
    return { image: await createImageBitmap(data), seq };
  });
  if (pictures.size > PICTURES) {
    for (const key of pictures.keys()) {
      if (pictures.size <= PICTURES) break;
      pictures.get(key)?.image?.close();
      pictures.delete(key);
    }
  }
}

/** Name of a kind by its number. @param {number} code @returns {string} */
export const kindOf = (code) => store.value.codes.kind[code] || "unknown";
/** @param {number} code @returns {string} */
export const lightOf = (code) => store.value.codes.light[code] || "unknown";
