"use strict";
// The page of `poise open`: the project comes over a WebSocket, motions by fetch, and what is asked for goes as JSON.
(() => {
  const $ = (id) => document.getElementById(id);
  const V = 1;
  let socket = null, hello = null, project = null, view = null, line = null, forms = null, wait = 400;
  let frame = 0, playing = 0, last = performance.now(), fault = -1, range = null, seen = null, joint = null, redo = [];
  let opened = null, drag = null, compare = "", asked = "", drawn = [], dirty = true, growing = null, unread = false;
  const motions = new Map(), kept = new Map();
  const token = new URLSearchParams(location.search).get("token");
  // The browser keeps it as a cookie; the address need not show it.
  if (token) history.replaceState(null, "", location.pathname);
  const say = (status, text) => { document.body.dataset.status = status; $("link").textContent = text; };
  const send = (message) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify({ v: V, ...message })); };
  const make = (tag, more = {}, ...inside) => { const made = Object.assign(document.createElement(tag), more); made.append(...inside); return made; };
  const door = (path) => `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`;
  let hiding = 0;
  function toast(text, kind = "") {
    $("toast").textContent = text;
    $("toast").dataset.kind = kind;
    clearTimeout(hiding);
    hiding = setTimeout(() => { $("toast").textContent = ""; }, kind === "refused" ? 14000 : 6000);
  }

  // --- the server -----------------------------------------------------------------------------

  function connect() {
    socket = new WebSocket(door("/open"));
    socket.onopen = () => { wait = 400; say("live", ""); };
    socket.onclose = ({ reason }) => {
      say("lost", reason ? `closed: ${reason}` : "no connection, trying again");
      setTimeout(connect, (wait = Math.min(2 * wait, 8000)));
    };
    socket.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      if (message.type === "hello") greet(message);
      else if (message.type === "project") show(message);
      else if (message.type === "refused") toast(message.why, "refused");
      else if (message.type === "line") {
        const form = forms.get(message.action);
        if (form) form.line.textContent = message.line;
      }
    };
  }
  function greet(message) {
    if (hello) return;
    hello = message;
    try {
      view = stageView($("stage"), $("over"));
    } catch (error) {
      return say("lost", "this browser draws no WebGL");
    }
    line = timelineView($("timeline"), { seek, fault: goFault, range: setRange });
    forms = actionForms($("actions"), hello.actions, {
      run, rests: () => send({ type: "rests", take: current() }), openRig: () => pickFiles("rig"), opened: opens, now: () => opened,
      rigs: () => (project ? project.takes : []).filter((t) => t.id !== current()).map((t) => [t.id, t.name]),
      frame: () => Math.round(frame), frames: () => (motion() ? motion().frames : 1), range: () => range,
      rangeText: () => (range ? `frames ${range[0]} to ${range[1]}` : "mark one on the timeline: I and O, or Shift and drag"),
      limb: (name) => limbAt(name), seat: seatHere, arrow: arrowNow,
    });
    for (const form of forms.values()) form.changed = () => { dirty = true; askLine(form); if (form.action.name === "chair") showBoxes(); };
    view.changed(() => { dirty = true; });
    requestAnimationFrame(draw);
  }
  const current = () => (project ? project.current : "");
  const take = (id = current()) => project && project.takes.find((t) => t.id === id);
  const motion = (id = current()) => (motions.get(id) || {}).figure || null;
  const judged = (id = current()) => (motions.get(id) || {}).judged || null;

  function show(message) {
    const before = project;
    project = message;
    document.body.dataset.has = project.takes.length ? "yes" : "no";
    for (const t of project.takes) for (const kind of ["figure", "judged"]) if (wanted(t, kind)) load(t, kind);
    const newest = before ? before.events.reduce((n, e) => Math.max(n, e.number), 0) : Infinity;
    for (const event of project.events) if (event.number > newest) happened(event);
    if (!before || before.current !== project.current) changed(before ? before.current : "");
    list();
    jobs();
    grow();
    beside();
    if (!motion()) judgements();
  }
  // Only what is looked at is fetched.
  const wanted = (t, kind) => t[kind] && [project.current, compare].includes(t.id) && (motions.get(t.id) || {})[`${kind}_at`] !== t[kind];
  async function load(t, kind) {
    const mine = motions.get(t.id) || {};
    mine[`${kind}_at`] = t[kind];
    motions.set(t.id, mine);
    try {
      const got = await fetch(`/${kind}/${t.id}`);
      if (!got.ok) throw new Error(got.statusText);
      mine[kind] = kind === "figure" ? decodeFigure(await got.arrayBuffer()) : await got.json();
      // What the body sat on is there.
      if (kind === "judged" && t.boxes.length) mine.judged.faults = mine.judged.faults.filter((f) => f.kind !== "support missing");
    } catch (error) {
      mine[`${kind}_at`] = 0;
      return;
    }
    if (kind === "figure") { mine.judged = t.judged === mine.judged_at ? mine.judged : null; }
    // Of what was looked at long ago places are forgotten.
    for (const id of [...motions.keys()].slice(0, -12)) if (id !== current() && id !== compare) motions.delete(id);
    if (t.id === current()) arrived(kind);
    else if (t.id === compare) arrived("compare");
  }
  function happened(event) {
    if (event.kind === "rests") {
      if (event.boxes.length) {
        forms.get("chair").set("boxes", event.boxes.map((b) => ({ kind: b.kind, size: b.size, pos: b.pos, yaw: b.yaw })));
        // The moment that the box is about, in its middle.
        const rest = judged(event.take) && judged(event.take).faults.find((f) => f.kind === "support missing");
        if (rest && event.take === current()) { play(0); seek(Math.round((rest.start + rest.stop) / 2)); }
        toast("Found. Drag the box if it stands wrong, then press Put a chair.");
      } else toast(`${event.text} Add a seat if there should be one.`);
    } else if (event.kind === "exported") {
      const link = make("a", { href: `/export/${event.file}`, download: "" });
      link.click();
      toast(event.text);
    } else if (event.kind === "refused") problem(event.text, remedy(event));
    else if (event.text) toast(event.text, event.kind);
  }

  // Controls that mend how a file is read, where its error has one.
  function remedy({ code, take: id }) {
    const t = take(id);
    if (!t) return [];
    const read = (values) => { problem(""); send({ type: "reading", take: id, values: { ...stated(t), ...values() } }); };
    const button = (values) => make("button", { className: "main", textContent: "Read it", onclick: () => read(values) });
    if (code === "pickle-refused") return [button(() => ({ allow_pickle: true }))];
    if (code !== "rate-missing") return [];
    const rate = make("input", { type: "number", min: 1, max: 1000, step: "any", value: 30 });
    rate.setAttribute("aria-label", "Frames per second");
    return [rate, button(() => ({ fps: Number(rate.value) }))];
  }
  // What only the command line can state stays.
  const stated = (t) => Object.fromEntries(Object.entries(t.reading).filter(([k]) => k in hello.reading));

  // What went wrong stays until it is read.
  function problem(text, cure = []) {
    $("problem").hidden = !text;
    const close = make("button", { className: "plain", textContent: "Close", onclick: () => problem("") });
    $("problem").replaceChildren(make("div", { textContent: text }), make("div", { className: "row" }, ...cure, close));
    if (text) $("right").scrollTop = 0;
  }

  // --- what is shown --------------------------------------------------------------------------

  function changed(before) {
    if (before && motion(before)) kept.set(before, frame);
    const t = take();
    fault = -1;
    dirty = true;
    if (!t) { view.show(null, null); line.show(null); return; }
    const fresh = !kept.has(t.id) && before && t.parent === before;
    if (!fresh && kept.has(t.id) && !related(t.id, before)) frame = kept.get(t.id);
    else if (!related(t.id, before)) { frame = 0; view.frame(); setRange(null); }
    compare = t.parent && take(t.parent) ? t.parent : "";
    if (!compare && before && take(before) && take(before).parent === t.id) compare = before;
    for (const one of project.takes) for (const kind of ["figure", "judged"]) if (wanted(one, kind)) load(one, kind);
    if (fresh && t.moment !== null) { frame = Math.max(t.moment - 10, 0); play(1); }
    forms.get("between").values.keyframes = [];
    forms.get("chair").values.boxes = t.boxes.map((b) => ({ kind: b.kind, size: b.size, pos: b.pos, yaw: b.yaw }));
    for (const form of forms.values()) for (const name of ["pins", "touches"]) if (form.values[name]) form.values[name] = [];
    for (const form of forms.values()) form.refresh();
    arrived("figure");
  }
  // Whether two motions are versions of one.
  function related(a, b) {
    const root = (id) => { let t = take(id); while (t && t.parent && take(t.parent)) t = take(t.parent); return t ? t.id : id; };
    return a && b && root(a) === root(b);
  }
  function arrived(kind) {
    const m = motion();
    if (view) stage();
    if (!m) { line.show(null); judgements(); said(); return; }
    frame = Math.min(frame, m.frames - 1);
    if (joint === null || !m.names.includes(joint)) {
      const first = ["left_foot", "right_foot", "hips"].map((r) => m.roles[r]).find((j) => j !== undefined);
      joint = m.names[first === undefined ? 0 : first];
    }
    const names = m.names.slice(0, m.joints);
    if ($("joint").dataset.names !== names.join("\n")) {
      $("joint").dataset.names = names.join("\n");
      $("joint").replaceChildren(...names.map((n) => new Option(n, n)));
    }
    $("joint").value = joint;
    $("export").disabled = false;
    for (const form of forms.values()) form.run.disabled = false;
    formats(m);
    timeline();
    judgements();
    said();
    seek(frame);
    showBoxes();
    if (opened) opens(opened);
  }
  function timeline() {
    dirty = true;
    const m = motion(), j = judged(), other = motion(compare);
    if (!m) return;
    const axis = $("axis").value, curves = [];
    const add = (of, color) => {
      const at = of.names.indexOf(joint);
      if (at >= 0) curves.push({ values: of.curve(at, axis), color, frames: (t) => (t * of.step * m.fps) / of.fps });
    };
    if (other && $("mode").value !== "off") add(other, "--ref");
    add(m, "--sim");
    line.show({
      frames: m.frames, fps: m.fps, frame, faults: j ? j.faults : [], contacts: j ? j.contacts : [], fault, range, curves,
      keys: opened && opened.values.keyframes ? opened.values.keyframes : [], unit: axis === "speed" ? "m/s" : "m",
      made: made() ? [toMotion(made(), made().first), toMotion(made(), made().last)] : null,
    });
  }
  function list() {
    const rows = [];
    const add = (t, depth) => {
      const now = t.id === project.current;
      const name = make("button", { className: "name", type: "button", onclick: () => choose(t.id) }, t.parent ? t.name.slice(common(t)) : t.name);
      name.style.paddingLeft = `${6 + 12 * depth}px`;
      name.title = t.line ? `${t.name}: ${t.line}` : t.name;
      name.dataset.take = t.id;
      if (now) name.setAttribute("aria-current", "true");
      const sub = t.looking ? "reading" : t.line ? t.line.split(" ").slice(0, 2).join(" ") : t.suffix.slice(1).toUpperCase();
      name.append(make("small", { textContent: sub }));
      const row = make("div", { className: "take" }, name);
      row.setAttribute("role", "listitem");
      if (now) {
        row.setAttribute("aria-current", "true");
        const remove = make("button", { className: "plain", textContent: "✕", title: "Take it off the list; its file stays", onclick: () => { send({ type: "hide", take: t.id }); toast(`${t.name} is off the list. Its file stays.`); } });
        remove.setAttribute("aria-label", `Take ${t.name} off the list`);
        row.append(remove);
      }
      rows.push(row);
      for (const child of project.takes.filter((c) => c.parent === t.id)) add(child, depth + 1);
    };
    const shown = new Set(project.takes.map((t) => t.id));
    for (const t of project.takes) if (!shown.has(t.parent)) add(t, 0);
    const words = rows.map((r) => r.innerHTML + r.getAttribute("aria-current")).join();
    if ($("takes").dataset.words === words) return;
    $("takes").dataset.words = words;
    const focused = document.activeElement && document.activeElement.closest && document.activeElement.closest("#takes") ? [...$("takes").querySelectorAll("button")].indexOf(document.activeElement) : -1;
    $("takes").replaceChildren(...rows);
    if (focused >= 0) ($("takes").querySelectorAll("button")[focused] || $("choose")).focus();
    const t = take();
    $("undo").disabled = !(t && t.parent && take(t.parent));
    $("redo").disabled = !redo.some((id) => take(id) && take(id).parent === project.current);
  }
  // A version's name without that of its parent.
  const common = (t) => { const p = take(t.parent); return p && t.name.startsWith(`${p.name} `) ? p.name.length + 1 : 0; };
  function jobs() {
    const work = project.jobs.filter((j) => j.lane === "work" || j.label === "Exporting");
    $("jobs").hidden = !work.length;
    const rows = work.map((j) => {
      // A bar without a share would move all the time, and with it the page be drawn.
      const bar = make("progress", { value: j.share || 0 });
      bar.setAttribute("aria-label", j.label);
      const stop = make("button", { textContent: j.state === "stopping" ? "Stopping" : "Stop", disabled: j.state === "stopping", onclick: () => send({ type: "stop", job: j.id }) });
      const text = j.state === "waiting" ? "waits for the one before" : j.text || "starting";
      return make("div", { className: "job" }, make("div", {}, make("strong", { textContent: `${j.label} · ${Math.round(j.seconds)} s` }), stop), bar, make("small", { textContent: text }));
    });
    const had = document.activeElement && document.activeElement.closest && document.activeElement.closest("#jobs");
    $("jobs").replaceChildren(...rows);
    if (had && rows.length) $("jobs").querySelector("button").focus();
    const looking = project.jobs.find((j) => j.lane === "look" && j.take === project.current);
    if (document.body.dataset.status === "live") $("link").textContent = looking ? (motion() ? "looking for faults" : looking.seconds > 3 ? "starting, the first file takes longest" : "reading") : "";
    document.body.dataset.busy = work.length ? "yes" : "no";
    for (const form of forms.values()) form.run.disabled = !motion();
  }
  // What the job on the motion that is shown has simulated so far comes in parts, and is shown over it.
  async function grow() {
    const job = project.jobs.find((j) => j.lane === "work" && j.take === current() && j.drawn);
    if (growing && (!job || job.id !== growing.job)) { growing = null; timeline(); }
    if (!job || (growing && growing.busy)) return;
    if (!growing) growing = { job: job.id, figure: growingFigure(), size: 0, led: !playing, busy: false };
    const mine = growing;
    if (job.drawn === mine.size) return;
    mine.busy = true;
    mine.size = job.drawn;
    try {
      const got = await fetch(`/drawn/${job.id}/${mine.figure.rows}`);
      if (got.ok) mine.figure.add(await got.arrayBuffer());
    } catch (error) { /* The job ended meanwhile. */ }
    setTimeout(() => { mine.busy = false; if (mine === growing) grow(); }, 250);
    if (mine !== growing || !mine.figure.ready || !motion()) return;
    beside();
    // Time goes along with the work until somebody takes it.
    if (mine.led && !playing) { mine.at = toMotion(mine.figure, mine.figure.last); seek(mine.at); }
    timeline();
  }
  const toMotion = (of, at) => (at / of.fps) * motion().fps;
  function beside() {
    const options = [["", "nothing"], ...project.takes.filter((t) => t.id !== project.current).map((t) => [t.id, t.name])];
    const job = made() && project.jobs.find((j) => j.id === growing.job);
    const words = JSON.stringify([options, compare, job && job.id]);
    if ($("beside").dataset.words === words) return;
    $("beside").dataset.words = words;
    $("beside").replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    $("beside").value = compare;
    $("legend").replaceChildren();
    const mark = (color, text) => { const b = make("b"); b.style.background = `var(${color})`; return make("span", {}, b, text); };
    if (job) $("legend").append(mark("--sim", `${job.label}, so far`), mark("--ref", take().name));
    else if (compare && take(compare) && take()) {
      $("legend").append(mark("--sim", take().name), mark("--ref", take(compare).name));
    }
  }
  function formats(m) {
    const root = rootSuffix(take()), all = Object.entries(hello.exports);
    // A format that is only read goes out as BVH, which animators' tools take.
    const came = hello.exports[root] ? root : [".glb", ".usda"].includes(m.home) ? m.home : "";
    const first = came ? [[came, `as it came in (${came.slice(1).toUpperCase()})`]] : [];
    const options = [...first, ...all.filter(([s]) => s !== came)];
    const words = JSON.stringify(options);
    if ($("format").dataset.words === words) return;
    $("format").dataset.words = words;
    $("format").replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  }
  const rootSuffix = (t) => { while (t.parent && take(t.parent)) t = take(t.parent); return t.suffix; };

  function said() {
    const t = take();
    const words = t ? t.id + t.says.join() : "";
    if ($("says").dataset.words === words) return;
    $("says").dataset.words = words;
    $("says").hidden = !t || !t.says.length;
    if (!t) return;
    const more = t.says.slice(3);
    $("says").replaceChildren(...t.says.slice(0, 3).map((text) => make("p", { textContent: text })));
    if (more.length) $("says").append(make("details", {}, make("summary", { textContent: "More" }), make("ul", {}, ...more.map((text) => make("li", { textContent: text })))));
    if (t.report) $("says").append(make("a", { href: `/report/${t.id}`, target: "_blank", rel: "noopener", textContent: "The whole report" }));
  }
  const UNITS = [["m", "metres"], ["dm", "decimetres"], ["cm", "centimetres"], ["mm", "millimetres"], ["in", "inches"], ["ft", "feet"]];
  const UNIT_M = { m: 1, dm: 0.1, cm: 0.01, mm: 0.001, in: 0.0254, ft: 0.3048 };
  function judgements() {
    const j = judged(), t = take(), m = motion();
    $("guessed").hidden = !t || Boolean(t.parent) || (!m && t.looking);
    $("faulty").hidden = !m;
    if (!t || t.parent && !m) return;
    if (!m) {
      // It cannot be read: what is stated may help.
      const words = JSON.stringify([t.id, t.looking, t.reading]);
      if ($("faulty").dataset.words === words) return;
      $("faulty").dataset.words = words;
      if (!t.looking && !t.figure) $("guessed").open = unread = true;
      $("guess-line").textContent = "it cannot be read so";
      return guesses(null, null, t);
    }
    const words = JSON.stringify([t.id, t.reading, t.figure, t.judged, Boolean(j)]);
    if ($("faulty").dataset.words === words) return;
    $("faulty").dataset.words = words;
    if (unread && m) $("guessed").open = unread = false;
    $("guess-line").textContent = `${m.up_axis} up, ${unitName(m.unit_m)}, ${Number(m.fps.toPrecision(4))} Hz, ${m.height_m.toFixed(2)} m tall`;
    guesses(m, j, t);
    const alone = j ? j.faults.filter((f) => f.kind === "support missing").length : 0;
    const rest = alone ? `, and ${alone} where a support is missing` : "";
    $("fault-line").textContent = !j ? "looking" : j.faults.length ? `${j.faults.length - alone}${rest}` : "nothing wrong was found";
    const all = (j ? j.faults : []).map((f, k) => [f, k]);
    const rows = [...new Set(all.map(([f]) => f.kind))].map((kind) => {
      const of = all.filter(([f]) => f.kind === kind), b = make("b");
      b.style.background = faultColor(kind);
      const told = of[0][0].repairable ? "" : ", only told";
      const box = make("details", { className: "kind", open: of.length < 9 }, make("summary", { title: of[0][0].title }, b, `${faultName(kind)} (${of.length}${told})`));
      for (const [f, k] of of.slice(0, 60)) {
        const button = make("button", { className: "fault", type: "button", title: faultText(f), onclick: () => goFault(k), textContent: `${f.joint || "whole body"}, ${f.start}${f.stop > f.start ? `–${f.stop}` : ""}` });
        button.setAttribute("aria-label", `${f.joint || "whole body"} ${faultName(f.kind)}, frames ${f.start} to ${f.stop}`);
        box.append(button);
      }
      return box;
    });
    if (j && !j.judged) rows.push(make("p", { className: "soft", textContent: "No human body is told by the joints' names, so feet and floor were not judged." }));
    $("faults").replaceChildren(...rows);
    for (const row of rows) row.setAttribute("role", "listitem");
  }
  const unitName = (u) => { const found = UNITS.find(([k]) => Math.abs(UNIT_M[k] / u - 1) < 1e-6); return found ? found[1] : `unit ${Number(u.toPrecision(4))} m`; };
  function guesses(m, j, t) {
    const of = (what) => (j ? j.guesses.find((g) => g.what === what) : null);
    const said = stated(t);
    const set = (name, value) => send({ type: "reading", take: t.id, values: { ...said, [name]: value } });
    const one = (what, label, control) => {
      const g = of(what);
      return make("div", { className: "guess" }, make("label", {}, label, control), make("p", { textContent: g ? `${g.evidence}.` : "" }));
    };
    const auto = (name, options, now) => {
      const input = make("select", {}, new Option(`guessed${now ? `: ${now}` : ""}`, ""), ...options.map(([value, text]) => new Option(text, value)));
      input.value = said[name] === undefined ? "" : said[name];
      input.onchange = () => set(name, input.value);
      return input;
    };
    const rate = make("input", { type: "number", min: 1, max: 1000, step: "any", placeholder: m ? String(Number(m.fps.toPrecision(6))) : "", value: said.fps || "" });
    rate.onchange = () => set("fps", rate.value === "" ? null : Number(rate.value));
    const sides = make("input", { type: "checkbox", checked: Boolean(said.swap_sides) });
    sides.onchange = () => set("swap_sides", sides.checked);
    const raw = make("input", { type: "checkbox", checked: Boolean(said.raw) });
    raw.onchange = () => set("raw", raw.checked);
    const floor = make("select", {}, new Option("as in the file", ""), new Option("where the soles are", "auto"));
    floor.value = said.ground || "";
    floor.onchange = () => set("ground", floor.value);
    const rows = [
      one("up", "Up", auto("up", hello.reading.up.map((u) => [u, u]), said.up || !m ? "" : m.up_axis)),
      one("unit", "Unit", auto("unit", UNITS, said.unit || !m ? "" : unitName(m.unit_m))),
      one("fps", "Rate, Hz", rate), one("ground", "Floor", floor), one("sides", "Swap sides", sides),
      make("div", { className: "guess" }, make("label", { title: "No tremble is taken off" }, "As it is", raw)),
    ];
    const pickled = make("input", { type: "checkbox", checked: Boolean(said.allow_pickle) });
    pickled.onchange = () => set("allow_pickle", pickled.checked);
    if (!m || said.allow_pickle) rows.push(make("div", { className: "guess" }, make("label", { title: "Plain arrays are taken out of it; no code of its runs" }, "Pickled", pickled)));
    if (!m || m.format.includes("csv") || j && j.notes.some((n) => /animation|people|person/.test(n)) || said.take) {
      const which = make("input", { type: "text", value: said.take || "", placeholder: "name or number" });
      which.onchange = () => set("take", which.value);
      rows.push(make("div", { className: "guess" }, make("label", {}, "Take", which)));
    }
    if (j && j.notes.length) rows.push(make("p", { className: "soft", textContent: j.notes.map((n) => `${n}.`).join(" ") }));
    $("guesses").replaceChildren(...rows);
  }

  // --- time -----------------------------------------------------------------------------------

  function seek(to) {
    const m = motion();
    if (!m) return;
    if (growing && to !== growing.at) growing.led = false;
    frame = Math.min(Math.max(to, 0), m.frames - 1);
    const moment = `frame ${Math.round(frame)} of ${m.frames - 1}, ${(frame / m.fps).toFixed(2)} s`;
    if ($("time").textContent !== moment) $("time").textContent = moment;
    line.frame(frame, moment, Boolean(playing));
    dirty = true;
    if (!playing && opened && opened.action.name === "push") pushMoment();
  }
  function play(speed) {
    playing = speed;
    const m = motion();
    if (speed > 0 && m && frame >= m.frames - 1) frame = 0;
    $("play").textContent = speed ? "❚❚" : "▶";
    $("play").setAttribute("aria-pressed", speed !== 0);
    $("play").setAttribute("aria-label", speed ? "Pause" : "Play");
    if (!speed) seek(Math.round(frame));
  }
  function setRange(next) {
    const m = motion();
    range = next && m ? [Math.max(next[0], 0), Math.min(next[1], m.frames - 1)] : null;
    $("range-line").textContent = range ? `range ${range[0]}–${range[1]} ✕` : "";
    $("range-line").hidden = !range;
    if (opened) opened.refresh();
    timeline();
    if (opened) askLine(opened);
  }
  const made = () => (growing && growing.figure.ready && motion() ? growing.figure : null);
  function goFault(k) {
    const j = judged(), m = motion();
    if (!j || !j.faults[k]) return;
    fault = k;
    const f = j.faults[k];
    if (m.names.includes(f.joint)) { joint = f.joint; $("joint").value = joint; }
    if (["foot slide"].includes(f.kind)) $("axis").value = "speed";
    else if (["float", "penetration", "support missing"].includes(f.kind)) $("axis").value = "z";
    play(0);
    setRange([f.start, Math.max(f.stop, f.start + 1)]);
    seek(f.start);
    toast(faultText(f));
  }
  // Pictures are drawn where something changed, so that jobs have the machine.
  const touch = () => { dirty = true; };
  // Which motions stand there; the one that is being made, if any.
  function stage() {
    const off = $("mode").value === "off", live = off ? null : made();
    view.show(motion(), live || off ? null : motion(compare), live);
    return live;
  }
  function draw(now) {
    requestAnimationFrame(draw);
    const m = motion(), spent = Math.min((now - last) / 1000, 0.25);
    last = now;
    if (m && playing) {
      const first = range && range[1] - range[0] > 1 ? range[0] : 0, end = range && range[1] - range[0] > 1 ? range[1] : m.frames - 1;
      frame += spent * m.fps * playing * Number($("speed").value);
      if (frame > end) frame = first;
      if (frame < first && playing < 0) frame = end;
      seek(frame);
    }
    view.controls.update();
    if (!dirty && !playing) return;
    dirty = false;
    const other = motion(compare), mode = $("mode").value;
    const live = stage();
    const b = m && other ? Math.min((frame / m.fps) * other.fps, other.frames - 1) : 0;
    const c = m && live ? (frame / m.fps) * live.fps : 0;
    view.draw({ a: frame, b, c, shift: mode === "side" ? 1.3 : 0, follow: $("follow").checked, marks });
    drawn.push(now);
    while (drawn[0] < now - 1000) drawn.shift();
    document.body.dataset.drawn = drawn.length;
  }

  // Marks over the picture: trails of the feet, the chosen joint, pins, an arrow.
  function marks(ink, screen, places) {
    const m = motion(), css = pageColor;
    if (!m) return;
    const dot = (x, y, r, color, ring) => {
      ink.beginPath();
      ink.arc(x, y, r, 0, 7);
      ink.fillStyle = color;
      if (ring) { ink.strokeStyle = color; ink.lineWidth = 2; ink.stroke(); } else ink.fill();
    };
    if ($("trails").checked) {
      const j = judged();
      for (const side of ["left", "right"]) {
        const foot = m.roles[`${side}_toes`] ?? m.roles[`${side}_foot`];
        const whose = m.roles[`${side}_foot`];
        if (foot === undefined) continue;
        const runs = j ? (j.contacts.find((c) => c.joint === whose) || { runs: [] }).runs : [];
        const half = Math.round(1.2 * m.fps), each = Math.max(1, Math.round(m.fps / 60));
        // Pieces of one kind are drawn at once: fainter ones are farther in time.
        const pieces = new Map();
        let from = null;
        for (let t = Math.max(0, Math.round(frame) - half); t <= Math.min(m.frames - 1, Math.round(frame) + half); t += each) {
          const [x, y, z] = m.place(t, foot), at = screen(x, y, z);
          const stands = runs.some(([a, b]) => t >= a && t <= b), kind = 2 * Math.floor((5 * Math.abs(t - frame)) / (half + 1)) + stands;
          if (from && at) {
            if (!pieces.has(kind)) pieces.set(kind, new Path2D());
            pieces.get(kind).moveTo(from[0], from[1]);
            pieces.get(kind).lineTo(at[0], at[1]);
          }
          from = at;
        }
        for (const [kind, path] of pieces) {
          ink.strokeStyle = css(kind % 2 ? "--contact" : side === "left" ? "--left" : "--right");
          ink.globalAlpha = 0.85 - 0.13 * (kind >> 1);
          ink.lineWidth = kind % 2 ? 4 : 1.6;
          ink.stroke(path);
        }
      }
      ink.globalAlpha = 1;
    }
    const chosen = m.names.indexOf(joint);
    if (chosen >= 0 && seen) {
      const at = screen(places[3 * chosen], places[3 * chosen + 1], places[3 * chosen + 2]);
      if (at) dot(at[0], at[1], 6, css("--focus"), true);
    }
    if (opened && opened.values.touches)
      for (const [, at, x, y, z] of opened.values.touches) {
        const p = screen(x, y, z);
        if (p) { dot(p[0], p[1], Math.abs(at - frame) < 2 ? 7 : 4, css("--push")); ink.fillText(String(at), p[0] + 9, p[1]); }
      }
    if (opened && opened.action.name === "push") {
      const part = pushJoint();
      if (part === undefined) return;
      const from = [places[3 * part], places[3 * part + 1], places[3 * part + 2]];
      const toward = drag && drag.to ? [drag.to[0] - from[0], drag.to[1] - from[1], drag.to[2] - from[2]] : pushArrow(places);
      const a = screen(...from), b = screen(from[0] + toward[0], from[1] + toward[1], from[2] + toward[2]);
      if (a && b) {
        const [dx, dy] = [b[0] - a[0], b[1] - a[1]], n = Math.hypot(dx, dy) || 1;
        ink.strokeStyle = ink.fillStyle = css("--push");
        ink.lineWidth = 4;
        ink.beginPath();
        ink.moveTo(a[0], a[1]);
        ink.lineTo(b[0], b[1]);
        ink.stroke();
        ink.beginPath();
        ink.moveTo(b[0] + (9 * dx) / n, b[1] + (9 * dy) / n);
        ink.lineTo(b[0] - (6 * dy) / n, b[1] + (6 * dx) / n);
        ink.lineTo(b[0] + (6 * dy) / n, b[1] - (6 * dx) / n);
        ink.fill();
      }
    }
  }

  // --- what is done ---------------------------------------------------------------------------

  const choose = (id) => { if (id && id !== current()) send({ type: "choose", take: id }); };
  function undo() {
    const t = take();
    if (!t || !t.parent || !take(t.parent)) return toast("This is the motion as it came in.");
    redo.push(t.id);
    choose(t.parent);
  }
  function again() {
    const id = redo.findLast((r) => take(r) && take(r).parent === current());
    if (!id) return toast("There is nothing to do again.");
    redo = redo.filter((r) => r !== id);
    choose(id);
  }
  function valuesOf(form) {
    const values = structuredClone(form.values), m = motion();
    if (form.action.name === "range") values.span = range && m ? range.map((f) => Number((f / m.fps).toFixed(4))) : null;
    if (form.action.name === "cut") values.frames = range || [];
    return values;
  }
  function run(form) {
    const values = valuesOf(form), name = form.action.name, m = motion();
    const why = !m ? "Open a motion first." : name === "range" && !values.span || name === "cut" && !values.frames.length ? "Mark a range first: I and O, or Shift and drag on the timeline."
      : name === "between" && values.keyframes.length < 2 ? "Mark at least two frames that stay: S on each." : name === "rig" && !values.onto ? "Choose or open a rig first."
      : name === "range" && !take().simulated ? "Only a motion that a body did has a range to do anew. Give it a body first." : "";
    form.why.textContent = why;
    if (why) return;
    problem("");
    const moment = name === "push" ? Math.round(values.start * m.fps) : range && name === "range" ? range[0] : null;
    send({ type: "run", take: current(), action: name, values, moment });
    $("right").scrollTop = 0;
  }
  let lineAt = 0;
  function askLine(form) {
    clearTimeout(lineAt);
    lineAt = setTimeout(() => {
      const values = valuesOf(form);
      const text = JSON.stringify([current(), form.action.name, values]);
      if (text === asked || !motion() || (form.action.name === "rig" && !values.onto) || (form.action.name === "range" && !take().simulated)) return;
      asked = text;
      send({ type: "line", take: current(), action: form.action.name, values });
    }, 150);
  }
  function opens(form) {
    opened = form;
    showBoxes();
    if (form && form.action.name === "push" && !playing) pushMoment();
    timeline();
    if (form) { form.why.textContent = ""; asked = ""; askLine(form); }
  }
  // Boxes that are to stand there, or those on which the body was.
  function showBoxes() {
    const t = take(), mine = opened && opened.action.name === "chair" && opened.values.boxes.length ? opened.values.boxes : (t && t.boxes) || [];
    view.setBoxes(mine);
    dirty = true;
  }
  function pushMoment() {
    const m = motion(), at = Number((frame / m.fps).toFixed(3));
    if (opened.values.start !== at) opened.set("start", at);
  }
  const ROLE = { hand: "hand", elbow: "forearm", shoulder: "upper_arm", hip: "thigh", knee: "shin", foot: "foot" };
  function pushJoint(part = opened.values.at) {
    const r = motion().roles;
    if (part === "pelvis") return r.hips;
    if (part === "head") return r.head;
    if (part === "chest") return r[Object.keys(r).filter((k) => /^spine\d*$/.test(k)).sort().pop()] ?? r.hips;
    const [side, name] = part.split("_");
    return r[`${side}_${ROLE[name]}`];
  }
  // Towards which it is pushed, m: a metre for 300 N.
  function pushArrow(places) {
    const v = opened.values.direction, long = opened.values.force / 300;
    if (v) { const n = Math.hypot(...v) || 1; return v.map((x) => (x / n) * long); }
    const r = motion().roles, [l, o] = [r.left_thigh, r.right_thigh];
    if (l === undefined || o === undefined) return [0, long, 0];
    // From the front: against where the hips look.
    const [x, y] = [places[3 * l] - places[3 * o], places[3 * l + 1] - places[3 * o + 1]], n = Math.hypot(x, y) || 1;
    return [(-y / n) * long, (x / n) * long, 0];
  }
  // The direction of the arrow, in numbers.
  function arrowNow() {
    if (!motion() || !view.places) return [0, 1, 0];
    const v = pushArrow(view.places), n = Math.hypot(...v) || 1;
    return v.map((x) => Number((x / n).toFixed(3)));
  }
  function limbAt(name) {
    const m = motion(), role = name === "pelvis" ? "hips" : name;
    const at = m && m.roles[role] !== undefined ? m.place(Math.round(frame), m.roles[role]) : [0, 0, 1];
    return at.map((v) => Number(v.toFixed(3)));
  }
  function seatHere() {
    const [x, y, z] = limbAt("pelvis"), high = Math.max(Number((z - 0.1).toFixed(2)), 0.1);
    return { kind: "seat", size: [0.45, 0.45, high], pos: [x, y, high / 2], yaw: 0 };
  }
  function addKey() {
    const form = forms.get("between");
    if (!form.box.open) form.box.open = true;
    const at = Math.round(frame), keys = form.values.keyframes;
    form.set("keyframes", keys.includes(at) ? keys.filter((k) => k !== at) : [...keys, at].sort((a, b) => a - b));
    timeline();
  }

  // --- files ----------------------------------------------------------------------------------

  let purpose = "";
  function pickFiles(why = "") {
    purpose = why;
    $("files").value = "";
    $("files").click();
  }
  async function takeFiles(files, why = "") {
    if (!hello) return toast("The page is not connected yet. Drop it again.", "refused");
    const first = current(), came = [];
    // Companions, such as an ASF, must be there when the motion is read.
    const sorted = [...files].sort((a, b) => /\.(amc|gltf)$/i.test(a.name) - /\.(amc|gltf)$/i.test(b.name));
    for (const file of sorted) {
      if (file.size > hello.largest) { toast(`${file.name} is larger than ${hello.largest >> 30} GB. Cut the motion, or leave meshes and textures out.`, "refused"); continue; }
      toast(`Taking ${file.name}`);
      try {
        const answer = await upload(file);
        if (answer.type === "took") came.push(answer.take);
        else if (answer.type === "refused") toast(answer.why, "refused");
      } catch (error) { toast(`${file.name} did not arrive whole. Drop it again.`, "refused"); }
    }
    if (why === "rig" && came.length) {
      if (first) choose(first);
      setTimeout(() => forms.get("rig").set("onto", came[0]), 300);
      toast("The rig is there. Press Onto my rig.");
    } else if (came.length && $("toast").dataset.kind !== "refused") toast("");
  }
  function upload(file) {
    return new Promise((done, fail) => {
      const one = new WebSocket(door(`/upload?name=${encodeURIComponent(file.name)}&size=${file.size}`));
      let last = null;
      one.onmessage = async ({ data }) => {
        const message = JSON.parse(data);
        if (message.type !== "go on") { last = message; return; }
        for (let at = 0; at < file.size; at += 524288) {
          while (one.bufferedAmount > 8e6) await new Promise((r) => setTimeout(r, 20));
          one.send(await file.slice(at, at + 524288).arrayBuffer());
        }
      };
      one.onclose = () => (last ? done(last) : fail(new Error("closed")));
    });
  }
  addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("dropping"); });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    const onRig = forms && forms.get("rig").box.open && event.target.closest && event.target.closest("#action-rig");
    if (event.dataTransfer.files.length) takeFiles(event.dataTransfer.files, onRig ? "rig" : "");
  });

  // --- hands ----------------------------------------------------------------------------------

  $("choose").onclick = $("choose-too").onclick = () => pickFiles();
  $("files").onchange = () => takeFiles($("files").files, purpose);
  $("undo").onclick = undo;
  $("redo").onclick = again;
  $("export").onclick = () => send({ type: "export", take: current(), format: $("format").value });
  $("first").onclick = () => { play(0); seek(0); };
  const step = (by) => { play(0); seek(Math.round(frame) + by); };
  $("back").onclick = () => step(-1);
  $("next").onclick = () => step(1);
  $("range-line").onclick = () => setRange(null);
  $("play").onclick = () => play(playing ? 0 : 1);
  $("joint").onchange = () => { joint = $("joint").value; seen = true; timeline(); };
  $("axis").onchange = $("mode").onchange = timeline;
  $("beside").onchange = () => {
    compare = $("beside").value;
    if (compare && $("mode").value === "off") $("mode").value = "over";
    for (const one of project.takes) for (const kind of ["figure", "judged"]) if (wanted(one, kind)) load(one, kind);
    arrived("compare");
    beside();
  };
  for (const name of ["trails", "follow", "mode"]) $(name).addEventListener("change", touch);
  addEventListener("keydown", touch);
  const place = (event) => { const box = $("stage").getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  $("stage").addEventListener("pointerdown", (event) => {
    if (!motion() || event.button) return;
    const [x, y] = place(event), name = opened ? opened.action.name : "";
    drag = { x, y, far: 0 };
    if (name === "push" && !playing) {
      const parts = opened.action.fields.find((f) => f.name === "at").choices.map(([value]) => value);
      const joints = new Map(parts.map((p) => [pushJoint(p), p]));
      const found = view.pick(x, y, (j) => joints.has(j));
      if (found) drag = { ...drag, part: joints.get(found.joint), depth: found.depth, joint: found.joint };
    } else if (name === "chair") {
      const found = view.pickBox(x, y, opened.values.boxes);
      if (found) {
        const box = opened.values.boxes[found.box], on = view.onPlane(x, y, box.pos[2]);
        if (on) drag = { ...drag, box: found.box, from: on, pos: [...box.pos], lift: event.shiftKey, size: [...box.size] };
      }
    }
    if (drag.part || drag.box !== undefined) {
      view.controls.enabled = false;
      event.stopPropagation();
      try { $("stage").setPointerCapture(event.pointerId); } catch { /* A pointer that a test made. */ }
      if (drag.part) opened.set("at", drag.part);
    }
  }, true);
  $("stage").addEventListener("pointermove", (event) => {
    if (!drag) return;
    dirty = true;
    const [x, y] = place(event);
    drag.far = Math.max(drag.far, Math.hypot(x - drag.x, y - drag.y));
    if (drag.part && drag.far > 4) {
      drag.to = view.under(x, y, drag.depth);
      const from = [0, 1, 2].map((k) => view.places[3 * drag.joint + k]);
      const v = drag.to.map((value, k) => value - from[k]), long = Math.hypot(...v);
      if (long > 0.03) {
        opened.values.direction = v.map((value) => Number((value / long).toFixed(3)));
        opened.set("force", Math.max(10, Math.round(long * 30) * 10));
      }
    } else if (drag.box !== undefined) {
      const boxes = structuredClone(opened.values.boxes), box = boxes[drag.box];
      if (drag.lift) {
        box.size[2] = Math.max(0.05, drag.size[2] + (drag.y - y) / 250);
        box.pos[2] = box.size[2] / 2;
      } else {
        const on = view.onPlane(x, y, drag.from[2]);
        if (on) { box.pos[0] = drag.pos[0] + on[0] - drag.from[0]; box.pos[1] = drag.pos[1] + on[1] - drag.from[1]; }
      }
      opened.set("boxes", boxes);
    }
  });
  const release = (event) => {
    if (!drag) return;
    view.controls.enabled = true;
    if (drag.far < 4 && !drag.part && drag.box === undefined && event.type === "pointerup") {
      const found = view.pick(drag.x, drag.y);
      if (found) { joint = motion().names[found.joint]; $("joint").value = joint; seen = true; timeline(); }
    }
    drag = null;
  };
  for (const name of ["pointerup", "pointercancel"]) addEventListener(name, release);

  const KEYS = [
    ["Space", "play and pause"], ["J K L", "play back, pause, play on"], ["← →", "a frame back and on; with Shift ten"], ["Home End", "first and last frame"],
    ["N P", "the next and the last fault"], ["I O", "the range begins and ends here; X takes it off"], ["S", "keep this frame, for Between keys"],
    ["C", "overlaid, side by side, hidden"], ["T", "foot trails"], ["F", "look at the figure"], [", . + -", "turn the view, nearer and farther"], ["Ctrl+Z", "undo; Ctrl+Shift+Z does it again"],
    ["Ctrl+O", "open files"], ["Ctrl+E", "export"], ["?", "these keys"],
  ];
  $("help-keys").append(...KEYS.flatMap(([key, text]) => [make("dt", { textContent: key }), make("dd", { textContent: text })]));
  $("keys").onclick = () => $("help").showModal();
  addEventListener("keydown", (event) => {
    if (!hello || !project || $("help").open) return;
    const typing = /^(INPUT|TEXTAREA)$/.test(event.target.tagName) && !/^(checkbox|file)$/.test(event.target.type);
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey) {
      if (typing && key === "z") return;
      if (key === "z" && !event.shiftKey) undo();
      else if (key === "y" || key === "z") again();
      else if (key === "o") pickFiles();
      else if (key === "e") $("export").click();
      else return;
      event.preventDefault();
      return;
    }
    if (event.altKey || typing) return;
    const chooses = event.target.tagName === "SELECT";
    const presses = /^(BUTTON|SUMMARY|A)$/.test(event.target.tagName) || event.target.type === "checkbox";
    const m = motion();
    if (!m) { if (key === "?") $("help").showModal(); return; }
    const end = m.frames - 1, at = Math.round(frame), j = judged();
    if (chooses && (key.startsWith("Arrow") || key.length === 1)) return;
    if (presses && (key === " " || key === "Enter")) return;
    if (key === " ") play(playing ? 0 : 1);
    else if (key === "ArrowLeft") step(event.shiftKey ? -10 : -1);
    else if (key === "ArrowRight") step(event.shiftKey ? 10 : 1);
    else if (key === "PageUp") step(10);
    else if (key === "PageDown") step(-10);
    else if (key === "," || key === ".") view.turn(key === "," ? -0.2 : 0.2);
    else if (key === "+" || key === "-") view.turn(0, key === "+" ? 0.85 : 1 / 0.85);
    else if (key === "Home") step(-end);
    else if (key === "End") step(end);
    else if (key === "j") play(-1);
    else if (key === "k") play(0);
    else if (key === "l") play(1);
    else if ((key === "n" || key === "p") && j && j.faults.length) {
      const order = j.faults.map((f, k) => [f.start, k]).sort((a, b) => a[0] - b[0]), now = order.findIndex(([, k]) => k === fault);
      goFault(order[(now + (key === "n" ? 1 : -1) + order.length) % order.length][1]);
    } else if (key === "i") setRange([at, range && range[1] > at ? range[1] : end]);
    else if (key === "o") setRange([range && range[0] < at ? range[0] : 0, at]);
    else if (key === "x") setRange(null);
    else if (key === "s") addKey();
    else if (key === "c") { const o = ["over", "side", "off"]; $("mode").value = o[(o.indexOf($("mode").value) + 1) % 3]; timeline(); }
    else if (key === "t") $("trails").checked = !$("trails").checked;
    else if (key === "f") view.frame();
    else if (key === "?") $("help").showModal();
    else return;
    event.preventDefault();
  });

  window.poiseOpen = {
    get state() { return { frame, playing, current: current(), compare, joint, range, fault, project, made: made() && [made().first, made().last], motion: motion(), judged: judged(), calls: view ? view.calls : 0 }; },
    seek, screen: (j) => view.screen(view.places[3 * j], view.places[3 * j + 1], view.places[3 * j + 2]), forms: () => forms,
  };
  connect();
})();
