// @ts-check
// The pattern as a small drawing that stays still, while its edges and conditions turn ✓ or ✗.
import { h, htm, useMemo } from "../vendor/core.js";
import { frame, measured } from "./clock.js";
import { allHold, written } from "./lanes.js";
import { lit, open } from "./state.js";

const html = htm.bind(h);

/** Places of nodes, the same for the same pattern: paths on a line, from end to end; anything else on a circle.
 * On a line the nodes are so far apart that the longest label fits between them.
 * @param {string[]} keys @param {{src: string, dst: string, label: string}[]} edges */
function places(keys, edges) {
  const near = new Map(keys.map((key) => [key, new Set()]));
  for (const { src, dst } of edges) if (src !== dst) { near.get(src)?.add(dst); near.get(dst)?.add(src); }
  const order = [], left = new Set(keys), many = (/** @type {string} */ key) => near.get(key)?.size || 0;
  let straight = keys.length <= 4;
  while (left.size) {
    let key = [...left].sort((a, b) => many(a) - many(b))[0] || "";
    while (key) {
      left.delete(key);
      order.push(key);
      straight &&= many(key) <= 2;
      key = /** @type {string} */ ([...(near.get(key) || [])].find((one) => left.has(one)) || "");
    }
  }
  const pairs = new Set(edges.map(({ src, dst }) => [src, dst].sort().join())).size;
  straight &&= pairs < Math.max(order.length, 2);
  const step = Math.max(138, ...edges.map(({ label }) => 78 + 6 * label.length));
  const width = straight ? 76 + (order.length - 1) * step : 360;
  /** @type {Map<string, [number, number]>} */
  const found = new Map();
  order.forEach((key, i) => {
    const angle = (i / order.length) * 2 * Math.PI - Math.PI / 2;
    found.set(key, straight ? [38 + i * step, 52] : [180 + 136 * Math.cos(angle), 92 + 68 * Math.sin(angle)]);
  });
  return { found, width: Math.max(width, 214), height: straight ? 92 : 186 };
}

/** @param {{lanes: any, holds: (boolean | null)[]}} props */
export function PatternDrawing({ lanes, holds }) {
  const drawn = useMemo(() => {
    if (!lanes) return null;
    const labels = new Map(), edges = /** @type {any[]} */ ([]);
    lanes.lanes.forEach((/** @type {any} */ lane, /** @type {number} */ at) => {
      for (const [key, label] of Object.entries(lane.nodes)) labels.set(key, label);
      for (const edge of lane.edges) edges.push({ ...edge, at });
    });
    const conditions = conditionsOf(lanes.lanes);
    const keys = [...labels.keys()];
    const { found: at, width, height } = places(keys, edges);
    return { labels, edges, conditions, at, width, height };
  }, [lanes]);
  if (!drawn) return html`<p class="faint"
    style=${{ padding: "8px 12px" }}>The parts of the pattern stand here when a match of one is open.</p>`;
  const binding = open.value?.binding || {}, found = measured.value;
  const known = found && found.of === lanes && found.at === frame.value ? found.values : [];
  const state = (/** @type {number} */ at) => (holds[at] === null || holds[at] === undefined ? "faint" : holds[at]
    ? "holds" : "fails");
  const xs = [...drawn.at.values()].map(([x]) => x), middle = (drawn.width - Math.max(...xs) - Math.min(...xs)) / 2;
  return html`<div class="scroll drawn"><svg viewBox=${`${-middle} 0 ${drawn.width} ${drawn.height}`}
    style=${{ maxWidth: `${drawn.width * 1.7}px` }} role="img" aria-label="The pattern">
    <defs>${["holds", "fails", "faint"].map((name) => html`<marker id=${`head-${name}`} class=${name}
      viewBox="0 0 8 8" refX="7" refY="4" markerWidth="6" markerHeight="6" orient="auto">
      <path d="M0 0 8 4 0 8z" fill="currentColor" /></marker>`)}</defs>
    ${drawn.edges.map((/** @type {any} */ edge, /** @type {number} */ i) => {
      const [ax, ay] = drawn.at.get(edge.src) || [0, 0], [bx, by] = drawn.at.get(edge.dst) || [0, 0];
      const long = Math.hypot(bx - ax, by - ay) || 1, ux = (bx - ax) / long, uy = (by - ay) / long;
      const twins = drawn.edges.filter((/** @type {any} */ e) => (e.src === edge.src && e.dst === edge.dst)
        || (e.src === edge.dst && e.dst === edge.src));
      const aside = (twins.indexOf(edge) - (twins.length - 1) / 2) * 22 * (edge.src < edge.dst ? 1 : -1);
      const mx = (ax + bx) / 2 - uy * aside, my = (ay + by) / 2 + ux * aside;
      return html`<g key=${i} class=${state(edge.at)} stroke="currentColor">
        <path d=${[`M${ax + ux * 25} ${ay + uy * 15} Q${mx - uy * aside * 0.6} ${my + ux * aside * 0.6}`,
          `${bx - ux * 27} ${by - uy * 17}`].join(" ")} fill="none" stroke-width="1.8"
          stroke-dasharray=${holds[edge.at] === false ? "4 3" : ""}
            marker-end=${edge.both ? "" : `url(#head-${state(edge.at)})`} />
        <text class="halo" x=${mx} y=${my - 6} font-size="10.5" text-anchor="middle" fill="currentColor">
          ${holds[edge.at] ? "✓ " : holds[edge.at] === false ? "✗ " : ""}${edge.label}</text></g>`;
    })}
    ${[...drawn.at].map(([key, [x, y]]) => html`<g key=${key}
      onMouseEnter=${() => { if (binding[key] !== undefined) lit.value = new Set([binding[key]]); }}
      onMouseLeave=${() => { lit.value = new Set(); }}>
      <rect x=${x - 28} y=${y - 15} width="56" height="30" rx="15" fill="var(--soft)"
        stroke=${binding[key] === undefined ? "var(--line)" : "var(--mark)"} stroke-width="2" />
      <text x=${x} y=${y - 1} font-size="11.5" font-weight="600" text-anchor="middle" fill="var(--ink)">${key}</text>
      <text x=${x} y=${y + 10} font-size="8.5" text-anchor="middle" fill="var(--faint)">
        ${String(drawn.labels.get(key) || "").slice(0, 14)}</text></g>`)}
  </svg>
    <ul class="conditions">${drawn.conditions.map(({ text, of, at, meanings }) => {
      const row = html`<${Sign} of=${of} holds=${holds} /> <code>${text}</code> <${Values} text=${text} at=${at}
        known=${known} />`;
      return html`<li>${meanings.length ? html`<details><summary>${row}</summary><ul>
        ${meanings.map((one) => html`<li><${Sign} of=${one.at.map(([lane]) => lane)} holds=${holds} />
        ${" "}<code>${one.text}</code> <${Values} ...${one} known=${known} /></li>`)}</ul></details>` : row}</li>`;
    })}</ul></div>`;
}

/** The measured values of a condition at the frame that is shown. @param {{text: string, at: [number, number][],
 *   known: import("./clock.js").Measured[][][]}} props */
const Values = ({ text, at, known }) => html`<span class="values">${valueText(text,
  at.flatMap(([lane, condition]) => known[lane]?.[condition] || []))}</span>`;

/** Values in words: that of a condition which begins with it alone, of others each with its name.
 * @param {string} text @param {import("./clock.js").Measured[]} values */
export function valueText(text, values) {
  const told = values.map(({ value, unit }) => (value === null ? "unknown" : typeof value === "number"
    ? `${Number(value.toPrecision(4))}${unit && unit !== "°" ? " " : ""}${unit}` : value));
  if (values.length === 1 && text.startsWith(`${values[0]?.name} `)) return told[0] || "";
  return [...new Set(values.map(({ name }, i) => `${name}: ${told[i]}`))].join(", ");
}

/** Whether some lanes hold, as a sign. @param {{of: number[], holds: (boolean | null)[]}} props */
function Sign({ of, holds }) {
  const all = allHold(of.map((at) => holds[at]));
  const [name, sign] = all === null ? ["faint", "·"] : all ? ["holds", "✓"] : ["fails", "✗"];
  return html`<b class=${name}>${sign}</b>`;
}

/** Conditions as the query writes them, with the lanes of each; words of the library also with their meaning.
 * @param {import("./lanes.js").Lane[]} lanes
 * @returns {{text: string, of: number[], at: [number, number][],
 *   meanings: {text: string, at: [number, number][]}[]}[]} `at`: lanes, and numbers of their conditions */
export function conditionsOf(lanes) {
  return written(lanes).flatMap(({ text, of }) => {
    const one = lanes[of[0] ?? 0];
    if (!one) return [];
    if (one.call) {
      const meanings = of.flatMap((lane) => (lanes[lane]?.meanings || []).map((meaning, i) => ({ text: meaning,
        at: [/** @type {[number, number]} */ ([lane, i])] })));
      return [{ text, of, at: meanings.flatMap(({ at }) => at), meanings }];
    }
    return one.conditions.map((text, i) => {
      const at = of.map((lane) => /** @type {[number, number]} */ ([lane, i])), meaning = one.meanings[i] || text;
      return { text, of, at, meanings: meaning === text ? [] : [{ text: meaning, at }] };
    });
  });
}
