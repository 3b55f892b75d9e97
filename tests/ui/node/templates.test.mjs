import assert from "node:assert/strict";
import test from "node:test";
import { BREAK, templates, treeOf } from "./templates.mjs";

/** Elements that stand in a line of text. */
const INLINE = new Set(["a", "b", "button", "code", "em", "kbd", "small", "strong"]);

/** What a child of a template is: a word, an element in a line, a blank, or something else. */
function sortOf(child) {
  if (typeof child === "string") return child.trim() ? "word" : "blank";
  if (child?.field !== undefined) return /html`/.test(child.field) ? "other" : /^" +"$/.test(child.field) ? "blank" : "word";
  return INLINE.has(child?.tag) ? "inline" : "other";
}

/** Pairs of neighbours that a line break parts in the source, but nothing on the page. */
function joined(children) {
  const parts = children.flatMap((one) => (typeof one === "string" ? one.split(new RegExp(`(${BREAK})`)).filter(Boolean)
    : [one]));
  return parts.flatMap((one, i) => {
    if (one?.children) return joined(one.children);
    const sides = [parts[i - 1], parts[i + 1]], sorts = sides.map((side) => side && sortOf(side));
    const bare = sides.filter((side) => typeof side === "string").length < 2; // htm keeps a break inside a text
    return one === BREAK && bare && sorts.includes("word") && sorts.every((sort) => sort === "word" || sort === "inline")
      ? [sides.map((side) => side.field ?? side.tag ?? side).join(" ⏎ ")] : [];
  });
}

test("line breaks of a template are found where htm drops them", () => {
  const of = (statics, ...fields) => joined(treeOf(statics, fields));
  assert.equal(of(["<p>press\n  <kbd>x</kbd></p>"]).length, 1);
  assert.equal(of(["<p>", "\n  matches</p>"], "many").length, 1);
  assert.equal(of(["<p>", "", "\n  matches</p>"], "many", '" "').length, 0);
  assert.equal(of(["<p>two\n  words <b\n  class=a>and</b> more</p>"]).length, 0);
  assert.equal(of(["<p>\n  ", "</p>\n<p>a</p>"], "one").length, 0);
});

test("no template joins two words at a line break", () => {
  const all = templates();
  assert.ok(all.length > 150, `${all.length} templates`);
  assert.deepEqual(all.flatMap(({ where, roots }) => joined(roots).map((pair) => `${where}: ${pair}`)), []);
});
