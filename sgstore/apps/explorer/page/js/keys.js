// @ts-check
// Keys of the scene: what they do, and the list of them.
import { h, htm, useEffect, useRef } from "../vendor/core.js";
import { about, askWhy, camera, goBy, matchEnd, nextMatch, panel } from "./clock.js";
import { timelineKeys } from "./timeline.js";
import { dialog, open, playing, tick, toast } from "./state.js";

const html = htm.bind(h);

/** Keys as they are listed: their signs, what they do, and the act of each.
 * @type {[string, string, Record<string, (event: KeyboardEvent) => void>][]} */
export const keys = [
  ["n  p", "next match, match before", { n: () => nextMatch(1), p: () => nextMatch(-1) }],
  ["space", "play, pause", { " ": () => { if (open.value) playing.value = !playing.value; } }],
  ["← →", "a frame", {}],
  ...timelineKeys,
  [", .", "a second", { ",": () => goBy(-1), ".": () => goBy(1) }],
  ["[ ]", "ends of the match", { "[": () => matchEnd(-1), "]": () => matchEnd(1) }],
  ["x", "select the match", { x: () => { if (open.value?.match) tick(open.value.match); } }],
  ["c", "next camera", { c: () => {
    const all = about.value?.cameras || [];
    camera.value = all[(all.indexOf(camera.value) + 1) % (all.length || 1)] || "";
  } }],
  ["g", "next panel: pattern, neighbours, nodes, edges", { g: () => {
    const all = ["pattern", "near", "nodes", "edges"];
    panel.value = all[(all.indexOf(panel.value) + 1) % 4] || "pattern";
  } }],
  ["w", "why does this frame match, or not", { w: () => { askWhy(); } }],
  ["Esc", "close", { Escape: () => {
    if (dialog.value) dialog.value = "";
    else if (open.value) { playing.value = false; open.value = null; }
  } }],
  ["?", "these keys", { "?": () => { dialog.value = "keys"; } }],
];

/** What lies above the page: the keys, or a form; and what was just said. @param {{children?: any}} props */
export function Above({ children }) {
  const what = dialog.value, close = () => { dialog.value = ""; };
  const place = useRef(/** @type {HTMLDialogElement | null} */ (null));
  useEffect(() => { // closed, it gives the focus back to where it was
    if (what) place.current?.showModal(); else place.current?.close();
  }, [!what]);
  return html`<dialog class="dialog" ref=${place} aria-label=${what} onClose=${close}
      onClick=${(/** @type {MouseEvent} */ e) => { if (e.target === e.currentTarget) close(); }}>
    ${what ? html`<div>${what !== "keys" ? children
      : html`<h2>Keys</h2><dl>${keys.map(([sign, does]) => html`<dt><kbd>${sign}</kbd></dt><dd>${does}</dd>`)}</dl>`}
      <p><button onClick=${close}>Close</button></p></div>` : null}</dialog>
    ${toast.value ? html`<div class="toast" role="status">${toast.value}</div>` : null}`;
}

// A button that was clicked does not keep the keys: space plays.
addEventListener("click",
  ({ target, detail }) => { if (detail) /** @type {HTMLElement} */ (target).closest("button")?.blur(); });

addEventListener("keydown", (event) => {
  const at = /** @type {HTMLElement} */ (event.target);
  const typing = at.closest?.("input:not([type=checkbox]):not([type=range]), select, textarea, .cm-editor");
  if (event.ctrlKey || event.metaKey || event.altKey || (typing && event.key !== "Escape")) return;
  if (event.key === " " && at.closest?.("button, input")) return;
  const act = keys.find(([, , acts]) => event.key in acts)?.[2][event.key];
  if (!act || (dialog.value && event.key !== "Escape")) return;
  event.preventDefault();
  act(event);
});
