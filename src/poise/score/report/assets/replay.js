// The replay's clock, controls, labels and scrubber; it drives whichever stage the browser can show.
Poise.replay = (data) => {
  const $ = (id) => document.getElementById(id);
  const extent = Poise.extent(data);
  const n = data.bodies.length;
  const host = $("stage");
  const seconds = Math.max(data.frames - 1, 1) / data.fps;
  const state = { at: 0, playing: true, speed: 1, overlay: false, follow: true, force: true, touch: false, blend: 1 };
  const listeners = [];
  const blank = () => ({ pos: new Float32Array(n * 3), quat: new Float32Array(n * 4) });
  const poses = { reference: blank(), simulated: blank(), others: data.others.map(blank) };
  const scale = Poise.arrowScale(data.forceNorm);
  // A push is drawn as long as an arm; contacts by the body's weight. Of twenty arrows one may be cut off at
  // 1 m: a blow of a few frames would leave nothing to see of the others.
  const sizes = [];
  for (let k = 0; data.pushed && data.pushes && k < data.pushes.rows.length; k += 6)
    sizes.push(Math.hypot(...data.pushes.rows.subarray(k + 3, k + 6)));
  const hard = sizes.sort((a, b) => a - b)[Math.floor(0.95 * (sizes.length - 1))] || 0;
  const pushScale = Math.max(1, hard ? Math.round(hard / 0.7) : Math.round((data.weight || 700) / 100) * 100);
  const target = [0, 0, 0];
  let fresh = true;

  let stage = null;
  const plain = location.hash.includes("2d");
  if (!plain && typeof THREE !== "undefined") {
    try {
      stage = Poise.stageGL(host, data, extent);
    } catch (error) {
      for (const c of host.querySelectorAll("canvas")) c.remove();
    }
  }
  if (!stage) stage = Poise.stage2D(host, data, extent);
  $("fallback").hidden = stage.kind === "webgl" || plain;

  // A resized canvas is empty, so it is drawn again at once instead of flashing until the next tick.
  const fit = () => {
    stage.resize(host.clientWidth, host.clientHeight);
    stage.draw(frameAt(0));
  };
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => stage.theme());

  function frameAt(dt) {
    Poise.sample(data.reference, n, data.frames, state.at, poses.reference);
    Poise.sample(data.simulated, n, data.frames, state.at, poses.simulated);
    data.others.forEach((track, k) => Poise.sample(track, n, data.frames, state.at, poses.others[k]));
    const aim = state.overlay ? 0 : 1;
    state.blend += (aim - state.blend) * (1 - Math.exp(-dt * 9));
    const half = (extent.gap / 2) * state.blend;
    const [sx, sy] = extent.apart;
    const [r, s] = [poses.reference.pos, poses.simulated.pos];
    const want = [(r[0] + s[0]) / 2, (r[1] + s[1]) / 2, 0.5 * extent.top + 0.12];
    const ease = fresh ? 1 : 1 - Math.exp(-dt * 7);
    for (const k of [0, 1, 2]) target[k] += (want[k] - target[k]) * ease;
    fresh = false;
    const t = Math.round(state.at);
    let arrow = null;
    if (data.force && state.force && !data.helps) {
      arrow = [0, 1, 2].map((k) => data.force[3 * t + k] / scale);
      if (!arrow.every(Number.isFinite)) arrow = null;
    }
    // Of each contact or residual force its point and its force, in metres of an arrow.
    const rows = ({ rows, first }, scale, most = Infinity) =>
      Array.from({ length: first[t + 1] - first[t] }, (_, j) => 6 * (first[t] + j)).map((k) => {
        const by = Math.max(scale, Math.hypot(...rows.subarray(k + 3, k + 6)) / most);
        return Array.from(rows.subarray(k, k + 6), (v, i) => (i < 3 ? v : v / by));
      });
    const pushes = data.pushes && state.touch ? rows(data.pushes, pushScale, data.pushed ? 1 : Infinity) : [];
    const helps = data.helps && state.force ? rows(data.helps, scale) : [];
    const movers = data.movers.map(({ way }) => way.subarray(7 * t, 7 * t + 7));
    const lit = [0, 1].map((k) => Boolean(data.contacts && data.contacts[2 * t + k]));
    const shift = [[-half * sx, -half * sy], [half * sx, half * sy]];
    return { ...poses, shift, target, blend: state.blend, follow: state.follow, arrow, pushes, helps, movers, lit };
  }

  function tag(id, pose, shift) {
    let top = 0;
    for (let b = 0; b < n; b++) top = Math.max(top, pose.pos[3 * b + 2]);
    const p = stage.project(pose.pos[0] + shift[0], pose.pos[1] + shift[1], top + 0.27);
    const el = $(id);
    el.hidden = !p;
    if (!p) return;
    const [x, y] = [p[0] * host.clientWidth, Math.max(82, p[1] * host.clientHeight)];
    el.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
  }

  const text = (id, value) => { const el = $(id); if (el && el.textContent !== value) el.textContent = value; };
  const figure = (v, unit) => (v === undefined || v === null || !Number.isFinite(v) ? "–" : `${v.toFixed(0)} ${unit}`);
  let shown = -1;
  function readout() {
    const t = Math.round(state.at);
    $("cursor").style.left = `${(100 * state.at) / Math.max(data.frames - 1, 1)}%`;
    if (t === shown) return;
    shown = t;
    text("now-time", `${(t / data.fps).toFixed(2)} / ${seconds.toFixed(2)} s`);
    text("now-frame", `${t + 1} / ${data.frames}`);
    text("now-error", figure(data.error && data.error[t], "mm"));
    const f = data.forceNorm ? data.forceNorm[t] : undefined;
    const share = data.weight && Number.isFinite(f) ? ` · ${((100 * f) / data.weight).toFixed(1)} % of weight` : "";
    text("now-help", data.forceNorm ? figure(f, "N") + share : "none recorded");
    for (const k of [0, 1]) {
      const el = $(k ? "foot-r" : "foot-l");
      if (el) el.classList.toggle("on", Boolean(data.contacts && data.contacts[2 * t + k]));
    }
    const strip = $("strip");
    strip.setAttribute("aria-valuenow", String(t));
    strip.setAttribute("aria-valuetext", `frame ${t + 1}, ${(t / data.fps).toFixed(2)} seconds, error ${$("now-error").textContent}`);
    for (const f of listeners) f(t);
  }

  function seek(frame, pause) {
    const next = Math.min(data.frames - 1, Math.max(0, frame));
    if (Math.abs(next - state.at) > 0.7 * data.fps) fresh = true;
    state.at = next;
    if (pause) play(false);
    readout();
  }
  function play(on) {
    state.playing = on;
    $("play").setAttribute("aria-label", on ? "Pause" : "Play");
    $("play").classList.toggle("on", on);
  }

  let before = 0;
  function tick(now) {
    const dt = Math.min(0.1, Math.max(0, (now - before) / 1000));
    before = now;
    if (state.playing && data.frames > 1) {
      state.at += dt * data.fps * state.speed;
      if (state.at > data.frames - 1) {
        state.at = 0;
        fresh = true;
      }
    }
    const frame = frameAt(dt);
    stage.draw(frame);
    host.classList.toggle("over", state.overlay);
    tag("tag-ref", frame.reference, frame.shift[0]);
    tag("tag-sim", frame.simulated, frame.shift[1]);
    readout();
    requestAnimationFrame(tick);
  }

  function toggle(id, key, act) {
    const button = $(id);
    button.addEventListener("click", () => {
      state[key] = !state[key];
      button.setAttribute("aria-pressed", String(state[key]));
      if (act) act();
    });
  }
  function overlay(on) {
    state.overlay = on;
    $("side").setAttribute("aria-pressed", String(!on));
    $("over").setAttribute("aria-pressed", String(on));
  }
  $("side").addEventListener("click", () => overlay(false));
  $("over").addEventListener("click", () => overlay(true));
  toggle("follow", "follow", () => { fresh = true; });
  toggle("force", "force");
  toggle("touch", "touch", () => { $("push-key").hidden = !state.touch; });
  $("touch").hidden = !data.pushes;
  // Each click leads a second before the next moment at which the motion is lost, then to the first again.
  const lost = data.lost || [];
  $("loss").hidden = !lost.length;
  let next = 0;
  $("loss").addEventListener("click", () => {
    seek(Math.round((lost[next % lost.length] - 1) * data.fps), false);
    next += 1;
    play(true);
  });
  $("force").disabled = !data.force;
  $("play").addEventListener("click", () => play(!state.playing));
  $("speed").addEventListener("input", (e) => {
    state.speed = Number(e.target.value);
    text("speed-text", `${state.speed.toFixed(1)}×`);
  });
  // A mouse click should not leave a button in charge of the space bar.
  document.addEventListener("click", (e) => {
    const hit = e.target.closest && e.target.closest("button");
    if (hit && e.detail > 0) hit.blur();
  });
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const on = e.target.tagName;
    if (on === "INPUT" || on === "SELECT" || (on === "BUTTON" && (e.key === " " || e.key === "Enter"))) return;
    const step = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity }[e.key];
    if (e.key === " ") play(!state.playing);
    else if (step && (Number.isFinite(step) || on !== "BODY")) seek(Math.round(state.at) + step * (e.shiftKey ? 10 : 1), true);
    else if (e.key === "o") overlay(!state.overlay);
    else if (e.key === "f") $("follow").click();
    else if (e.key === "l" && lost.length) $("loss").click();
    else return;
    e.preventDefault();
  });

  if (data.forceNorm) text("arrow-scale", `1 m = ${scale} N`);
  $("arrow-key").hidden = !data.force;
  $("foot-key").hidden = !data.contacts;
  $("push-key").hidden = !state.touch;
  text("push-scale", `${pushScale} N`);
  // `#2d`, `#overlaid`, `#contacts` and `#at=2.5` (s) after the file's name choose how the page opens.
  if ((data.pushed || location.hash.includes("contacts")) && data.pushes) $("touch").click();
  const start = /at=([0-9.]+)/.exec(location.hash);
  if (start) seek(Math.round(Number(start[1]) * data.fps), true);
  // Others stand beside the simulation, where its ghost would stand apart.
  if (location.hash.includes("overlaid") || data.others.length || data.pushed) {
    overlay(true);
    state.blend = 0;
  }
  Poise.strip($("strip"), data, seek);
  fit();
  new ResizeObserver(fit).observe(host);
  play(!start && !matchMedia("(prefers-reduced-motion: reduce)").matches);
  requestAnimationFrame(tick);
  return { kind: stage.kind, seek, onFrame: (f) => listeners.push(f), fps: data.fps };
};

// The scrubber: error above, help below, foot contacts at the foot of it; drag or click to seek.
Poise.strip = (host, data, seek) => {
  const lanes = [];
  const most = (v) => { let m = 0; for (const x of v || []) if (x > m) m = x; return m; };
  function area(values, y0, y1, name) {
    const high = most(values) || 1;
    let d = `M0 ${y1}`;
    values.forEach((v, t) => { d += `L${t} ${(y1 - (y1 - y0) * (Number.isFinite(v) ? v / high : 0)).toFixed(2)}`; });
    lanes.push(`<path class="lane ${name}" d="${d}L${data.frames - 1} ${y1}Z"/>`);
  }
  const help = Boolean(data.forceNorm);
  area(data.error, 8, help ? 54 : 90, "lane-error");
  if (help) area(data.forceNorm, 60, 90, "lane-help");
  if (data.contacts)
    for (const side of [0, 1])
      for (let t = 0; t < data.frames; t++)
        if (data.contacts[2 * t + side]) lanes.push(`<rect class="lane-foot" x="${t - 0.5}" width="1.02" y="${93 + 4 * side}" height="3"/>`);
  for (const t of data.lost || []) {
    const x = (t * data.fps).toFixed(2);
    lanes.push(`<path class="lane-lost" d="M${x} 0V100"/>`);
  }
  const span = Math.max(data.frames - 1, 1);
  document.getElementById("lanes").innerHTML =
    `<svg viewBox="0 0 ${span} 100" preserveAspectRatio="none" aria-hidden="true">${lanes.join("")}</svg>`;
  document.getElementById("lane-error-text").textContent = `error, peak ${most(data.error).toFixed(0)} mm`;
  document.getElementById("lane-help-text").textContent = help ? `help, peak ${most(data.forceNorm).toFixed(0)} N` : "";
  host.setAttribute("aria-valuemax", String(data.frames - 1));
  const at = (e) => {
    const box = host.getBoundingClientRect();
    seek(((e.clientX - box.left) / box.width) * span);
  };
  host.addEventListener("pointerdown", (e) => { host.setPointerCapture(e.pointerId); at(e); });
  host.addEventListener("pointermove", (e) => { if (e.buttons) at(e); });
};
