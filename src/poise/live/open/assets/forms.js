"use strict";
// The buttons' settings as forms; each keeps its values, and tells when one was changed.
function actionForms(host, actions, world) {
  const forms = new Map();
  const make = (tag, more = {}, ...inside) => {
    const made = Object.assign(document.createElement(tag), more);
    made.append(...inside);
    return made;
  };
  const names = (text) => text.replaceAll("_", " ");
  const UNIT_WORDS = { N: "newtons", s: "seconds", m: "metres", Hz: "hertz" };
  const LIMBS = ["left_hand", "right_hand", "left_foot", "right_foot"];

  function build(action) {
    const values = Object.fromEntries(action.fields.map((f) => [f.name, structuredClone(f.default)]));
    const line = make("p", { className: "line" });
    const form = { action, values, line, redraw: [], changed: () => {} };
    const plain = make("div", { className: "body" });
    const fold = make("details", { className: "advanced" }, make("summary", { textContent: "Advanced" }));
    const inside = make("div", { className: "rows" });
    for (const field of action.fields) (field.advanced ? inside : plain).append(row(form, field));
    inside.append(make("span", { className: "away", textContent: "The command that does the same:" }), line);
    fold.append(inside);
    form.run = make("button", { className: "main", textContent: action.label, onclick: () => world.run(form) });
    if (action.name === "chair") plain.prepend(make("button", { textContent: "Find what it rests on", onclick: () => world.rests() }));
    plain.prepend(make("p", { textContent: action.text }));
    form.why = make("p", { className: "why" });
    plain.append(form.run, form.why, fold);
    form.box = make("details", { className: "action", id: `action-${action.name}` }, make("summary", { textContent: action.label }), plain);
    form.box.addEventListener("toggle", () => {
      // The one that closes since another opened says nothing.
      if (!form.box.open) return world.now() === form ? world.opened(null) : undefined;
      for (const other of forms.values()) if (other !== form) other.box.open = false;
      world.opened(form);
      form.refresh();
    });
    form.set = (name, value) => { values[name] = value; form.refresh(); form.changed(); };
    form.refresh = () => form.redraw.forEach((draw) => draw());
    forms.set(action.name, form);
    host.append(form.box);
  }

  function row(form, field) {
    const id = `${form.action.name}-${field.name}`;
    const label = make("label", { className: "field", title: field.text }, make("span", { textContent: field.label }));
    const set = (value) => { form.values[field.name] = value; form.changed(); };
    const show = (draw) => { form.redraw.push(draw); draw(); };
    if (field.kind === "number") {
      const input = make("input", { type: "number", id, step: field.step });
      if (field.low !== null) input.min = field.low;
      if (field.high !== null) input.max = field.high;
      input.oninput = () => { if (input.value !== "") set(Number(input.value)); };
      if (field.unit) input.setAttribute("aria-label", `${field.label}, ${UNIT_WORDS[field.unit] || field.unit}`);
      show(() => { if (document.activeElement !== input) input.value = Number((form.values[field.name] ?? 0).toFixed(3)); });
      label.append(make("span", { className: "with" }, input, field.unit));
    } else if (field.kind === "choice") {
      const input = make("select", { id }, ...field.choices.map(([value, text]) => new Option(text, value)));
      input.onchange = () => set(input.value);
      show(() => { input.value = form.values[field.name]; });
      // Words that would be cut off beside their label stand below it.
      if (field.choices.some(([, text]) => text.length > 17)) label.classList.add("long");
      label.append(input);
    } else if (field.kind === "flag") {
      const input = make("input", { type: "checkbox", id });
      input.onchange = () => set(input.checked);
      show(() => { input.checked = form.values[field.name]; });
      label.append(make("span", { className: "with" }, input));
    } else if (field.kind === "take") {
      const input = make("select", { id });
      input.onchange = () => set(input.value);
      show(() => {
        input.replaceChildren(new Option("choose a rig", ""), ...world.rigs().map(([value, text]) => new Option(text, value)));
        input.value = form.values[field.name];
      });
      const drop = make("button", { type: "button", textContent: "Open rig", onclick: (event) => { event.preventDefault(); world.openRig(); } });
      input.setAttribute("aria-label", field.label);
      label.append(make("span", { className: "with" }, input, drop));
    } else if (field.kind === "maps") {
      const input = make("input", { type: "text", id, placeholder: "Arm_L=upperarm_l" });
      input.oninput = () => set(input.value.split(/[,;]\s*/).map((x) => x.trim()).filter(Boolean));
      label.append(input);
    } else return rows(form, field, set, show);
    return label;
  }

  // Settings of which there may be several, and those that the timeline and the stage tell.
  function rows(form, field, set, show) {
    const list = make("div", { className: "rows" });
    const group = make("div", { role: "group" }, list);
    group.setAttribute("aria-label", field.label);
    group.title = field.text;
    const number = (value, label, act, step = 0.01) => {
      const input = make("input", { type: "number", value: Number(Number(value).toFixed(3)), step });
      input.setAttribute("aria-label", label);
      input.oninput = () => { if (input.value !== "") act(Number(input.value)); };
      return input;
    };
    const limbs = (value, act, more = []) => {
      const input = make("select", {}, ...[...LIMBS, ...more].map((l) => new Option(names(l), l)));
      input.setAttribute("aria-label", "limb");
      input.value = value;
      input.onchange = () => act(input.value);
      return input;
    };
    // A row is a group of its own, so that its controls are told apart.
    const one = (k, name, ...inside) => {
      const made = make("div", { className: name }, ...inside);
      made.setAttribute("role", "group");
      made.setAttribute("aria-label", `${field.label} ${k + 1}`);
      return made;
    };
    const gone = (k) => {
      const button = make("button", { type: "button", className: "plain", textContent: "✕", onclick: () => set(form.values[field.name].filter((_, i) => i !== k)) });
      button.setAttribute("aria-label", `Leave out ${field.label} ${k + 1}`);
      button.addEventListener("click", () => form.refresh());
      return button;
    };
    const add = (text, title, make_one) => make("button", {
      type: "button", textContent: text, title,
      onclick: () => { const one = make_one(); if (one) { set([...form.values[field.name], one]); form.refresh(); } },
    });
    const put = (k, i) => (value) => {
      const all = structuredClone(form.values[field.name]);
      all[k][i] = value;
      set(all);
    };
    const draws = {
      frames: () => {
        const given = form.values[field.name];
        const what = form.action.name === "cut" ? world.rangeText() : given.length ? given.join(", ") : "none yet: S marks the frame that is shown";
        return [make("span", { textContent: `${field.label}: ${what}` })];
      },
      spans: () => form.values[field.name].map(([limb, first, last], k) => one(k, "row",
        limbs(limb, put(k, 0)), number(first, "first frame", put(k, 1), 1), number(last, "last frame", put(k, 2), 1), gone(k))),
      touches: () => form.values[field.name].map(([limb, frame, x, y, z], k) => one(k, "row",
        limbs(limb, put(k, 0), ["pelvis"]), number(frame, "frame", put(k, 1), 1), number(x, "x in m", put(k, 2)), number(y, "y in m", put(k, 3)),
        number(z, "height in m", put(k, 4)), gone(k))),
      vector: () => {
        if (form.action.name === "range") return [make("span", { textContent: `Range: ${world.rangeText()}` })];
        const v = form.values[field.name];
        if (!v) return [make("span", { textContent: `${field.label}: from the front; drag on the figure to turn it, or ` }),
          make("button", { type: "button", textContent: "state it", onclick: () => { set(world.arrow()); form.refresh(); } })];
        return [make("div", { className: "row" }, `${field.label} `, ...v.map((value, i) => number(value, `${field.label} ${"xyz"[i]}`, (n) => { const all = [...v]; all[i] = n; set(all); })),
          make("button", { type: "button", className: "plain", textContent: "✕", ariaLabel: "From the front", onclick: () => { set(null); form.refresh(); } }))];
      },
      boxes: () => form.values[field.name].map((box, k) => {
        const change = (name, i) => (value) => {
          const all = structuredClone(form.values[field.name]);
          if (name === "high") {
            all[k].size[2] = Math.max(value, 0.02);
            all[k].pos[2] = all[k].size[2] / 2;
          } else if (name === "yaw") all[k].yaw = (value * Math.PI) / 180;
          else all[k][name][i] = value;
          set(all);
        };
        return one(k, "row box", make("span", { textContent: box.kind }), gone(k),
          make("label", {}, "x ", number(box.pos[0], "x in m", change("pos", 0))), make("label", {}, "y ", number(box.pos[1], "y in m", change("pos", 1))),
          make("label", {}, "high ", number(box.pos[2] + box.size[2] / 2, "height of the seat in m", change("high"))),
          make("label", {}, "wide ", number(box.size[0], "width in m", change("size", 0))), make("label", {}, "deep ", number(box.size[1], "depth in m", change("size", 1))),
          make("label", {}, "turn ", number(((box.yaw || 0) * 180) / Math.PI, "turn in degrees", change("yaw"), 5)));
      }),
    };
    const adds = {
      frames: form.action.name === "cut" ? [] : [add("Keep this frame", "S", () => (form.values[field.name].includes(world.frame()) ? null : world.frame())),
        make("button", { type: "button", textContent: "None", onclick: () => { set([]); form.refresh(); } })],
      spans: [add(`${field.label}: add`, field.text, () => ["left_hand", ...(world.range() || [world.frame(), Math.min(world.frame() + 15, world.frames() - 1)])])],
      touches: [add(`${field.label}: add`, field.text, () => ["right_hand", world.frame(), ...world.limb("right_hand")]),
        add("Touch the floor", "The right hand, at the frame that is shown", () => { const [x, y] = world.limb("right_hand"); return ["right_hand", world.frame(), x, y, 0.02]; })],
      boxes: [add("Add a seat", "A box of 45 cm below the hips", () => world.seat())],
    };
    group.append(make("div", { className: "row" }, ...(adds[field.kind] || [])));
    show(() => { if (!list.contains(document.activeElement) || field.kind === "frames") list.replaceChildren(...draws[field.kind]()); });
    return group;
  }

  actions.forEach(build);
  return forms;
}
