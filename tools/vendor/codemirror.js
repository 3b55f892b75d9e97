// What the editor uses of CodeMirror: tests/vendor.py makes sgstore/apps/explorer/page/vendor/codemirror.js of it.
export { Compartment, EditorState, StateEffect } from "@codemirror/state";
export {
  drawSelection, EditorView, highlightSpecialChars, hoverTooltip, keymap, placeholder, tooltips,
} from "@codemirror/view";
export { defaultKeymap, history, historyKeymap } from "@codemirror/commands";
export { bracketMatching, HighlightStyle, StreamLanguage, syntaxHighlighting } from "@codemirror/language";
export { autocompletion, closeBrackets, closeBracketsKeymap, closeCompletion, completionKeymap } from "@codemirror/autocomplete";
export { setDiagnostics, lintKeymap } from "@codemirror/lint";
export { tags } from "@lezer/highlight";
