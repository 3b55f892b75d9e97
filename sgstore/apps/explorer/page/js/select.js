// @ts-check
// The selection: ticked matches as a test set, with their length, and as a lock or clips.
import { computed, h, htm, useEffect, useLayoutEffect, useRef, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { copy, quoted } from "./address.js";
import { arrived, seconds, timesOf } from "./data.js";
import { Table, useWork, Waiting } from "./sheets.js";
import { keyOf, openMatch, reasonOf, store, tick, ticked, view } from "./state.js";

const html = htm.bind(h);
const ROW = 34, SPARE = 6; // height of a row; rows that are there out of sight
const FORMATS = ["mcap", "frames", "parquet", "nx", "pyg", "s3c"];

/** @typedef {import("./state.js").Match} Match */

/** Ticked frames by trace: a name, then first and last frame of each match. */
const clips = computed(() => {
  const by = new Map();
  for (const { trace, first, last } of ticked.value.values()) {
    if (!by.has(trace)) by.set(trace, [trace]);
    by.get(trace).push(first, last);
  }
  return [...by.values()];
});

/** @param {number} bytes */
const size = (bytes) => (bytes > 1e9 ? `${(bytes / 1e9).toFixed(2)} GB`
  : bytes > 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.round(bytes / 1e3)} kB`);

/** Rows of a long list; only those in sight are there. @param {{all: Match[]}} props */
function Clips({ all }) {
  const place = useRef(/** @type {HTMLElement | null} */ (null));
  const [box, setBox] = useState({ top: 0, height: 600 });
  const measure = () => { if (place.current) setBox({ top: place.current.scrollTop,
    height: place.current.clientHeight }); };
  useLayoutEffect(measure, [all.length]);
  useEffect(() => {
    addEventListener("resize", measure);
    return () => removeEventListener("resize", measure);
  }, []);
  arrived.value;
  // The row with the focus stays, wherever the list is scrolled. The row after a removed one has it next.
  const held = useRef(-1), gone = useRef(false), first = Math.max(Math.floor(box.top / ROW) - SPARE, 0),
    end = Math.min(first + Math.ceil(box.height / ROW) + 2 * SPARE, all.length), rows = [];
  held.current = Math.min(held.current, all.length - 1);
  if (held.current >= 0 && held.current < first) rows.push(held.current);
  for (let at = first; at < end; at++) rows.push(at);
  if (held.current >= end) rows.push(held.current);
  useLayoutEffect(() => {
    if (!gone.current) return;
    gone.current = false;
    /** @type {HTMLElement | null | undefined} */ (place.current?.querySelector(
      `[aria-posinset="${held.current + 1}"] button:last-child`))?.focus();
  });
  const onFocus = (/** @type {FocusEvent} */ event) => {
    const row = /** @type {HTMLElement} */ (event.target).closest("[aria-posinset]");
    held.current = Number(row?.getAttribute("aria-posinset") || 0) - 1;
  };
  return html`<div class="clips" ref=${place} onScroll=${measure} onFocusIn=${onFocus} tabindex="0" role="list"
      aria-label="Clips">
    <div style=${{ height: `${all.length * ROW}px` }}>${rows.map((at) => {
      const match = /** @type {Match} */ (all[at]), [start, end] = timesOf(match);
      return html`<div class="clip" role="listitem" key=${keyOf(match)} style=${{ top: `${at * ROW}px` }}
          aria-posinset=${at + 1} aria-setsize=${all.length}><span class="cut">${match.trace}</span>
        <span class="number">${seconds(start)} s – ${seconds(end)} s</span>
        <button class="small" onClick=${() => { view.value = "find"; openMatch(match); }}>open</button>
        <button class="small" onClick=${(/** @type {MouseEvent} */ event) => {
          gone.current = event.detail === 0; // by a key
          tick(match);
        }}>remove</button></div>`;
    })}</div></div>`;
}

/** Let the browser save a text as a file. @param {string} text @param {string} name */
function saveText(text, name) {
  const link = document.createElement("a"), address = URL.createObjectURL(new Blob([text], { type: "text/plain" }));
  Object.assign(link, { href: address, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/** The command that exports the clips of a lock. @param {string} name @param {string} format */
const exportCommand = (name, format) => `sgstore export ${quoted(store.value.path)} --lock ${quoted(`${name}.lock`)}`
  + ` --as ${format} --to ${quoted(name)}`;

/** A lock or clips of what is ticked: downloaded, or below the folder that the page may write to. */
function Keep() {
  const [made, tell] = useState(""), [name, setName] = useState("tests"), [format, setFormat] = useState("mcap");
  const { writing } = store.value, command = exportCommand(name.replace(/\.lock$/, ""), format);
  const write = async (/** @type {any} */ event) => {
    event.preventDefault();
    const how = event.submitter?.value || "download";
    tell("working …");
    try {
      const body = { clips: clips.value, ...(how === "download" ? {} : { name, format }) };
      const found = await api.work(`api/${how}`, body, (done, of) => tell(`${done} of ${of}`));
      const lost = found.losses?.length ? `; lost: ${found.losses.join("; ")}` : "";
      if (how === "download") saveText(found.text, `${name.replace(/\.lock$/, "")}.lock`);
      tell(how === "download" ? `${found.cases} ${found.cases === 1 ? "case" : "cases"} downloaded${
        found.cases < ticked.value.size ? "; clips that overlap are one case" : ""}`
        : how === "lock" ? `${found.cases} cases in ${found.file}`
        : `${found.files.length} files in ${found.folder}${lost}`);
    } catch (error) { tell(reasonOf(error)); }
  };
  const choice = html`<label>as <select name="format" value=${format}
    onChange=${(/** @type {{target: HTMLInputElement}} */ e) => setFormat(e.target.value)}>
    ${FORMATS.map((f) => html`<option>${f}</option>`)}</select></label>`;
  return html`<form class="row wrap" onSubmit=${write}>
      <label>Name <input name="name" required pattern="[^\\/\\\\.][^\\/\\\\]*" value=${name}
        onInput=${(/** @type {{target: HTMLInputElement}} */ e) => setName(e.target.value)} /></label>
      <button class="main" value="download" title="a file with the clips and their checksums">Download a lock</button>
      ${writing ? html`<button value="lock">Write a lock</button>
        <button value="export">Export clips</button>${choice}` : null}</form><p role="status">${made}</p>
    <p class="row wrap"><span class="faint">Cut the clips out with the downloaded lock:</span>
      ${writing ? null : choice} <code>${command}</code>
      ${" "}<button class="small" onClick=${() => copy(command, "command copied")}>Copy</button></p>
    ${writing ? null : html`<p class="faint">With <code>sgstore serve … --write-to DIR</code>, this page exports the
      clips itself.</p>`}`;
}

export function Selection() {
  const all = [...ticked.value.values()], told = useWork("api/select", { clips: clips.value });
  if (!all.length) {
    return html`<div class="sheet"><h2>Nothing is selected</h2><p class="faint">Tick matches in the gallery, or
      press <kbd>x</kbd> in a scene. They become a test set here: a lock, or clips of the recordings.</p></div>`;
  }
  return html`<div class="sheet" tabindex="0">
    <h2>${all.length.toLocaleString("en")} ${all.length === 1 ? "clip" : "clips"}</h2>
    <${Waiting} told=${told}>${(/** @type {any} */ found) => html`<p><b>${found.seconds.toFixed(1)} s</b>,
      ${" "}${found.frames.toLocaleString("en")} frames, ${size(found.bytes)} of sensor messages</p>
        <${Table} table=${found.kept} />`}</${Waiting}>
    <h2>Keep them</h2><${Keep} />
    <h2>Clips</h2><p><button class="small" onClick=${() => { ticked.value = new Map(); }}>remove all</button></p>
    <${Clips} all=${all} /></div>`;
}
