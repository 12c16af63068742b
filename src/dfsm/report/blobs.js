// Reads the arrays of a page back from what blobs.py made of them.
"use strict";
const unpack = (() => {
  const read = new Map();
  const NOTHING = 65535;

  function decode([kind, offset, step, text]) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    if (kind === "f4") return Float64Array.from(new Float32Array(bytes.buffer), (v) => offset + v);
    const value = (n) => (n === NOTHING ? NaN : offset + step * n);
    const exact = Float64Array.from(new Uint16Array(bytes.buffer), value);
    return kind === "log" ? exact.map((v) => 10 ** v) : exact;
  }

  return (blobs, index) => {
    if (!read.has(index)) read.set(index, decode(blobs[index]));
    return read.get(index);
  };
})();
