"use strict";
// Colours of the page by their names, kept until the theme changes.
const colorsHeld = new Map();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colorsHeld.clear());
function pageColor(name) {
  if (!colorsHeld.has(name)) colorsHeld.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colorsHeld.get(name);
}
// A motion as the page draws it: places of joints and bone tips, m, Z up, at the rate of its file.
function decodeFigure(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  const data = new Float32Array(buffer, 4 + size);
  const J = head.parents.length;
  const rows = data.length / (3 * J);
  const last = rows - 1;
  // The row of a frame of the file: long motions are sent with each second frame, or third.
  const row = (frame) => Math.min(Math.max(frame / head.step, 0), last);
  return {
    ...head, J, data, rows,
    duration: (head.frames - 1) / head.fps,
    // Places at a frame, which may lie between two, into `out (3 J)`.
    at(frame, out) {
      const t = row(frame);
      const a = Math.floor(t), b = Math.min(a + 1, last), w = t - a;
      for (let i = 0, p = 3 * J * a, q = 3 * J * b; i < 3 * J; i++) out[i] = data[p + i] + w * (data[q + i] - data[p + i]);
      return out;
    },
    // One joint's place at a frame of the file.
    place(frame, joint) {
      const i = 3 * (Math.round(row(frame)) * J + joint);
      return [data[i], data[i + 1], data[i + 2]];
    },
    // A joint's curve, one value for each row: m, or m/s for "speed".
    curve(joint, axis) {
      const out = new Float32Array(rows);
      const k = { x: 0, y: 1, z: 2 }[axis];
      for (let t = 0; t < rows; t++) {
        const i = 3 * (t * J + joint);
        if (k !== undefined) out[t] = data[i + k];
        else {
          const a = 3 * (Math.max(t - 1, 0) * J + joint), b = 3 * (Math.min(t + 1, last) * J + joint);
          const span = (Math.min(t + 1, last) - Math.max(t - 1, 0)) * head.step / head.fps || 1;
          out[t] = Math.hypot(data[b] - data[a], data[b + 1] - data[a + 1], data[b + 2] - data[a + 2]) / span;
        }
      }
      return out;
    },
    bounds() {
      const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
      for (let t = 0; t < rows; t += Math.max(1, Math.floor(rows / 200)))
        for (let j = 0; j < J; j++)
          for (let k = 0; k < 3; k++) {
            const v = data[3 * (t * J + j) + k];
            if (v < low[k]) low[k] = v;
            if (v > high[k]) high[k] = v;
          }
      return { low, high };
    },
  };
}
// The frames that a job has simulated so far: the same, of frames that come one after another.
function growingFigure() {
  let head = null, data = null, J = 0, have = null, low = Infinity, high = -1;
  const figure = {
    rows: 0,
    get ready() { return high >= low; },
    get first() { return low; },
    get last() { return high; },
    add(buffer) {
      const size = new DataView(buffer).getUint32(0, true);
      if (!head) {
        head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
        J = head.parents.length;
        Object.assign(figure, head, { J });
        data = new Float32Array(3 * J * head.frames);
        have = new Int32Array(head.frames).fill(-1);
      }
      const rows = new Float32Array(buffer, 4 + size), width = 1 + 3 * J;
      for (let r = 0; r + width <= rows.length; r += width) {
        const frame = rows[r];
        if (!(frame >= 0 && frame < head.frames)) continue;
        data.set(rows.subarray(r + 1, r + width), 3 * J * frame);
        have[frame] = frame;
        low = Math.min(low, frame);
        // A new attempt begins anew.
        high = frame;
      }
      figure.rows += Math.floor(rows.length / width);
      // A frame that was left out shows the one before.
      for (let f = low, at = low; f <= high; f++) { if (have[f] === f) at = f; else have[f] = at; }
    },
    at(frame, out) {
      const f = have[Math.min(Math.max(Math.round(frame), low), high)];
      out.set(data.subarray(3 * J * f, 3 * J * (f + 1)));
      return out;
    },
  };
  return figure;
}
// Colours of faults by their kind.
const FAULTS = {
  "foot slide": "#d9480f", float: "#1c7ed6", penetration: "#862e9c", jitter: "#e8a400", "root jitter": "#e8a400", tremble: "#e8a400",
  flip: "#c2255c", spike: "#c2255c", speed: "#c2255c", "joint jump": "#c2255c", teleport: "#c2255c", "frame rate": "#0b7285",
  "support missing": "#5c7c1f",
};
// What a fault is called on the page, where the doctor's word is another.
const FAULT_NAMES = {
  "foot slide": "slides", float: "floats", penetration: "sinks", jitter: "jitters", "root jitter": "root jitters", tremble: "trembles",
  flip: "flips", spike: "spikes", teleport: "jumps",
};
const faultName = (kind) => FAULT_NAMES[kind] || kind;
const faultColor = (kind) => FAULTS[kind] || "#868e96";
