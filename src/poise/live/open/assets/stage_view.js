"use strict";
// The motion on the shared stage: one figure, another beside or over it, boxes, and marks drawn over all.
function stageView(host, over) {
  const base = threeStage(host, {
    fov: 30, polar: 1.56, far: 60, reach: 5, depth: 26, fade: [2, 14], fog: [18, 60], sunAt: [2.4, -3, 8], detail: 10,
  });
  const { T, css, scene, camera, controls, place, solid } = base;
  for (const canvas of [base.canvas, over]) canvas.setAttribute("aria-hidden", "true");
  controls.dampingFactor = 0.14;
  camera.position.set(3.6, -3.6, 2.2);
  controls.target.set(0, 0, 0.9);
  const point = new T.Vector3(), ink = over.getContext("2d");
  const materials = () => ["", "left", "right"].map(() => new T.MeshStandardMaterial({ roughness: 0.6 }));
  const ghostly = () => ["", "left", "right"].map(() => new T.MeshBasicMaterial({ transparent: true, opacity: 0.34, depthWrite: false }));
  const wood = new T.MeshStandardMaterial({ roughness: 0.9 });
  const shown = { a: null, b: null, c: null };
  let boxes = [], target = new T.Vector3(0, 0, 0.9), placed = false, moved = new T.Vector3();

  // A figure of bones as capsules, and a head.
  function figure(motion, ghost) {
    const mats = ghost ? ghostly() : materials();
    const first = motion.at(0, new Float32Array(3 * motion.J));
    const shapes = [];
    motion.parents.forEach((parent, joint) => {
      // The head's own bones lie inside of it.
      if (parent < 0 || parent === motion.head) return;
      const [i, p] = [3 * joint, 3 * parent];
      const length = Math.hypot(first[i] - first[p], first[i + 1] - first[p + 1], first[i + 2] - first[p + 2]);
      if (length < 1e-4) return;
      const radius = Math.min(motion.radii[joint], Math.max(0.45 * length, 0.006));
      const half = Math.max(length / 2 - 0.35 * radius, 0.001);
      shapes.push({ joint, parent, kind: "capsule", size: [radius, half, 0], pos: [0, 0, 0], quat: [1, 0, 0, 0], body: shapes.length });
    });
    if (motion.head !== null)
      shapes.push({ joint: motion.head, parent: crown(motion, first), head: true, kind: "sphere", size: [motion.head_m, 0, 0], pos: [0, 0, 0.6 * motion.head_m], quat: [1, 0, 0, 0], body: shapes.length });
    const dress = (shape) => {
      const side = motion.sides[shape.joint];
      const mesh = solid(shape, mats[side === "left" ? 1 : side === "right" ? 2 : 0]);
      mesh.castShadow = !ghost;
      return [mesh];
    };
    const made = base.figure(shapes, shapes, dress);
    return { ...made, mats, shapes, motion, at: new Float32Array(3 * motion.J), ghost };
  }
  // The joint to which a head points, negative for one from which it comes: its tip, or the neck.
  function crown(motion, at) {
    const far = (j) => Math.hypot(...[0, 1, 2].map((k) => at[3 * j + k] - at[3 * motion.head + k]));
    const tips = motion.parents.flatMap((p, j) => (p === motion.head && far(j) > 0.4 * motion.head_m ? [j] : []));
    return tips.length === 1 ? ~tips[0] : motion.parents[motion.head];
  }
  function drop(who) {
    if (!who) return;
    scene.remove(who.root);
    who.root.traverse((mesh) => mesh.geometry && mesh.geometry.dispose());
    who.mats.forEach((m) => m.dispose());
  }
  const rows = new Float32Array(7);
  function pose(who, frame, dx, dy) {
    const at = who.motion.at(frame, who.at);
    who.root.position.set(dx, dy, 0);
    who.shapes.forEach((shape, k) => {
      const ahead = shape.head && shape.parent < -1, i = 3 * shape.joint, p = 3 * (ahead ? ~shape.parent : shape.parent);
      const sign = ahead ? -1 : 1;
      let [x, y, z] = shape.parent === -1 ? [0, 0, 1] : [sign * (at[i] - at[p]), sign * (at[i + 1] - at[p + 1]), sign * (at[i + 2] - at[p + 2])];
      const n = Math.hypot(x, y, z) || 1;
      [x, y, z] = [x / n, y / n, z / n];
      // The shortest turn from Z onto the bone.
      let [w, qx, qy] = [1 + z, -y, x];
      if (w < 1e-5) [w, qx, qy] = [0, 1, 0];
      const q = Math.hypot(w, qx, qy);
      if (shape.head) rows.set([at[i], at[i + 1], at[i + 2]]);
      else rows.set([(at[i] + at[p]) / 2, (at[i + 1] + at[p + 1]) / 2, (at[i + 2] + at[p + 2]) / 2]);
      rows.set([w / q, qx / q, qy / q, 0], 3);
      place(who.parts[k], rows, 0);
    });
  }
  const view = {
    canvas: base.canvas, camera, controls,
    theme() {
      base.theme("--bg");
      wood.color.set(css("--thing"));
      for (const who of [shown.a, shown.b, shown.c])
        if (who) (who.ghost ? ["--ref", "--ref", "--rim"] : ["--sim", "--left", "--right"]).forEach((name, k) => who.mats[k].color.set(css(name)));
    },
    resize() {
      const [w, h] = [host.clientWidth, Math.max(host.clientHeight, 1)];
      base.resize(w, h);
      const ratio = Math.min(devicePixelRatio || 1, 2);
      over.width = w * ratio;
      over.height = h * ratio;
      ink.setTransform(ratio, 0, 0, ratio, 0, 0);
    },
    // Which motions are shown; the second one is a ghost, and so is the first beside what is being made.
    show(a, b, c = null) {
      for (const [name, motion, ghost] of [["a", a, Boolean(c)], ["b", b, true], ["c", c, false]]) {
        if (shown[name] ? shown[name].motion === motion && shown[name].ghost === ghost : !motion) continue;
        drop(shown[name]);
        shown[name] = motion ? figure(motion, ghost) : null;
      }
      view.theme();
    },
    // Has something called whenever another picture is to be drawn.
    changed(call) {
      controls.addEventListener("change", call);
      new ResizeObserver(call).observe(host);
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", call);
    },
    frame() { placed = false; },
    // Turns the view about what is looked at, rad, and comes nearer by a factor.
    turn(angle, nearer = 1) {
      moved.copy(camera.position).sub(controls.target);
      const [x, y] = [moved.x, moved.y], [c, s] = [Math.cos(angle), Math.sin(angle)];
      moved.set(c * x - s * y, s * x + c * y, moved.z).multiplyScalar(nearer).clampLength(0.5, 40);
      camera.position.copy(controls.target).add(moved);
    },
    setBoxes(given) {
      for (const mesh of boxes) { scene.remove(mesh); mesh.geometry.dispose(); }
      boxes = given.map((box) => {
        const mesh = new T.Mesh(new T.BoxGeometry(...box.size), wood);
        mesh.castShadow = mesh.receiveShadow = true;
        mesh.position.set(...box.pos);
        mesh.rotation.z = box.yaw || 0;
        scene.add(mesh);
        return mesh;
      });
    },
    // frames: of each motion. shift: m across the view between them. marks: draws over the picture.
    draw({ a, b, c, shift, follow, marks }) {
      if (!shown.a) return base.render();
      const root = shown.a.motion;
      pose(shown.a, a, 0, 0);
      const hips = root.roles.hips === undefined ? 0 : root.roles.hips;
      const at = shown.a.at;
      const wanted = [at[3 * hips], at[3 * hips + 1], Math.min(Math.max(0.52 * (root.height_m || 1.7), 0.05), 3)];
      const across = [camera.position.y - controls.target.y, controls.target.x - camera.position.x];
      const n = Math.hypot(...across) || 1;
      if (shown.b) pose(shown.b, b, shift * across[0] / -n, shift * across[1] / -n);
      if (shown.c) pose(shown.c, c, 0, 0);
      if (!placed) {
        target.set(...wanted);
        const { low, high } = root.bounds();
        const tall = Math.max(root.height_m || 1.7, 0.3);
        const far = Math.min(Math.max(2.9 * tall, 1.1 * Math.max(high[0] - low[0], high[1] - low[1])), 14) + (shift ? 1.2 : 0);
        camera.position.set(0.66 * far, -0.66 * far, 0.3 * far).add(target);
        controls.target.copy(target);
        placed = true;
      } else if (follow) {
        moved.set(...wanted).sub(target);
        target.add(moved);
        camera.position.add(moved);
        controls.target.add(moved);
      }
      base.render();
      ink.clearRect(0, 0, host.clientWidth, host.clientHeight);
      marks(ink, view.screen, at);
    },
    screen(x, y, z) {
      point.set(x, y, z).project(camera);
      return point.z > 1 ? null : [((point.x + 1) / 2) * host.clientWidth, ((1 - point.y) / 2) * host.clientHeight, point.z];
    },
    // The joint of the first motion nearest to a place on the screen.
    pick(x, y, usable) {
      let best = null;
      if (!shown.a) return null;
      for (let j = 0; j < shown.a.motion.joints; j++) {
        if (usable && !usable(j)) continue;
        const at = view.screen(shown.a.at[3 * j], shown.a.at[3 * j + 1], shown.a.at[3 * j + 2]);
        if (!at) continue;
        const far = Math.hypot(at[0] - x, at[1] - y);
        if (far < 26 && (!best || far < best.far)) best = { joint: j, far, depth: at[2] };
      }
      return best;
    },
    // The place in the world under one on the screen: as deep as something, or on the plane z.
    under(x, y, depth) {
      point.set((x / host.clientWidth) * 2 - 1, 1 - (y / host.clientHeight) * 2, depth).unproject(camera);
      return [point.x, point.y, point.z];
    },
    onPlane(x, y, z) {
      const [ax, ay, az] = view.under(x, y, 0.2), eye = camera.position;
      const s = (z - eye.z) / (az - eye.z);
      return s > 0 && Number.isFinite(s) ? [eye.x + s * (ax - eye.x), eye.y + s * (ay - eye.y), z] : null;
    },
    // The box under a place on the screen.
    pickBox(x, y, given) {
      let best = null;
      given.forEach((box, k) => {
        const at = view.screen(box.pos[0], box.pos[1], box.pos[2]);
        const top = view.screen(box.pos[0], box.pos[1], box.pos[2] + box.size[2] / 2);
        if (!at || !top) return;
        const side = view.screen(box.pos[0] + box.size[0] / 2, box.pos[1] + box.size[1] / 2, box.pos[2]);
        const reach = Math.max(Math.hypot(top[0] - at[0], top[1] - at[1]), side ? Math.hypot(side[0] - at[0], side[1] - at[1]) : 0, 18);
        const far = Math.hypot(at[0] - x, at[1] - y);
        if (far < reach && (!best || far < best.far)) best = { box: k, far };
      });
      return best;
    },
    get places() { return shown.a ? shown.a.at : null; },
  };
  view.theme();
  view.resize();
  new ResizeObserver(view.resize).observe(host);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", view.theme);
  return view;
}
