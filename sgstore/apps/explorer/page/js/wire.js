// @ts-check
// Columns as they come: a header, then arrays that need no copying (sgstore/apps/explorer/_wire.py).

/** @typedef {{header: Record<string, any>, columns: Record<string, any>}} Columns */

/** @type {Record<string, any>} */
const ARRAYS = {
  u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array, f8: Float64Array,
};

/** @param {string} base64 @returns {Uint8Array<ArrayBuffer>} */
export function bytesOf(base64) {
  const packed = atob(base64), bytes = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
  return bytes;
}

/** @param {ArrayBuffer} data @returns {Columns} */
export function unpacked(data) {
  const [length] = new Uint32Array(data, 0, 1);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 8, length)));
  /** @type {Record<string, any>} */
  const columns = {};
  let place = 8 + Math.ceil((length || 0) / 8) * 8;
  for (const [name, type, many] of header.columns) {
    const Type = ARRAYS[type];
    columns[name] = new Type(data, place, many);
    place += Math.ceil((many * Type.BYTES_PER_ELEMENT) / 8) * 8;
  }
  return { header, columns };
}
