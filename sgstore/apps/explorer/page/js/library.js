// @ts-check
// The library and the words of the language: cards before anything is asked, a search in them, what comes near a mistake.
import { effect, h, htm, signal, useEffect, useState } from "../vendor/core.js";
import * as api from "./api.js";
import { answer, ask, idle, isLost, library, matchesIn, open, reasonOf, sought, store, tally, view,
  words } from "./state.js";
import { Elapsed } from "./status.js";

const html = htm.bind(h);
const MOST_CARDS = 24, MOST_WORDS = 12;
const PAUSE = 400; // ms between looks whether the library may be counted

/** @typedef {{name: string, kind: string, text: string, sentence: string, library: string, source: string,
 *   drawing: string}} Entry */
/** @typedef {{name: string, meaning: string, text: string}} Word */

let last = "";
effect(() => { // a question ends the search
  const { id } = answer.value;
  if (id !== last) sought.value = "";
  last = id;
});

let counting = false;

/** Count the matches of the library, one pattern after another, while it is looked at. */
export async function countLibrary() {
  if (counting) return;
  counting = true;
  const next = () => library.value.find((p) => p.kind !== "predicate" && p.kind !== "property"
    && !tally.value[p.name]);
  for (let one = next(); one; one = next()) {
    const busy = () => answer.value.state !== "idle" || view.value !== "find" || open.value || api.trouble.value;
    while (busy()) await new Promise((done) => setTimeout(done, PAUSE));
    const spots = new Set(), place = placed(), mine = new AbortController(), { stamp } = store.value;
    let count = 0, more = "", reason = "";
    idle.stop = () => mine.abort();
    const lines = api.lines("api/find", { text: one.text }, { signal: mine.signal });
    try {
      for await (const { trace, first, last } of matchesIn(lines, () => { more = "+"; })) {
        count++;
        for (let at = Math.floor(place(trace, first)); at < place(trace, last + 1); at++) spots.add(at);
      }
    } catch (error) {
      if (isLost(error)) { // again later
        await new Promise((done) => setTimeout(done, PAUSE));
        continue;
      }
      count = -1;
      reason = reasonOf(error);
    }
    // What a question stopped, or another state of the store had, is counted again later.
    if (mine.signal.aborted || stamp !== store.value.stamp) continue;
    tally.value = { ...tally.value, [one.name]: { count, more, spots: [...spots], reason } };
  }
  counting = false;
}

/** What tells where a frame is in all traces, one behind the other: 0 to 250. */
function placed() {
  const before = new Map();
  let whole = 0;
  for (const { name, frames } of store.value.traces) { before.set(name, whole); whole += frames; }
  return (/** @type {string} */ trace, /** @type {number} */ at) => ((before.get(trace) + at) / whole) * 250;
}

/** Parts of words that words of one stem share. @param {string} text */
const stems = (text) => (text.toLowerCase().match(/[a-z]{3,}/g) || []).map((word) => word.slice(0, 4));

/** Words of the language, each with its meaning and a query to begin with. @returns {Word[]} */
function vocabulary() {
  const known = words.value;
  if (!known) return [];
  /** @param {any[]} told @param {(name: string) => string} text @returns {Word[]} */
  const of = (told, text) => told.map(({ name, meaning }) => ({ name, meaning, text: text(name) }));
  return [
    ...known.relations.map((/** @type {string} */ name) => ({ name, meaning: "relation of two nodes",
      text: `MATCH (a)-[:${name}]->(b)` })),
    ...known.labels.map((/** @type {string} */ name) => ({ name, meaning: "label of nodes",
      text: `MATCH (x:${name})` })),
    ...of(known.attributes.node, (name) => `MATCH (x) WHERE x.${name} IS KNOWN RETURN x, x.${name}`),
    ...of(known.functions, (name) => `MATCH (e:Ego), (x:Entity) RETURN e, x, ${name}(e, x)`),
    ...of(known.predicates, (name) => `MATCH (x:Vehicle) WHERE ${name}(x)`),
  ];
}

/** Words of the language that are near some words, the nearest first. @param {string} text */
function nearWords(text) {
  const wanted = [...new Set(stems(text))];
  const ranked = vocabulary().map((word) => {
    const name = stems(word.name.replace(/([a-z])([A-Z])/g, "$1 $2")), meaning = stems(word.meaning);
    return { word, rank: wanted.reduce((n, one) => n + (name.includes(one) ? 3 : 0) + (meaning.includes(one) ? 1
      : 0), 0) };
  });
  return ranked.filter(({ rank }) => rank).sort((a, b) => b.rank - a.rank
    || a.word.name.length - b.word.name.length).slice(0, MOST_WORDS).map(({ word }) => word);
}

/** Entries of the library near some words, the nearest first. An answer to other words is not shown.
 * @param {string} text @returns {{cards?: Entry[], error?: string}} without cards: not known yet */
function useNear(text) {
  const [found, tell] = useState(/** @type {{of: string, names: string[], error?: string}} */ ({ of: "", names: [] }));
  useEffect(() => {
    const mine = new AbortController();
    if (text) {
      api.json(api.address("api/search", { text: text.slice(0, 300) }), undefined, { signal: mine.signal })
        .then((names) => tell({ of: text, names }), (error) => {
          if (!mine.signal.aborted) tell({ of: text, names: [], error: reasonOf(error) });
        });
    }
    return () => mine.abort();
  }, [text]);
  if (found.of !== text) return {};
  return { error: found.error, cards: found.names.flatMap((name) => library.value.filter((one) => one.name === name
    && one.kind !== "predicate")) };
}

/** @param {{one: Entry}} props */
function Card({ one }) {
  const told = tally.value[one.name];
  const many = one.kind === "property" ? html`<span class="faint">check</span>`
    : told ? html`<span class=${told.count > 0 ? "badge" : "faint"} title=${told.reason}>
      ${told.count < 0 ? "–" : told.count}${told.more}</span>`
    : html`<span class="faint">…</span>`;
  return html`<button class="card" key=${one.name} onClick=${() => ask(one.text)}>
    <h3>${one.name.replace(/_/g, " ")} <small title=${one.source}>${one.library}</small>
      <span class="grow"></span><span class="many">${many}</span></h3>
    <p>${one.sentence}</p>
    ${one.kind === "property" ? null : html`<svg viewBox="0 0 250 18" preserveAspectRatio="none"
      shape-rendering="crispEdges" aria-hidden="true">
      <rect class="bar-back" width="250" height="18" />${told?.spots.map((at) => html`<rect class="bar-match" x=${at}
        width="1" height="18" />`)}</svg>`}
    ${one.drawing ? html`<pre aria-hidden="true">${one.drawing}</pre>` : null}</button>`;
}

/** Cards and words of the language that come near some words. @param {{text: string, most?: number}} props */
export function Near({ text, most = MOST_CARDS }) {
  const { cards, error } = useNear(text);
  if (!text) return null;
  if (error) return html`<p class="error" role="alert">${error}</p>`;
  if (!cards) {
    return html`<p class="row faint" role="status"><span class="busy" aria-hidden="true"></span>
      searching … <${Elapsed} key=${text} /></p>`;
  }
  const some = nearWords(text);
  return html`${cards.length ? html`<div class="cards near-cards">
    ${cards.slice(0, most).map((one) => html`<${Card} one=${one} />`)}</div>` : null}
    ${some.length ? html`<h2>Words of the language</h2><ul class="words">${some.map((one) => html`<li>
      <button class="small" onClick=${() => ask(one.text)}>${one.name}</button> <span class="faint">
        ${one.meaning}</span></li>`)}</ul>` : null}
    ${cards.length || some.length ? null
      : html`<p class="faint">Neither the library nor the language has such words.</p>`}`;
}

/** The field of the search in words. */
export const WordSearch = () => html`<input type="search" class="words-field"
  aria-label="Search the library and the words of the language"
  placeholder="words: pedestrian crosses" value=${sought.value}
    onInput=${(/** @type {{target: HTMLInputElement}} */ e) => { sought.value = e.target.value; }}
  onKeyDown=${(/** @type {KeyboardEvent} */ e) => { if (e.key === "Escape") sought.value = ""; }} />`;

/** The counts by which the cards are sorted; null: they are not. Cards move on a click only, not as counts come. */
const foundFirst = signal(/** @type {typeof tally.value | null} */ (null));

export function Start() {
  const some = library.value.filter((one) => one.kind !== "predicate"),
    kinds = [...new Set(some.map((one) => one.library))];
  const known = foundFirst.value, text = sought.value.trim();
  const found = (/** @type {Entry} */ one, by = known) => Number((by?.[one.name]?.count || 0) > 0);
  const whole = some.every((one) => one.kind === "property" || tally.value[one.name]),
    moves = known && whole && some.some((one) => found(one) !== found(one, tally.value));
  return html`<div class="sheet" tabindex="0">
    ${text ? html`<${Near} text=${text} />` : !some.length ? html`<p class="faint">Reading the library …</p>`
      : html`<p class="faint">Type a pattern above, search in words, or begin with one of these ${some.length}.
      Each card has its matches in this store, and where they are in time.
      ${" "}<button class="small" aria-pressed=${known !== null}
        onClick=${() => { foundFirst.value = known ? null : tally.value; }}>those with matches first</button>
      ${moves ? html` <button class="small" onClick=${() => { foundFirst.value = tally.value; }}>
        counts are in: sort</button>` : null}</p>
      ${kinds.map((kind) => html`<h2>${kind}</h2><div class="cards">
        ${some.filter((one) => one.library === kind).sort((a,
          b) => found(b) - found(a)).map((one) => html`<${Card} one=${one} />`)}</div>`)}`}</div>`;
}
