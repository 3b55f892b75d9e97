// What the page uses of Preact, its signals and htm: tests/vendor.py makes sgstore/apps/explorer/page/vendor/core.js of it.
export { h, render, Fragment } from "preact";
export { useEffect, useLayoutEffect, useMemo, useRef, useState } from "preact/hooks";
export { batch, computed, effect, signal, untracked, useComputed, useSignal, useSignalEffect } from "@preact/signals";
export { default as htm } from "htm";
