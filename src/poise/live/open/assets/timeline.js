"use strict";
// The timeline: frames, marks of faults, contacts of the feet, frames that stay, a range, and a curve.
function timelineView(canvas, acts) {
  // What does not change while time goes on is drawn once, below the playhead.
  const front = canvas.getContext("2d"), under = document.createElement("canvas"), ink = under.getContext("2d"), css = pageColor;
  const RULER = 20, ROW = 9, PAD = 10;
  let state = null, span = [0, 1], marks = [], drag = null, told = 0;
  const wide = () => canvas.clientWidth - 2 * PAD;
  const toX = (frame) => PAD + ((frame - span[0]) / (span[1] - span[0] || 1)) * wide();
  const toFrame = (x) => {
    const frame = span[0] + ((x - PAD) / wide()) * (span[1] - span[0]);
    return Math.min(Math.max(Math.round(frame), 0), state.frames - 1);
  };
  const kinds = () => [...new Set(state.faults.map((f) => f.kind))].slice(0, 7);

  function resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    canvas.width = under.width = canvas.clientWidth * ratio;
    canvas.height = under.height = canvas.clientHeight * ratio;
    for (const one of [ink, front]) one.setTransform(ratio, 0, 0, ratio, 0, 0);
    draw();
  }
  function draw() {
    if (!canvas.clientWidth) return;
    ground();
    head();
  }
  function head() {
    if (!under.width || !under.height) return;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    front.drawImage(under, 0, 0, w, h);
    if (!state) return;
    const x = toX(state.frame);
    front.fillStyle = css("--push");
    front.fillRect(x - 1, 0, 2, h);
    front.beginPath();
    front.moveTo(x - 6, 0);
    front.lineTo(x + 6, 0);
    front.lineTo(x, 8);
    front.fill();
  }
  function ground() {
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    ink.clearRect(0, 0, w, h);
    ink.fillStyle = css("--track");
    ink.fillRect(0, 0, w, h);
    if (!state) return;
    const [soft, text, line] = [css("--soft"), css("--ink"), css("--line")];
    ink.font = "11px system-ui, sans-serif";
    ink.textBaseline = "middle";
    // The range that is marked.
    if (state.range) {
      const [a, b] = [toX(state.range[0]), toX(state.range[1])];
      ink.fillStyle = css("--main");
      ink.globalAlpha = 0.16;
      ink.fillRect(a, 0, Math.max(b - a, 1), h);
      ink.globalAlpha = 1;
      ink.fillRect(a - 1, 0, 2, h);
      ink.fillRect(b - 1, 0, 2, h);
    }
    // The part that is simulated so far.
    if (state.made) {
      ink.fillStyle = css("--sim");
      ink.fillRect(toX(state.made[0]), RULER - 4, Math.max(toX(state.made[1]) - toX(state.made[0]), 2), 3);
    }
    const shownFrames = span[1] - span[0];
    const steps = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 50000];
    const step = steps.find((s) => (s / shownFrames) * wide() > 58) || 100000;
    for (let f = Math.ceil(span[0] / step) * step; f <= span[1]; f += step) {
      const x = toX(f);
      ink.fillStyle = line;
      ink.fillRect(x, 0, 1, h);
      ink.fillStyle = soft;
      const words = String(f), long = ink.measureText(words).width;
      ink.fillText(words, x + 5 + long > w ? x - 3 - long : x + 3, 8);
    }
    // Faults, a row for each kind.
    marks = [];
    let y = RULER;
    for (const kind of kinds()) {
      ink.fillStyle = faultColor(kind);
      state.faults.forEach((fault, k) => {
        if (fault.kind !== kind) return;
        const x = toX(fault.start), width = Math.max(toX(fault.stop) - x, 4);
        if (x > w || x + width < 0) return;
        ink.globalAlpha = k === state.fault ? 1 : 0.72;
        ink.fillRect(x, y + 1, width, ROW - 2);
        if (k === state.fault) {
          ink.strokeStyle = text;
          ink.strokeRect(x - 0.5, y + 0.5, width + 1, ROW - 1);
        }
        marks.push({ k, x, y, width });
      });
      ink.globalAlpha = 1;
      y += ROW;
    }
    if (kinds().length) y += 2;
    // Contacts.
    for (const foot of state.contacts) {
      ink.fillStyle = css("--contact");
      ink.globalAlpha = 0.8;
      for (const [a, b] of foot.runs) ink.fillRect(toX(a), y + 1, Math.max(toX(b) - toX(a), 1), 4);
      ink.globalAlpha = 1;
      y += 6;
    }
    y += 3;
    curves(y, h - 4);
    // Frames that stay.
    ink.fillStyle = css("--main");
    for (const key of state.keys) {
      const x = toX(key);
      ink.beginPath();
      ink.moveTo(x, RULER - 11);
      ink.lineTo(x + 5, RULER - 5);
      ink.lineTo(x, RULER + 1);
      ink.lineTo(x - 5, RULER - 5);
      ink.fill();
    }
  }
  function curves(top, bottom) {
    if (bottom - top < 16 || !state.curves.length) return;
    let [low, high] = [Infinity, -Infinity];
    for (const { values } of state.curves) for (const v of values) {
      if (v < low) low = v;
      if (v > high) high = v;
    }
    if (!(high > low)) high = low + 1e-3;
    state.curves.forEach(({ values, color, frames }) => {
      ink.strokeStyle = css(color);
      ink.lineWidth = 1.5;
      ink.beginPath();
      const each = Math.max(1, Math.floor(values.length / 4000));
      for (let t = 0; t < values.length; t += each) {
        const x = toX(frames(t)), y = bottom - ((values[t] - low) / (high - low)) * (bottom - top);
        if (t) ink.lineTo(x, y);
        else ink.moveTo(x, y);
      }
      ink.stroke();
    });
    ink.lineWidth = 1;
    ink.fillStyle = css("--soft");
    ink.fillText(`${high.toFixed(2)} ${state.unit}`, 4, top + 6);
    ink.fillText(`${low.toFixed(2)} ${state.unit}`, 4, bottom - 5);
  }
  const hit = (x, y) => marks.find((m) => x >= m.x - 3 && x <= m.x + m.width + 3 && y >= m.y && y < m.y + ROW);
  const place = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.addEventListener("pointerdown", (event) => {
    if (!state || event.button) return;
    const [x, y] = place(event), found = hit(x, y);
    if (found) return acts.fault(found.k);
    drag = { from: toFrame(x), range: event.shiftKey };
    try { canvas.setPointerCapture(event.pointerId); } catch { /* A pointer that a test made. */ }
    if (!drag.range) acts.seek(drag.from);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!state) return;
    const [x, y] = place(event), found = hit(x, y);
    canvas.style.cursor = found ? "pointer" : "default";
    canvas.title = found ? faultText(state.faults[found.k]) : "Drag to scrub; Shift and drag marks a range; the wheel zooms.";
    if (!drag) return;
    const frame = toFrame(x);
    if (drag.range) acts.range(frame === drag.from ? null : [Math.min(frame, drag.from), Math.max(frame, drag.from)]);
    else acts.seek(frame);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { drag = null; });
  canvas.addEventListener("wheel", (event) => {
    if (!state) return;
    event.preventDefault();
    const [x] = place(event), at = span[0] + ((x - PAD) / wide()) * (span[1] - span[0]);
    const times = Math.exp(0.0016 * event.deltaY);
    const length = Math.min(Math.max((span[1] - span[0]) * times, 8), state.frames - 1 || 1);
    const from = Math.min(Math.max(at - ((x - PAD) / wide()) * length, 0), state.frames - 1 - length);
    span = [Math.max(from, 0), Math.max(from, 0) + length];
    draw();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { if (state) { span = [0, Math.max(state.frames - 1, 1)]; draw(); } });
  new ResizeObserver(resize).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  return {
    draw,
    // Another motion, or other marks; the view stays where the length stays.
    show(next) {
      const same = state && next && state.frames === next.frames;
      state = next;
      if (state && !same) span = [0, Math.max(state.frames - 1, 1)];
      draw();
    },
    // hushed: says the frame to screen readers a few times a second at most, since it plays.
    frame(frame, moment, hushed) {
      if (!state) return;
      state.frame = frame;
      // What plays stays in view.
      const out = frame > span[1] || frame < span[0];
      if (out) {
        const length = span[1] - span[0];
        const from = Math.min(Math.max(frame - 0.1 * length, 0), Math.max(state.frames - 1 - length, 0));
        span = [from, from + length];
      }
      if (out) draw();
      else head();
      if (hushed && performance.now() - told < 400) return;
      told = performance.now();
      canvas.setAttribute("aria-valuemax", state.frames - 1);
      canvas.setAttribute("aria-valuenow", Math.round(frame));
      const now = Math.round(frame), here = state.faults.filter((f) => f.start <= now && now <= f.stop).slice(0, 3);
      canvas.setAttribute("aria-valuetext", [moment, ...here.map((f) => `${f.joint || "whole body"} ${faultName(f.kind)}`)].join(", "));
    },
  };
}
const faultText = (f) => {
  const size = f.unit ? `, ${Number(f.size.toPrecision(3))} ${f.unit}` : "";
  return `${f.joint || "Whole body"}: ${f.title}, frames ${f.start} to ${f.stop}${size}${f.detail ? `, ${f.detail}` : ""}`;
};
