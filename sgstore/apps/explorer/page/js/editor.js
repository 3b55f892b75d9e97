// @ts-check
// The editor of queries: colours, completion, errors under carets, a slider for the number under the cursor.
import {
  autocompletion, bracketMatching, closeBrackets, closeBracketsKeymap, closeCompletion, completionKeymap,
    defaultKeymap, drawSelection,
  EditorState, EditorView, highlightSpecialChars, HighlightStyle, history, historyKeymap, keymap, placeholder,
    setDiagnostics,
  StreamLanguage, syntaxHighlighting, tags,
} from "../vendor/codemirror.js";
import { effect, h, htm, signal, useEffect, useRef } from "../vendor/core.js";
import { answer, find, text, words } from "./state.js";

const html = htm.bind(h);
const nonce = document.querySelector("meta[name=csp-nonce]")?.getAttribute("content") || "";

/** The number under the cursor: the text that it is of, where it stands, and what it is. */
export const number = signal(/** @type {{of: string, from: number, to: number, value: number} | null} */ (null));
/** @type {any} */
let editor = null;

const language = StreamLanguage.define({
  token(/** @type {any} */ stream) {
    if (stream.match(/--[^\n]*/)) return "comment";
    if (stream.match(/'(?:[^'\\]|\\.)*'?/) || stream.match(/"(?:[^"\\]|\\.)*"?/)) return "string";
    if (stream.match(/\d+(?:\.\d+)?(?:ms|s|min|frames)?\b/)) return "number";
    if (stream.match(/\$\w+/)) return "atom";
    if (stream.match(/(?:[<-]?-|<)\[|\]-?>?|->|<-/)) return "operator";
    if (stream.match(/:\s*!?[A-Za-z_]\w*/)) return "typeName";
    if (stream.match(/[A-Za-z_]\w*/)) {
      const word = stream.current();
      if (/^[A-Z][A-Z]+$/.test(word)) return "keyword";
      return stream.peek() === "(" ? "function" : "variableName";
    }
    stream.next();
    return null;
  },
  tokenTable: { function: tags.function(tags.variableName) },
  languageData: { commentTokens: { line: "--" }, closeBrackets: { brackets: ["(", "[", "{", "'"] } },
});

const colours = HighlightStyle.define([
  { tag: tags.keyword, color: "var(--code-key)", fontWeight: "600" },
  { tag: tags.string, color: "var(--code-text)" },
  { tag: tags.number, color: "var(--code-number)" },
  { tag: tags.atom, color: "var(--code-number)", fontWeight: "600" },
  { tag: tags.typeName, color: "var(--code-name)" },
  { tag: tags.function(tags.variableName), color: "var(--code-name)" },
  { tag: tags.comment, color: "var(--faint)", fontStyle: "italic" },
  { tag: tags.operator, color: "var(--faint)" },
]);

/** Words that may stand at the cursor. @param {any} context */
function complete(context) {
  const known = words.value;
  if (!known) return null;
  const before = context.state.sliceDoc(Math.max(0, context.pos - 200), context.pos);
  /** @param {string[]} names @param {string} type @param {number} [boost] */
  const of = (names, type, boost = 0) => names.map((label) => ({ label, type, boost }));
  /** @param {any[]} told @param {string} type */
  const told = (told, type) => told.map((one) => ({
    label: one.name, type, detail: one.meaning, info: one.values?.length ? one.values.join(", ") : undefined,
  }));
  const word = context.matchBefore(/\w+/), from = word ? word.from : context.pos, validFor = /^\w*$/;
  const field = /\btopic\(\s*'([^']*)'[^()]*\)\.([\w.[\]`-]*)$/i.exec(before);
  if (field) {
    const start = context.pos - (field[2] || "").length;
    return { from: start, options: told(known.topics[field[1] || ""] || [], "property"), validFor: /^[\w.[\]`-]*$/ };
  }
  const topic = /\btopic\(\s*'([^']*)$/i.exec(before);
  if (topic) return { from: context.pos - (topic[1] || "").length, options: of(Object.keys(known.topics), "text"),
    validFor: /^[^']*$/ };
  const owner = /(\w+)\.\w*$/.exec(before)?.[1];
  if (owner) {
    const edges = new RegExp(`\\[\\s*${owner}\\s*[:\\]]`).test(context.state.doc.toString());
    const group = known.attributes[owner] && owner !== "node" ? owner : edges ? "edge" : "node";
    return { from, options: told(known.attributes[group], "property"), validFor };
  }
  if (/\[\s*\w*\s*:(?:[\w!|&]*\|)?\w*$/.test(before)) return { from, options: of(known.relations, "enum"), validFor };
  if (/\(\s*\w*\s*:(?:[\w!|&()]*[|&!(])?\w*$/.test(before)) return { from, options: of(known.labels, "class"),
    validFor };
  if (!word && !context.explicit) return null;
  const variables = [...new Set([...context.state.doc.toString().matchAll(/[([]\s*([A-Za-z_]\w*)/g)].map((m) => m[1]
    || ""))];
  return {
    from, validFor, options: [
      ...of(variables.filter((one) => one !== word?.text), "variable", 2), ...of(known.keywords, "keyword"),
      ...told(known.functions, "function"), ...told(known.predicates, "function"),
    ],
  };
}

/** Show an error under its place. @param {any} error */
function diagnosed(error) {
  if (!editor) return;
  const doc = editor.state.doc;
  /** @type {import("@codemirror/lint").Diagnostic[]} */
  const found = [];
  if (error && Number.isInteger(error.start)) {
    // Places are those of the text without the blanks before it; and in characters, not in halves of them.
    const raw = doc.toString(), lead = raw.length - raw.trimStart().length;
    const at = (/** @type {number} */ n) => Math.min([...raw.trimStart()].slice(0, n).join("").length + lead,
      doc.length);
    const from = at(error.start), to = Math.max(at(error.end), from);
    found.push({
      from: from === to && from ? from - 1 : from, to, severity: "error",
      message: error.hint ? `${error.reason}\n${error.hint}` : error.reason,
    });
  }
  editor.dispatch(setDiagnostics(editor.state, found));
}

/** @param {any} state */
function numberAt(state) {
  const { head } = state.selection.main, line = state.doc.lineAt(head);
  for (const m of line.text.matchAll(/'(?:[^'\\]|\\.)*'|--.*|(?<![\w.$])\d+(?:\.\d+)?/g)) {
    const from = line.from + (m.index || 0), to = from + m[0].length;
    if (/^\d/.test(m[0]) && head >= from && head <= to) return { of: state.doc.toString(), from, to,
      value: Number(m[0]) };
  }
  return null;
}

/** Put a text in place of a part of the query. @param {number} from @param {number} to @param {string} insert */
function replacePart(from, to, insert) {
  editor?.dispatch({ changes: { from, to, insert }, selection: { anchor: from + insert.length } });
}

export const focusEditor = () => editor?.focus();

export function Editor() {
  const place = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    editor = new EditorView({
      parent: place.current || undefined,
      state: EditorState.create({
        doc: text.value,
        extensions: [
          EditorView.cspNonce.of(nonce), highlightSpecialChars(), history(), drawSelection(), bracketMatching(),
            closeBrackets(),
          autocompletion({ override: [complete], icons: false, maxRenderedOptions: 60 }), language,
            syntaxHighlighting(colours),
          EditorView.lineWrapping,
            placeholder("MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 5 · or SELECT …"
            + " · or choose a pattern below"),
          EditorView.contentAttributes.of({ "aria-label": "Query" }),
          keymap.of([
            { key: "Mod-Enter", preventDefault: true,
              run: (/** @type {any} */ view) => { closeCompletion(view); find(); return true; } },
            { key: "Escape", run: (/** @type {any} */ view) => { view.contentDOM.blur(); return true; } },
            ...closeBracketsKeymap, ...defaultKeymap, ...historyKeymap, ...completionKeymap,
          ]),
          EditorView.updateListener.of((/** @type {any} */ update) => {
            if (update.docChanged) text.value = update.state.doc.toString();
            if (update.docChanged || update.selectionSet) number.value = numberAt(update.state);
          }),
        ],
      }),
    });
    const stops = [
      effect(() => { const query = text.value; if (editor.state.doc.toString() !== query) replacePart(0,
        editor.state.doc.length, query); }),
      effect(() => diagnosed(answer.value.error)),
    ];
    return () => { stops.forEach((stop) => stop()); editor.destroy(); editor = null; };
  }, []);
  return html`<div class="editor" ref=${place}></div>`;
}

/** @type {any} */
let waiting = 0;

/** A slider for the number under the cursor, which asks again. */
export function NumberSlider() {
  const at = number.value;
  const range = useRef({ rest: "", low: 0, high: 1, step: 0.1 });
  if (!at || at.of !== text.value) return null; // the text may change while there is no editor
  const rest = `${at.of.slice(0, at.from)}\n${at.of.slice(at.to)}`; // while this stays, the range does
  if (range.current.rest !== rest || at.value > range.current.high) {
    const size = Math.abs(at.value) || 1, step = 10 ** Math.floor(Math.log10(size) - 1);
    range.current = { rest, low: 0, high: Number((size * 3).toPrecision(2)), step };
  }
  const { low, high, step } = range.current;
  const change = (/** @type {any} */ event) => {
    const digits = Math.max(0, -Math.floor(Math.log10(step)));
    replacePart(at.from, at.to, Number(event.target.value).toFixed(digits).replace(/\.0+$/, ""));
    clearTimeout(waiting);
    waiting = setTimeout(() => find({ keep: true }), 160);
  };
  return html`<label class="slider">${at.value}
    <input type="range" aria-label="Number under the cursor" min=${low} max=${high} step=${step} value=${at.value}
      onInput=${change} /></label>`;
}
