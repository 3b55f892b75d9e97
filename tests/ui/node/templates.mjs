// Templates of the page, read from its sources: what htm makes of them, with a sign at each line break.
import { readdirSync, readFileSync } from "node:fs";

const { htm } = await import("../../../sgstore/apps/explorer/page/vendor/core.js");
const FOLDER = new URL("../../../sgstore/apps/explorer/page/js/", import.meta.url);

/** Stands in for a line break, which htm would drop at the edges of a text. */
export const BREAK = "⏎";

/** Index behind a quoted text. @param {string} source @param {number} at of its first quote */
function behindQuote(source, at) {
  const quote = source[at];
  for (at++; source[at] !== quote; at++) if (source[at] === "\\") at++;
  return at + 1;
}

/** A template, and those inside it. @param {string} source @param {number} at behind its first backtick
 * @param {(template: {statics: string[], fields: string[], line: number}) => void} tell @returns {number} its end */
function readTemplate(source, at, tell, isHtml = true) {
  const statics = [""], fields = [], line = source.slice(0, at).split("\n").length;
  for (; source[at] !== "`"; at++) {
    if (source[at] === "\\") statics[statics.length - 1] += source[at++];
    if (source.startsWith("${", at)) {
      const end = readCode(source, at + 2, tell);
      fields.push(source.slice(at + 2, end));
      statics.push("");
      at = end;
    } else statics[statics.length - 1] += source[at];
  }
  if (isHtml) tell({ statics, fields, line });
  return at + 1;
}

/** Read code to the brace that closes it, or to the end. @param {string} source @param {number} at */
function readCode(source, at, tell) {
  for (let depth = 0; at < source.length;) {
    const rest = source.slice(at, at + 5);
    if (rest.startsWith("//")) at = source.indexOf("\n", at);
    else if (rest.startsWith("/*")) at = source.indexOf("*/", at) + 2;
    else if (rest === "html`") at = readTemplate(source, at + 5, tell);
    else if (rest[0] === "`") at = readTemplate(source, at + 1, tell, false);
    else if (rest[0] === '"' || rest[0] === "'") at = behindQuote(source, at);
    else if (rest[0] === "/" && /[(,=:!&|?]\s*$/.test(source.slice(Math.max(at - 9, 0), at))) at = behindPattern(source, at);
    else {
      if (rest[0] === "{") depth++;
      if (rest[0] === "}" && depth-- === 0) return at;
      at++;
    }
  }
  return at;
}

/** Index behind a regular expression. @param {string} source @param {number} at of its first slash */
function behindPattern(source, at) {
  let inside = false;
  for (at++; inside || source[at] !== "/"; at++) {
    if (source[at] === "\\") at++;
    else if (source[at] === "[") inside = true;
    else if (source[at] === "]") inside = false;
  }
  return at + 1;
}

/** All templates of the page as trees: elements {tag, children}, texts, and fields {field: its source}.
 * @returns {{where: string, roots: any[]}[]} */
export function templates() {
  const made = [];
  for (const name of readdirSync(FOLDER).filter((one) => one.endsWith(".js"))) {
    readCode(readFileSync(new URL(name, FOLDER), "utf8"), 0, ({ statics, fields, line }) => {
      made.push({ where: `${name}:${line}`, roots: treeOf(statics, fields) });
    });
  }
  return made;
}

/** What htm makes of a template. @param {string[]} statics @param {string[]} fields */
export function treeOf(statics, fields) {
  const h = (tag, _, ...children) => ({ tag: typeof tag === "string" ? tag : "", children });
  let inTag = false; // line breaks between attributes are no text
  const marked = statics.map((part) => part.replace(/<[/!]?|=?>|\s*\n\s*/g, (found) => {
    if (found.startsWith("<")) inTag = true;
    else if (found.endsWith(">")) inTag = false;
    else return inTag ? found : BREAK;
    return found;
  }));
  const found = htm.bind(h)(marked, ...fields.map((field) => ({ field })));
  return Array.isArray(found) ? found : [found];
}
