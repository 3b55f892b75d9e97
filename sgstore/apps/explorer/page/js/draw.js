// @ts-check
// Scenes on a canvas, from columns: the road map, what stands and what moves, what is matched.
import { computed } from "../vendor/core.js";
import { kindOf, lightOf, mapOf, stillOf } from "./data.js";
import { meet, placed } from "./labels.js";
import { paints, traces } from "./state.js";

/** @typedef {import("./data.js").States} States */
/** @typedef {import("./data.js").Columns} Columns */
/** @typedef {{x: number, y: number, turn: number, scale: number, width: number, height: number}} Look */
/** @typedef {{src: number, dst: number, label: string, both: boolean, holds: boolean | null}} DrawnEdge */

/** @type {Record<string, string>} */
const LANES = {
  driving: "#c9d2df", sidewalk: "#efdfbf", walking: "#efdfbf", shoulder: "#cfc8ba", border: "#dedfcb",
    biking: "#b9e0cd",
  parking: "#bfdcf4", median: "#b9d49c", crosswalk: "#fdfdfb", stop: "#d9cdd4", curb: "#b8b09c",
    restricted: "#ebd0c6",
  bus: "#d3c6e4", taxi: "#d3c6e4", HOV: "#d3c6e4", tram: "#d3c6e4", rail: "#d3c6e4", none: "#e7eae9",
};
/** @type {Record<string, string>} */
const DARK_LANES = {
  driving: "#39424f", sidewalk: "#4a4233", walking: "#4a4233", shoulder: "#35332c", border: "#33352b",
    biking: "#2c4a3d",
  parking: "#2b4256", median: "#2f3d27", crosswalk: "#6d727b", stop: "#463b42", curb: "#3c3931",
    restricted: "#4a362f",
  bus: "#413655", taxi: "#413655", HOV: "#413655", tram: "#413655", rail: "#413655", none: "#22272c",
};
/** @type {Record<string, string>} */
const KINDS = {
  car: "#c2408f", vehicle: "#c2408f", truck: "#6d2468", bus: "#6d2468", trailer: "#6d2468", motorcycle: "#d873b5",
  bicycle: "#d873b5", person: "#e3115f", animal: "#e3115f", van: "#93307c", train: "#4a1a4c",
    traffic_light: "#3a4250",
  stop_sign: "#5a6b85", yield_sign: "#5a6b85", speed_limit: "#5a6b85", sign: "#5a6b85", prop: "#a9a39b",
    pole: "#a9a39b",
  barrier: "#a9a39b", building: "#d2cfc9", vegetation: "#c6d4ba", unknown: "#8f8a94",
};
/** @type {Record<string, string>} */
const DARK_KINDS = { ...KINDS, building: "#3d434c", vegetation: "#33432f", prop: "#5f5b56", pole: "#5f5b56",
  barrier: "#5f5b56" };
/** @type {Record<string, string>} */
const LIGHTS = { red: "#e5383b", red_yellow: "#ff8c1a", yellow: "#ffb703", green: "#2ec4a0", flashing: "#ffe08a",
  off: "#5a626f" };
export const SCENERY = new Set(["building", "vegetation", "prop", "pole", "barrier"]);

const CELL_REACH = 50; // m, from the middle of a square of arrows to its corner

const scheme = matchMedia("(prefers-color-scheme: dark)");
scheme.addEventListener("change", () => { paints.value++; });

/** Colours of the page, light or dark; looked for again when they change. */
const inks = computed(() => {
  const { theme } = document.documentElement.dataset, isDark = theme ? theme === "dark" : scheme.matches;
  const style = getComputedStyle(document.documentElement),
    of = (/** @type {string} */ name) => style.getPropertyValue(name).trim();
  return {
    at: paints.value, ink: of("--ink"), faint: of("--faint"), ego: of("--ego"), hold: of("--hold"),
      fail: of("--fail"),
    mark: of("--mark"), ground: of("--map-ground"), raised: of("--raised"), lanes: isDark ? DARK_LANES : LANES,
      kinds: isDark ? DARK_KINDS : KINDS,
    line: isDark ? "#59636f" : "#ffffff", stripe: isDark ? "#aeb6c1" : "#fdfdfb",
      arrow: isDark ? "#667180" : "#f7f9fb",
    grid: isDark ? "#232a31" : "#dfe4dd",
  };
});
/** @typedef {typeof inks.value} Inks */

/** Make the points of a canvas those of the screen; its size in points of the page.
 * @param {HTMLCanvasElement} canvas */
export function fitted(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 2), box = canvas.getBoundingClientRect();
  const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  return { width: width / ratio, height: height / ratio, ratio };
}

/** The axes of a trace on a canvas: metres, y to the left of x. @param {Look} look @param {number} [ratio] */
const axes = (look, ratio = 1) => new DOMMatrix([ratio, 0, 0, ratio, 0, 0]).translate(look.width / 2, look.height / 2)
  .scale(look.scale, -look.scale).rotate((look.turn * 180) / Math.PI).translate(-look.x, -look.y);

/** @param {CanvasRenderingContext2D} ctx @param {string} trace @param {Look} look @param {number} ratio
 * @param {Inks} ink @param {Set<number>} marked @param {Set<number>} lit @param {boolean} small */
function paintMap(ctx, trace, look, ratio, ink, marked, lit, small) {
  const map = mapOf(trace), about = traces.value.get(trace);
  if (!map || !about) return;
  const dx = map.origin[0] - about.origin[0], dy = map.origin[1] - about.origin[1];
  const reach = Math.hypot(look.width, look.height) / look.scale / 2;
  const x = look.x - dx, y = look.y - dy;
  ctx.setTransform(axes(look, ratio).translate(dx, dy));
  ctx.lineWidth = (small ? 0.5 : 0.9) / look.scale;
  ctx.strokeStyle = ink.line;
  for (const ring of map.rings) {
    const [x0, y0, x1, y1] = ring.box;
    if (x1 < x - reach || x0 > x + reach || y1 < y - reach || y0 > y + reach) continue;
    if (ring.stripes && !small) {
      ctx.fillStyle = ink.lanes.driving || "#888";
      ctx.fill(ring.path);
      ctx.fillStyle = ink.stripe;
      ctx.fill(ring.stripes);
    } else if (ring.closed) {
      ctx.fillStyle = ink.lanes[ring.word] || (ink.kinds[ring.word] ? `${ink.kinds[ring.word]}38` : ink.lanes.none
        || "#888");
      ctx.fill(ring.path);
      if (!small && ring.word === "driving") ctx.stroke(ring.path);
    } else if (!small) {
      ctx.strokeStyle = ink.kinds[ring.word] || ink.faint;
      ctx.stroke(ring.path);
      ctx.strokeStyle = ink.line;
    }
  }
  if (!small && look.scale > 2.5) {
    ctx.strokeStyle = ink.arrow;
    ctx.lineWidth = 0.18;
    for (const cell of map.arrows) if (Math.hypot(cell.x - x, cell.y - y) < reach + CELL_REACH) ctx.stroke(cell.path);
  }
  for (const node of [...marked, ...lit]) {
    if (node >= 0) continue;
    for (const ring of map.nodes.get(node) || []) {
      ctx.fillStyle = lit.has(node) ? `${ink.mark}b0` : `${ink.mark}55`;
      ctx.fill(ring.path);
      ctx.strokeStyle = ink.mark;
      ctx.lineWidth = 2 / look.scale;
      ctx.stroke(ring.path);
    }
  }
}

/** Lines each ten metres, where no road map is known. @param {CanvasRenderingContext2D} ctx @param {Look} look
 * @param {number} ratio @param {Inks} ink */
function paintGrid(ctx, look, ratio, ink) {
  const reach = Math.hypot(look.width, look.height) / look.scale / 2, step = look.scale < 0.8 ? 100 : 10;
  ctx.setTransform(axes(look, ratio));
  ctx.strokeStyle = ink.grid;
  ctx.lineWidth = 1 / look.scale;
  ctx.beginPath();
  for (let k = Math.ceil((look.x - reach) / step) * step; k < look.x + reach; k += step) { ctx.moveTo(k,
    look.y - reach); ctx.lineTo(k, look.y + reach); }
  for (let k = Math.ceil((look.y - reach) / step) * step; k < look.y + reach; k += step) { ctx.moveTo(look.x - reach,
    k); ctx.lineTo(look.x + reach, k); }
  ctx.stroke();
}

/** Rings around the ego, with their distances. @param {CanvasRenderingContext2D} ctx @param {States} states
 * @param {Look} look @param {number} ratio @param {Inks} ink */
function paintRings(ctx, states, look, ratio, ink) {
  const ego = egoRow(states);
  if (ego < 0) return;
  const { x, y } = axes(look).transformPoint({ x: states.columns.x[ego], y: states.columns.y[ego] });
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.strokeStyle = ctx.fillStyle = ink.faint;
  ctx.lineWidth = 0.8;
  ctx.globalAlpha = 0.55;
  ctx.setLineDash([4, 14]); // the time of a picture grows with the number of dashes
  ctx.font = "10.5px system-ui, sans-serif";
  ctx.textBaseline = "alphabetic";
  for (const far of [10, 20, 50, 100, 200].filter((m) => m * look.scale > 45
    && m * look.scale < Math.max(look.width, look.height))) {
    ctx.beginPath();
    ctx.arc(x, y, far * look.scale, 0, 7);
    ctx.stroke();
    ctx.fillText(`${far} m`, x + 4, y - far * look.scale - 3);
  }
  ctx.setLineDash([]);
  ctx.globalAlpha = 1;
}

/** Width and height of a traffic light; m. @param {number} scale @returns {[number, number]} */
const lightSize = (scale) => [Math.max(2.6, 20 / scale) * 0.46, Math.max(2.6, 20 / scale)];

/** How far the traffic lights of a frame stand aside, so that none covers another: row → m to the right.
 * @param {Columns} c @param {number} from @param {number} to @param {Look} look */
export function lightsAside(c, from, to, look) {
  const [wide, high] = lightSize(look.scale), place = axes(look), aside = new Map();
  /** @type {import("./labels.js").Box[]} */
  const taken = [];
  for (let i = from; i < to; i++) {
    if (kindOf(c.kind[i]) !== "traffic_light") continue;
    const { x, y } = place.transformPoint({ x: c.x[i], y: c.y[i] });
    const box = { x, y, wide: wide * look.scale, high: high * look.scale };
    while (taken.some((one) => meet(box, one))) box.x += box.wide * 1.1;
    taken.push(box);
    aside.set(i, (box.x - x) / look.scale);
  }
  return aside;
}

/** A traffic light as its housing with three lamps, upright on the screen. @param {CanvasRenderingContext2D} ctx
 * @param {string} state
 * @param {number} scale @param {number} turn back to upright @param {number} aside m to the right on the screen */
function paintLight(ctx, state, scale, turn, aside) {
  const [wide, high] = lightSize(scale), lamps = ["green", "yellow", "red"];
  const on = state === "red_yellow" ? ["red", "yellow"] : state === "flashing" ? ["yellow"] : [state];
  ctx.rotate(turn);
  ctx.translate(aside, 0);
  ctx.fillStyle = "#20262e";
  ctx.beginPath();
  ctx.roundRect(-wide / 2, -high / 2, wide, high, wide * 0.3);
  ctx.fill();
  ctx.lineWidth = 1 / scale;
  ctx.strokeStyle = "#8a94a3";
  ctx.stroke();
  lamps.forEach((lamp, i) => {
    ctx.fillStyle = on.includes(lamp) ? LIGHTS[lamp] || "#fff" : "#4a535f";
    ctx.beginPath();
    ctx.arc(0, (i - 1) * high * 0.3, high * 0.12, 0, 7);
    ctx.fill();
  });
  ctx.beginPath(); // its outline, where it is marked
  ctx.roundRect(-wide / 2, -high / 2, wide, high, wide * 0.3);
}

/** What the colours of a scene stand for: a colour, its form, and a word. @param {string} trace
 * @param {States | null} states
 * @returns {[string, string, string][]} */
export function legendOf(trace, states) {
  const ink = inks.value, c = states?.columns, kinds = new Set(), lights = new Set(), still = stillOf(trace)?.columns;
  for (let i = states?.from || 0; i < (states?.to || 0); i++) {
    if (!c || c.ego?.[i]) continue;
    const kind = kindOf(c.kind[i]);
    if (kind === "traffic_light") lights.add(lightOf(c.light?.[i] ?? 0)); else kinds.add(kind);
  }
  for (const code of still?.kind || []) kinds.add(kindOf(code));
  const words = new Set((mapOf(trace)?.rings || []).map((/** @type {any} */ ring) => ring.word));
  kinds.delete("traffic_light");
  return [
    ["ego", "box", ink.ego], ["bound in the match", "outline", ink.mark],
    ...[...kinds].sort().map((kind) => [kind, "box", ink.kinds[kind] || ink.kinds.unknown || ""]),
    ...[...lights].sort().map((state) => [`light: ${state}`, "dot", LIGHTS[state] || ink.faint]),
    ...[...words].filter((word) => ink.lanes[word]).sort().map((word) => [word === "crosswalk" ? word
      : `lane: ${word}`, "area", ink.lanes[word] || ""]),
    ["relation holds", "line", ink.hold], ["relation fails", "dashed", ink.fail],
  ].map(([word = "", form = "", colour = ""]) => [colour, form, word.replace(/_/g, " ")]);
}

/** @param {CanvasRenderingContext2D} ctx @param {Columns} c @param {number} i @param {number} scale
 * @param {Inks} ink @param {{marked: Set<number>, lit: Set<number>, chosen?: number | null, small?: boolean}} what
 * @param {number} turn @param {number} aside of a traffic light @param {Path2D} arrows gets one to the end ahead */
function paintEntity(ctx, c, i, scale, ink, what, turn, aside, arrows) {
  const kind = kindOf(c.kind[i]), node = c.node[i], ego = c.ego ? c.ego[i] : 0;
  const least = (what.marked.has(node) ? 7 : 3.5) / scale;
  const length = Math.max(c.length[i] || 0.5, least), width = Math.max(c.width[i] || 0.5, least * 0.7);
  const heading = Number.isFinite(c.heading[i]) ? c.heading[i] : 0;
  ctx.save();
  ctx.translate(c.x[i], c.y[i]);
  ctx.rotate(heading);
  ctx.fillStyle = ego ? ink.ego : ink.kinds[kind] || ink.kinds.unknown || "#888";
  if (kind === "traffic_light") ctx.fillStyle = LIGHTS[lightOf(c.light?.[i] ?? 0)] || ink.faint;
  if (SCENERY.has(kind)) ctx.globalAlpha = 0.55;
  const glyph = kind === "traffic_light" && !what.small;
  if (glyph) paintLight(ctx, lightOf(c.light?.[i] ?? 0), scale, -heading - turn, aside);
  else ctx.beginPath();
  if (glyph) { /* painted */ } else if (kind === "person" || kind === "traffic_light" || kind === "pole") {
    ctx.arc(0, 0, Math.max(length, width) / 2, 0, 7);
  } else {
    ctx.roundRect(-length / 2, -width / 2, length, width, Math.min(width, length) * 0.18);
  }
  if (!glyph) ctx.fill();
  if (what.marked.has(node) || what.lit.has(node) || what.chosen === node) {
    ctx.globalAlpha = 1;
    ctx.lineWidth = (what.lit.has(node) || what.chosen === node ? 4 : 2.6) / scale;
    ctx.strokeStyle = what.chosen === node ? ink.ink : ink.mark;
    ctx.stroke();
    ctx.lineWidth = 1 / scale;
    ctx.strokeStyle = ink.ink;
    ctx.stroke();
  }
  ctx.restore();
  if (width * scale > 7 && length > width && !glyph && !SCENERY.has(kind)) {
    const cos = Math.cos(heading), sin = Math.sin(heading);
    const corners = [[0.42 * length, 0], [0.18 * length, 0.32 * width], [0.18 * length, -0.32 * width]];
    corners.forEach(([ahead = 0, left = 0], k) => {
      const x = c.x[i] + ahead * cos - left * sin, y = c.y[i] + ahead * sin + left * cos;
      if (k) arrows.lineTo(x, y); else arrows.moveTo(x, y);
    });
  }
}

/** The first row of a frame that has a value; -1: none. @param {States} states @param {number} value
 * @param {string} [column] */
export function rowOf(states, value, column = "node") {
  const row = states.columns[column].subarray(states.from, states.to).indexOf(value);
  return row < 0 ? row : states.from + row;
}

/** @param {States} states */
export const egoRow = (states) => rowOf(states, 1, "ego");

/** A place of a node, of a part of the map too. @param {string} trace @param {States} states @param {number} node
 * @param {number[]} [near] where it should be near, of a long lane */
export function spotOf(trace, states, node, near) {
  const row = rowOf(states, node);
  if (row >= 0) return [states.columns.x[row], states.columns.y[row]];
  if (node >= 0) {
    const still = stillOf(trace)?.columns;
    const at = still ? still.node.indexOf(node) : -1;
    return at >= 0 ? [still.x[at], still.y[at]] : null;
  }
  const map = mapOf(trace), about = traces.value.get(trace), rings = map?.nodes.get(node);
  if (!rings || !about) return null;
  const dx = map.origin[0] - about.origin[0], dy = map.origin[1] - about.origin[1];
  const [x0, y0, x1, y1] = rings[0].box;
  const x = near ? Math.min(Math.max(near[0] ?? 0, x0 + dx), x1 + dx) : (x0 + x1) / 2 + dx;
  const y = near ? Math.min(Math.max(near[1] ?? 0, y0 + dy), y1 + dy) : (y0 + y1) / 2 + dy;
  return [x, y];
}

/** @param {CanvasRenderingContext2D} ctx @param {number[][]} points */
function strokeLine(ctx, points) {
  ctx.beginPath();
  for (const [x, y] of points) ctx.lineTo(x || 0, y || 0);
  ctx.stroke();
}

/** Paint a scene.
 * @param {CanvasRenderingContext2D} ctx @param {string} trace @param {States} states @param {Look} look
 * @param {number} ratio
 * @param {{marked: Set<number>, lit: Set<number>, chosen?: number | null, names?: Map<number, string>, edges?: DrawnEdge[],
 *   track?: number[][], small?: boolean}} what */
export function paintScene(ctx, trace, states, look, ratio, what) {
  const ink = inks.value;
  ctx.setTransform(1, 0, 0, 1, 0, 0);
  ctx.fillStyle = ink.ground;
  ctx.fillRect(0, 0, ctx.canvas.width, ctx.canvas.height);
  if (!traces.value.get(trace)?.map_key) paintGrid(ctx, look, ratio, ink);
  paintMap(ctx, trace, look, ratio, ink, what.marked, what.lit, !!what.small);
  if (states && !what.small) paintRings(ctx, states, look, ratio, ink);
  ctx.setTransform(axes(look, ratio));
  const reach = Math.hypot(look.width, look.height) / look.scale / 2 + 12;
  const still = stillOf(trace)?.columns, arrows = new Path2D();
  for (const [c, from, to] of [[still, 0, still?.node?.length || 0],
    [states?.columns, states?.from || 0, states?.to || 0]]) {
    if (!c) continue;
    const aside = what.small ? null : lightsAside(c, from, to, look);
    for (let i = from; i < to; i++) {
      if (Math.abs(c.x[i] - look.x) > reach || Math.abs(c.y[i] - look.y) > reach) continue;
      paintEntity(ctx, c, i, look.scale, ink, what, look.turn, aside?.get(i) || 0, arrows);
    }
  }
  ctx.fillStyle = "rgba(255,255,255,.75)";
  ctx.fill(arrows);
  if (what.track && what.track.length > 1) {
    ctx.strokeStyle = ink.ink;
    ctx.lineWidth = 1.4 / look.scale;
    ctx.setLineDash([4 / look.scale, 3 / look.scale]);
    strokeLine(ctx, what.track);
    ctx.setLineDash([]);
  }
  if (!states || what.small) return;
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  for (const edge of what.edges || []) paintEdge(ctx, trace, states, look, ink, edge);
  ctx.font = "600 12px system-ui, sans-serif";
  ctx.textBaseline = "middle";
  paintNames(ctx, trace, states, look, ink, what.names || new Map());
  paintScale(ctx, look, ink);
}

/** Names beside what they name, none of them on another, or on what another names. A name without room is left out;
 * the pointer shows it.
 * @param {CanvasRenderingContext2D} ctx @param {string} trace
 * @param {States} states @param {Look} look @param {Inks} ink @param {Map<number, string>} names */
function paintNames(ctx, trace, states, look, ink, names) {
  const place = axes(look), c = states.columns;
  const byPriority = [...names].sort(([a], [b]) => Number(b >= 0) - Number(a >= 0)); // entities before parts of the map
  const named = byPriority.flatMap(([node, name]) => {
    const at = spotOf(trace, states, node, [look.x, look.y]), row = rowOf(states, node);
    if (!at) return [];
    const angle = (c.heading[row] || 0) + look.turn, cos = Math.abs(Math.cos(angle)), sin = Math.abs(Math.sin(angle));
    const long = ((c.length[row] || 0) * look.scale) / 2, wide = ((c.width[row] || 0) * look.scale) / 2;
    return [{ name, at: place.transformPoint({ x: at[0], y: at[1] }), aside: long * cos + wide * sin,
      along: long * sin + wide * cos }];
  });
  const taken = named.map(({ at, aside, along }) => ({ x: at.x - aside, y: at.y - along, wide: 2 * aside,
    high: 2 * along }));
  const boxes = placed(named.map(({ name, at, aside }) => {
    const wide = ctx.measureText(name).width + 10, right = at.x + aside + 8, left = at.x - aside - 8 - wide;
    return [-24, 6, -46, 28, -68, 50].flatMap((down) => [right, left].map((x) => ({ x, y: at.y + down, wide,
      high: 18 })));
  }), taken, 3);
  named.forEach(({ name }, i) => {
    const box = boxes[i];
    if (!box) return;
    const { x, y, wide } = box;
    ctx.fillStyle = ink.raised;
    ctx.globalAlpha = 0.88;
    ctx.beginPath();
    ctx.roundRect(x, y, wide, 18, 5);
    ctx.fill();
    ctx.globalAlpha = 1;
    ctx.fillStyle = ink.ink;
    ctx.fillText(name, x + 5, y + 9.5);
  });
}

/** @param {CanvasRenderingContext2D} ctx @param {string} trace @param {States} states @param {Look} look
 * @param {Inks} ink @param {DrawnEdge} edge */
function paintEdge(ctx, trace, states, look, ink, edge) {
  const near = spotOf(trace, states, edge.src >= 0 ? edge.src : edge.dst);
  const from = spotOf(trace, states, edge.src, near || undefined),
    to = spotOf(trace, states, edge.dst, near || undefined);
  if (!from || !to) return;
  ctx.strokeStyle = edge.holds === false ? ink.fail : edge.holds ? ink.hold : ink.faint;
  ctx.lineWidth = edge.holds === null ? 1.2 : 2.2;
  ctx.setLineDash(edge.holds === false ? [5, 4] : []);
  strokeLine(ctx, [from, to].map(([x, y]) => axes(look).transformPoint({ x, y })).map(({ x, y }) => [x, y]));
  ctx.setLineDash([]);
}

/** A bar that says how long some metres are. @param {CanvasRenderingContext2D} ctx @param {Look} look
 * @param {Inks} ink */
function paintScale(ctx, look, ink) {
  const long = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((m) => m * look.scale > 50) || 1000;
  const x = 14, y = look.height - 16;
  ctx.strokeStyle = ctx.fillStyle = ink.ink;
  ctx.lineWidth = 1.5;
  strokeLine(ctx, [[x, y - 4], [x, y], [x + long * look.scale, y], [x + long * look.scale, y - 4]]);
  ctx.font = "11px system-ui, sans-serif";
  ctx.textBaseline = "alphabetic";
  ctx.fillText(`${long} m`, x + 4, y - 5);
}

/** A look that shows some nodes, the ego's heading up.
 * @param {string} trace @param {States} states @param {Iterable<number>} nodes @param {number} width
 * @param {number} height
 * @param {number} [most] how far it may reach; m @returns {Look} */
export function lookAt(trace, states, nodes, width, height, most = 70) {
  const ego = egoRow(states), c = states.columns;
  const centre = ego >= 0 ? [c.x[ego], c.y[ego]] : [c.x[states.from] || 0, c.y[states.from] || 0];
  const turn = ego >= 0 && Number.isFinite(c.heading[ego]) ? Math.PI / 2 - c.heading[ego] : 0;
  const spots = [...nodes].flatMap((node) => (node < 0 ? []
    : [spotOf(trace, states, node) || []])).filter((at) => at.length);
  // Half way between the ego and the middle of the nodes.
  const [x, y] = [0, 1].map((i) => (spots.length ? spots.reduce((sum, at) => sum + at[i],
    centre[i] * spots.length) / spots.length / 2 : centre[i]));
  const reach = Math.max(20, ...[...spots, centre].map((at) => Math.hypot(at[0] - x, at[1] - y) * 1.25 + 6));
  return { x, y, turn, scale: Math.min(width, height) / 2 / Math.min(reach, most), width, height };
}

/** The node at a place of the canvas. @param {States} states @param {Look} look @param {number} px
 * @param {number} py */
export function nodeAt(states, look, px, py) {
  const { x, y } = axes(look).inverse().transformPoint({ x: px, y: py }), c = states.columns;
  const lights = lightsAside(c, states.from, states.to, look), cos = Math.cos(look.turn), sin = Math.sin(look.turn);
  let best = -1, away = 8 / look.scale;
  for (let i = states.from; i < states.to; i++) {
    const aside = lights.get(i) || 0;
    const far = Math.hypot(c.x[i] + aside * cos - x, c.y[i] - aside * sin - y) - Math.max(c.length[i] || 0, 1) / 2;
    if (far < away) { best = c.node[i]; away = far; }
  }
  return best;
}
