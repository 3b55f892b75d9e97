// @ts-check
// The nodes of a match and all that an edge joins to them, each where it lies: one hop of the graph of a frame.
import { h, htm, signal } from "../vendor/core.js";
import { panel } from "./clock.js";
import { egoRow, rowOf, SCENERY, spotOf } from "./draw.js";
import { placed } from "./labels.js";
import { chosen, lit, open } from "./state.js";

/** @typedef {import("./data.js").States} States */

const html = htm.bind(h);
const MOST = 16, ROOM = 5000; // nodes, and how much of the panel each has

/** How wide a node is drawn. @param {string} name */
const widthOf = (name) => Math.max(name.length * 6 + 14, 34);

/** Edges of the panel, which the view from above shows, too. */
export const hop = signal(/** @type {any[]} */ ([]));

/** One hop around some nodes: who is there, the nearest first, and how they are joined.
 * @param {any} graph @param {Set<number>} bound @param {(node: number) => number[] | null} placeOf
 * @param {number} most */
function hopOf(graph, bound, placeOf, most) {
  /** @type {Map<string, {src: number, dst: number, labels: Set<string>, both: boolean}>} */
  const pairs = new Map();
  for (const { src, dst, relation } of graph.edges) {
    if (src === dst || (!bound.has(src) && !bound.has(dst))) continue;
    const key = src < dst ? `${src} ${dst}` : `${dst} ${src}`,
      one = pairs.get(key) || { src, dst, labels: new Set(), both: false };
    one.labels.add(relation);
    one.both ||= one.src !== src;
    pairs.set(key, one);
  }
  const middle = [...bound].map(placeOf).find(Boolean) || [0, 0];
  const far = (/** @type {number} */ node) => { const at = placeOf(node); return at
    ? Math.hypot((at[0] || 0) - (middle[0] || 0), (at[1] || 0) - (middle[1] || 0)) : Infinity; };
  const kinds = new Map(graph.nodes.map((/** @type {any} */ n) => [n.id, n.kind]));
  const all = [...new Set([...pairs.values()].flatMap(({ src, dst }) => [src,
    dst]))].filter((node) => !bound.has(node) && Number.isFinite(far(node)));
  const met = all.filter((node) => !SCENERY.has(kinds.get(node)));
  // Whoever moves before parts of the map, the nearest first.
  const near = met.sort((a, b) => Number(a < 0) - Number(b < 0) || far(a) - far(b)).slice(0,
    Math.max(most - bound.size, 3));
  const shown = new Set([...bound, ...near]);
  return { shown: [...shown].filter((node) => placeOf(node)),
    edges: [...pairs.values()].filter(({ src, dst }) => shown.has(src) && shown.has(dst)),
    left: all.length - near.length };
}

/** Where nodes stand in the panel: in their direction, those far away less far. @param {number[]} nodes
 * @param {(node: number) => number[] | null} placeOf
 * @param {Set<number>} bound @param {number} turn @param {(node: number) => string} name
 * @param {[number, number]} size of the panel @returns {Map<number, import("./labels.js").Box>} */
function layout(nodes, placeOf, bound, turn, name, [WIDE, HIGH]) {
  const of = nodes.filter((n) => bound.has(n)).map((n) => placeOf(n) || [0, 0]), many = Math.max(of.length, 1);
  const cx = of.reduce((s, [x]) => s + (x || 0), 0) / many, cy = of.reduce((s, [, y]) => s + (y || 0), 0) / many;
  const spots = nodes.map((node) => {
    const [x, y] = placeOf(node) || [0, 0], dx = (x || 0) - cx, dy = (y || 0) - cy;
    const far = Math.sqrt(Math.hypot(dx, dy)), angle = Math.atan2(dy, dx) + turn;
    return { node, x: far * Math.cos(angle), y: -far * Math.sin(angle), wide: widthOf(name(node)) };
  });
  // The panel is filled both ways, as far as that does not twist directions too much: on a road all are ahead or behind.
  const wide = Math.max(...spots.map((p) => Math.abs(p.x)), 1),
    high = Math.max(...spots.map((p) => Math.abs(p.y)), 1);
  const down = Math.min((HIGH / 2 - 24) / high, 4 * (WIDE / 2 - 44) / wide),
    right = Math.min((WIDE / 2 - 44) / wide, 4 * down);
  for (const p of spots) { p.x = WIDE / 2 + p.x * right; p.y = HIGH / 2 + p.y * down; }
  // Nodes on one another step aside: up or down, and where that is full to the side.
  for (let round = 0; round < 60; round++) {
    for (const a of spots) for (const b of spots) {
      const dx = b.x - a.x, dy = b.y - a.y, besides = (a.wide + b.wide) / 2 + 4 - Math.abs(dx),
        below = 25 - Math.abs(dy);
      if (a === b || besides <= 0 || below <= 0) continue;
      const sign = (/** @type {number} */ d) => (d < 0 || (d === 0 && a.node < b.node) ? -0.5 : 0.5);
      const [right, down] = round < 20 ? [0, sign(dy) * below] : besides < below || round % 2
        ? [sign(dx) * besides, 0] : [0, sign(dy) * below];
      for (const [p, way] of /** @type {[typeof a, number][]} */ ([[a, -1], [b, 1]])) {
        p.x = Math.min(Math.max(p.x + way * right, p.wide / 2 + 2), WIDE - p.wide / 2 - 2);
        p.y = Math.min(Math.max(p.y + way * down, 14), HIGH - 14);
      }
    }
  }
  // A node that still lies on another one goes to the nearest free place; without one it is left out.
  const away = [...Array(9).keys()].flatMap((i) => [...Array(9).keys()].map((k) => [(i - 4) * 40, (k - 4) * 26]))
    .sort(([a = 0, b = 0], [c = 0, d = 0]) => Math.hypot(a, b) - Math.hypot(c, d));
  const boxes = placed(spots.map(({ x, y, wide }) => away.map(([right = 0, down = 0]) => ({
    x: Math.min(Math.max(x + right - wide / 2, 2), WIDE - wide - 2), y: Math.min(Math.max(y + down - 11, 3), HIGH - 25),
    wide, high: 22 }))), [], 2);
  return new Map(spots.flatMap(({ node }, i) => { const box = boxes[i]; return box ? [[node, box]] : []; }));
}

/** @param {{graph: any, states: States | null, north: boolean}} props */
export function Neighbours({ graph, states, north }) {
  const now = open.value, ego = states ? egoRow(states) : -1;
  if (!now || !states) return null;
  const keys = new Map(Object.entries(now.binding || {}).map(([key, node]) => [node, key]));
  const bound = new Set(keys.size ? keys.keys() : ego >= 0 ? [states.columns.node[ego]] : []);
  if (chosen.value !== null) bound.add(chosen.value);
  const about = new Map(graph.nodes.map((/** @type {any} */ n) => [n.id, n]));
  const near = [...bound].map((n) => rowOf(states, n)).filter((row) => row >= 0).map((row) => [states.columns.x[row],
    states.columns.y[row]])[0];
  const placeOf = (/** @type {number} */ node) => (about.has(node) ? spotOf(now.trace, states, node, near) : null);
  const heading = ego >= 0 ? states.columns.heading[ego] : NaN;
  const name = (/** @type {number} */ node) => (keys.get(node) || about.get(node)?.kind.replace(/_/g, " ")
    || String(node)).slice(0, 14);
  // As large as the panel is, so that words are neither small nor cut; in a wide or high one they are larger.
  const box = document.querySelector(".panel.pattern")?.getBoundingClientRect(), across = box?.width || 440,
    down = box?.height || 250, scale = Math.max(1, across / 620, Math.min(across / 400, down / 700));
  /** @type {[number, number]} */
  const size = [Math.max(across / scale - 18, 280), Math.max((down - 62) / scale, 110)];
  const { shown, edges, left } = hopOf(graph, bound, placeOf, Math.min(MOST, size[0] * size[1] / ROOM));
  const at = layout(shown, placeOf, bound, north || !Number.isFinite(heading) ? 0 : Math.PI / 2 - heading, name,
    size);
  const drawn = edges.filter(({ src, dst }) => at.has(src) && at.has(dst));
  const middleOf = (/** @type {number} */ node) => {
    const { x, y, wide, high } = at.get(node) || { x: 0, y: 0, wide: 0, high: 0 };
    return [x + wide / 2, y + high / 2];
  };
  // Names of relations: of the bound nodes and of what is pointed at first; of the others where they are few.
  const named = drawn.map((edge) => ({ ...edge, inside: bound.has(edge.src) && bound.has(edge.dst),
    on: lit.value.has(edge.src) && lit.value.has(edge.dst) })).filter(({ on, inside }) => on || inside || drawn.length < 5)
    .sort((a, b) => Number(b.inside) - Number(a.inside) || Number(b.on) - Number(a.on)).map((edge) => {
      const words = [...edge.labels], text = words.length > 2 && !edge.on ? `${words[0]} +${words.length - 1}`
        : words.join(", "), [ax = 0, ay = 0] = middleOf(edge.src), [bx = 0, by = 0] = middleOf(edge.dst);
      const wide = text.length * 5.6 + 4;
      return { ...edge, text, spots: [0.5, 0.4, 0.6, 0.3, 0.7].flatMap((part) => [-12, 2, -24, 14].map((down) => ({
        x: ax + (bx - ax) * part - wide / 2, y: ay + (by - ay) * part + down, wide, high: 12 }))) };
    });
  const words = placed(named.map(({ spots }) => spots), [...at.values()]);
  const hidden = left + shown.length - at.size;
  const told = drawn.map(({ src, dst, both, labels }) => ({ src, dst, both, label: [...labels].join(", "),
    holds: null }));
  queueMicrotask(() => { if (JSON.stringify(hop.peek()) !== JSON.stringify(told)) hop.value = told; });
  return html`<div class="scroll near"><svg viewBox=${`0 0 ${size[0]} ${size[1]}`} role="group"
    aria-label="Neighbours">
      ${drawn.map(({ src, dst, labels, both }) => {
        const [ax, ay] = middleOf(src), [bx, by] = middleOf(dst),
          inside = bound.has(src) && bound.has(dst), on = lit.value.has(src) && lit.value.has(dst);
        const words = [...labels];
        return html`<g class=${on || inside ? "holds" : "faint"} stroke="currentColor"
          onMouseEnter=${() => { lit.value = new Set([src, dst]); }} onMouseLeave=${() => { lit.value = new Set(); }}>
          <title>${`${name(src)} ${words.join(", ")} ${name(dst)}${both ? ", and back" : ""}`}</title>
            <path d=${`M${ax} ${ay}L${bx} ${by}`} stroke-width=${on ? 3 : inside ? 2 : 1} />
            <path d=${`M${ax} ${ay}L${bx} ${by}`} stroke="transparent" stroke-width="9" /></g>`;
      })}
      ${[...at].sort(([a], [b]) => Number(a >= 0) - Number(b >= 0)).map(([node, { x: left, y: top, wide }]) => {
        const one = name(node);
        return html`<g key=${node} style=${{ cursor: node >= 0 ? "pointer" : "default" }}
          role=${node >= 0 ? "button" : undefined} tabindex=${node >= 0 ? 0 : undefined}
          aria-label=${about.get(node)?.name || one}
          onKeyDown=${(/** @type {KeyboardEvent} */ e) => { if (node >= 0
            && e.key === "Enter") chosen.value = node; }} onMouseEnter=${() => { lit.value = new Set([node]); }}
            onMouseLeave=${() => { lit.value = new Set(); }}
          onClick=${() => { if (node >= 0) { chosen.value = node; panel.value = "near"; } }}><title>
            ${about.get(node)?.name || node}</title>
          <rect x=${left} y=${top} width=${wide} height="22" rx=${node < 0 ? 4 : 11}
            fill=${bound.has(node) ? "var(--soft)" : "var(--raised)"}
            stroke=${bound.has(node) ? "var(--mark)" : lit.value.has(node) ? "var(--accent)" : "var(--line)"}
            stroke-width=${bound.has(node) ? 2 : 1.2} />
          <text x=${left + wide / 2} y=${top + 14.5} font-size="10" font-weight=${bound.has(node) ? 600 : 400}
            text-anchor="middle" fill="var(--ink)">${one}</text></g>`;
      })}${named.map(({ on, inside, text }, i) => { // names of relations above all nodes
        const box = words[i];
        return box ? html`<text class="halo" x=${box.x + box.wide / 2} y=${box.y + 9.5}
          font-size="9.5" text-anchor="middle" pointer-events="none"
          fill=${on || inside ? "var(--hold)" : "var(--faint)"}>${text}</text>` : null;
      })}</svg>${hidden > 0 ? html`<p class="faint">and ${hidden} more: scenery, or farther away</p>` : null}</div>`;
}
