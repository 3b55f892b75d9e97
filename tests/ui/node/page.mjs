// What modules of the page need of a browser, and a server that answers with columns.
Object.assign(globalThis, {
  addEventListener() {},
  matchMedia: () => ({ matches: false, addEventListener() {} }),
  document: { getElementById: () => null, documentElement: { dataset: {} }, addEventListener() {}, hidden: false },
  location: { hash: "" },
  requestAnimationFrame: () => 0,
});

/** Columns as the server sends them: header and numbers of 64 bits. */
function packed(header, columns) {
  const listed = Object.entries(columns).map(([name, values]) => [name, "f8", values.length]);
  const text = new TextEncoder().encode(JSON.stringify({ ...header, columns: listed }));
  const start = 8 + Math.ceil(text.length / 8) * 8, numbers = Object.values(columns).flat();
  const data = new ArrayBuffer(start + numbers.length * 8);
  new Uint32Array(data, 0, 1)[0] = text.length;
  new Uint8Array(data, 8).set(text);
  new Float64Array(data, start).set(numbers);
  return data;
}

/** Times of the frames of the trace `run`: a pause before frame 3. */
export const TIMES = [0, 0.1, 0.2, 5, 5.1];
export const asked = [];
export const server = { fails: false, busy: false };

globalThis.fetch = async (path) => {
  asked.push(path);
  if (server.fails) throw new TypeError("no network");
  if (server.busy) return new Response('{"reason": "8 questions are under way"}', { status: 503 });
  if (path === "api/stamp") return new Response("{}");
  const names = { 7: ["car", "17", ""] };
  return new Response(packed({ names }, { t: TIMES, node: [], kind: [], x: [], y: [] }));
};

export const about = {
  store: "a.sgstore", stamp: "1", other: null, codes: { kind: [], light: [] },
  traces: [{ name: "run", frames: 5, seconds: 5.2, period: 0.1, map: "", map_key: "", origin: [100, 50], cameras: [] }],
};

/** Wait until what was asked has come. */
export const settled = () => new Promise((done) => { setTimeout(done, 5); });

/** A match of frames. */
export const match = (first, last, binding = {}, more = {}) => ({
  trace: "run", first, last, start: NaN, end: NaN, binding, names: {}, values: {}, index: first, ...more,
});
