"use strict";
// The page: frames come as bytes and are drawn between two of them, commands go as JSON.
(() => {
  const $ = (id) => document.getElementById(id);
  const token = new URLSearchParams(location.search).get("token");
  const V = 1;
  let socket = null, hello = null, stage = null, chosen = 0, held = null, to = null, figures = null;
  let frames = [], ahead = null, wait = 500, drawn = [], sent = 0;
  const say = (status, text) => { document.body.dataset.status = status; $("link").textContent = text; };
  const send = (message) => {
    if (socket && socket.readyState === 1) socket.send(JSON.stringify({ v: V, ...message }));
  };

  function connect() {
    const kind = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${kind}://${location.host}/live${token ? `?token=${encodeURIComponent(token)}` : ""}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return frame(data);
      const message = JSON.parse(data);
      if (message.type === "hello") greet(message);
      else if (message.type === "figures") show(message);
      else if (message.type === "refused") $("says").textContent = `Refused: ${message.why}.`;
    };
    socket.onopen = () => { wait = 500; };
    socket.onclose = ({ reason }) => {
      say("lost", reason ? `closed: ${reason}` : "no connection, trying again");
      setTimeout(connect, (wait = Math.min(2 * wait, 8000)));
    };
  }

  function greet(message) {
    frames = [];
    if (hello && JSON.stringify(hello) === JSON.stringify(message)) return say("live", "live");
    if (hello) return location.reload();
    hello = message;
    try {
      stage = makeStage($("stage"), hello);
    } catch (error) {
      return say("lost", "this browser draws no WebGL");
    }
    for (let k = 0; k < hello.characters; k++) {
      const button = document.createElement("button");
      button.textContent = String(k + 1);
      button.onclick = () => choose(k);
      $("who").append(button);
    }
    $("who").hidden = hello.characters < 2;
    $("ahead").max = hello.characters;
    $("ahead-row").hidden = !hello.looks_ahead;
    $("record").hidden = !hello.records;
    $("dream").hidden = !hello.dreams;
    choose(0);
    hands();
    say("live", "live");
    requestAnimationFrame(draw);
  }

  function frame(buffer) {
    if (!hello) return;
    const view = new DataView(buffer);
    if (view.getUint32(0, true) !== V) return;
    const [time, K, B] = [view.getFloat64(8, true), view.getUint16(16, true), view.getUint16(18, true)];
    const doing = new Uint8Array(buffer, 20, K);
    const at = 20 + K + ((4 - (K % 4)) % 4);
    const all = new Float32Array(buffer, at);
    const n = 7 * K * B;
    const one = { time, doing, bodies: all.subarray(0, n), goals: all.subarray(n, 2 * n), ball: all.subarray(2 * n) };
    const now = performance.now() / 1000;
    // How far this clock runs ahead of the simulation's, at the least that was seen lately.
    const gap = now - time;
    ahead = ahead === null || Math.abs(gap - ahead) > 0.5 ? gap : Math.min(gap, ahead + 0.001);
    frames.push(one);
    if (frames.length > 12) frames.shift();
  }

  function mixed(a, b, share, out) {
    for (let i = 0; i < a.length; i += 7) {
      for (let k = 0; k < 3; k++) out[i + k] = a[i + k] + share * (b[i + k] - a[i + k]);
      let dot = 0, size = 0;
      for (let k = 3; k < 7; k++) dot += a[i + k] * b[i + k];
      const sign = dot < 0 ? -1 : 1;
      for (let k = 3; k < 7; k++) size += (out[i + k] = (1 - share) * a[i + k] + sign * share * b[i + k]) ** 2;
      size = Math.sqrt(size) || 1;
      for (let k = 3; k < 7; k++) out[i + k] /= size;
    }
    return out;
  }

  let state = null;
  function draw() {
    requestAnimationFrame(draw);
    const now = performance.now() / 1000;
    if (frames.length && ahead !== null) {
      // One and a half steps late, so that there is a frame on either side.
      const at = now - ahead - 1.5 / hello.rate;
      let k = frames.length - 1;
      while (k > 0 && frames[k].time > at) k--;
      const [a, b] = [frames[k], frames[Math.min(k + 1, frames.length - 1)]];
      const share = b.time > a.time ? Math.min(Math.max((at - a.time) / (b.time - a.time), 0), 1) : 0;
      if (!state) state = { bodies: new Float32Array(a.bodies.length), goals: new Float32Array(a.goals.length), ball: new Float32Array(7) };
      state.doing = b.doing;
      for (const name of ["bodies", "goals", "ball"]) mixed(a[name], b[name], share, state[name]);
      stage.draw(state, chosen, $("camera").checked, $("ghosts").checked);
      stage.pull(held, to);
    }
    if (held && now - sent > 0.05) pull(now);
    drawn.push(now);
    while (drawn[0] < now - 1) drawn.shift();
    document.body.dataset.drawn = drawn.length;
  }

  function show(message) {
    figures = message;
    const c = message.characters[chosen];
    $("hz").textContent = message.hz.toFixed(1);
    $("latency").textContent = message.latency_ms.map((x) => x.toFixed(0)).join(" / ");
    $("fps").textContent = drawn.length;
    $("off").textContent = c.off_mm;
    $("falls").textContent = c.falls;
    $("recovered").textContent = c.recovered;
    $("losses").textContent = c.lost;
    $("help").textContent = message.help_n.toFixed(0);
    $("refused").textContent = Object.values(message.refused).reduce((a, b) => a + b, 0);
    $("refused").title = Object.entries(message.refused).map(([why, count]) => `${why}: ${count}`).join(", ");
    $("pause").setAttribute("aria-pressed", message.paused);
    $("dream").setAttribute("aria-pressed", c.endless);
    $("record").setAttribute("aria-pressed", Boolean(message.recording));
    document.body.dataset.doing = c.doing;
    document.body.dataset.compliance = c.compliance;
    for (const [id, value] of [["buffer", message.buffer], ["noise", message.noise], ["ahead", message.lookahead], ["comply", c.compliance]])
      if (document.activeElement !== $(id)) $(id).value = value;
    told();
    const names = message.people.map((p) => p.name);
    if (JSON.stringify(names) !== $("follow").dataset.names) {
      $("follow").dataset.names = JSON.stringify(names);
      $("follow").replaceChildren(new Option("nobody", ""), ...names.map((name) => new Option(name, name)));
    }
    if (document.activeElement !== $("follow")) $("follow").value = c.follows || "";
    const waits = message.people.find((p) => p.said && p.name === c.follows);
    const last = message.recorded && message.recorded.length ? `Recorded ${message.recorded.join(", ")}. ` : "";
    const shakes = message.people.find((p) => p.trembles_mm && p.name === c.follows);
    const steadied = shakes ? ` ${shakes.name} trembles by ${shakes.trembles_mm} mm${shakes.hz ? ` at ${shakes.hz} Hz` : ""}: smoothed, ${shakes.late_ms} ms later.` : "";
    $("says").textContent = waits ? `${waits.name}: ${waits.said} (${Math.round(100 * waits.calibrated)} %)`
      : c.endless ? `The character ${c.doing} endless motion.`
      : c.doing === "at ease" ? "Nobody is here to follow." : `${last}The character ${c.doing}.${steadied}`;
  }

  const told = () => {
    $("buffer-now").textContent = `${Math.round(1000 * $("buffer").value)} ms`;
    $("noise-now").textContent = Number($("noise").value).toFixed(2);
    $("comply-now").textContent = Number($("comply").value).toFixed(2);
    $("ahead-now").textContent = `${$("ahead").value} of ${hello.characters}`;
  };
  function choose(k) {
    chosen = k;
    [...$("who").children].forEach((button, i) => button.setAttribute("aria-pressed", i === k));
    if (figures) show(figures);
  }
  const toggle = (type) => () => {
    const on = $(type).getAttribute("aria-pressed") !== "true";
    $(type).setAttribute("aria-pressed", on);
    send({ type, on });
  };
  const acts = {
    knock: () => send({ type: "knock", character: chosen }),
    ball: () => send({ type: "ball", character: chosen }),
    dream: () => {
      const on = $("dream").getAttribute("aria-pressed") !== "true";
      $("dream").setAttribute("aria-pressed", on);
      send({ type: "dream", character: chosen, on });
    },
    record: toggle("record"),
    pause: toggle("pause"),
  };
  const comply = (level) => {
    $("comply").value = level;
    told();
    send({ type: "comply", character: chosen, level: Number($("comply").value) });
  };
  function pull(now) {
    sent = now;
    send({ type: "pull", character: held.character, body: held.body, point: held.point, to });
  }

  function hands() {
    for (const [id, act] of Object.entries(acts)) $(id).onclick = act;
    for (const [id, name] of [["buffer", "buffer"], ["noise", "noise"], ["ahead", "lookahead"]])
      $(id).oninput = () => { told(); send({ type: "set", [name]: Number($(id).value) }); };
    $("comply").oninput = () => comply($("comply").value);
    $("follow").onchange = () => send({ type: "follow", character: chosen, person: $("follow").value || null });
    const host = $("stage");
    const place = (event) => { const box = host.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    host.addEventListener("pointerdown", (event) => {
      if (!state || event.button) return;
      const [x, y] = place(event);
      const found = stage.pick(x, y, state);
      if (!found) return;
      held = found;
      choose(found.character);
      to = stage.under(x, y, found.z);
      stage.controls.enabled = false;
      event.stopPropagation();
      try { host.setPointerCapture(event.pointerId); } catch { /* A pointer that a test made. */ }
    }, true);
    host.addEventListener("pointermove", (event) => { if (held) to = stage.under(...place(event), held.z); });
    const release = () => {
      if (!held) return;
      send({ type: "release", character: held.character });
      held = null;
      stage.controls.enabled = true;
    };
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) host.addEventListener(name, release);
    addEventListener("blur", release);
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT)$/.test(event.target.tagName)) return;
      const key = event.key.toLowerCase();
      if (key === " " && event.target.tagName === "BUTTON") return;
      const digit = Number(key);
      if (digit >= 1 && digit <= hello.characters) choose(digit - 1);
      else if (key === "k") acts.knock();
      else if (key === "b") acts.ball();
      else if (key === "r" && hello.records) acts.record();
      else if (key === "e" && hello.dreams) acts.dream();
      else if (key === "+" || key === "-") comply(Number($("comply").value) + (key === "+" ? 0.05 : -0.05));
      else if (key === " ") acts.pause();
      else if (key === "g") $("ghosts").checked = !$("ghosts").checked;
      else if (key === "c") $("camera").checked = !$("camera").checked;
      else return;
      event.preventDefault();
    });
  }

  window.poiseLive = { screen: (body) => stage.screen(chosen, body), get state() { return state; } };
  connect();
})();
