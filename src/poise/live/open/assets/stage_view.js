"use strict";
// The motion on the shared stage: one figure, another beside or over it, boxes, and marks drawn over all.
function stageView(host, over) {
  const plain = drawnBySoftware();
  const base = threeStage(host, {
    fov: 30, polar: 1.56, far: 60, reach: 5, depth: 26, fade: [2, 14], fog: plain ? [6, 14] : [18, 60], sunAt: [2.4, -3, 8], detail: 10, plain,
  });
  const { T, scene, camera, controls } = base, css = pageColor;
  for (const canvas of [base.canvas, over]) canvas.setAttribute("aria-hidden", "true");
  controls.dampingFactor = 0.14;
  camera.position.set(3.6, -3.6, 2.2);
  controls.target.set(0, 0, 0.9);
  const point = new T.Vector3(), ink = over.getContext("2d");
  const skin = () => (plain ? new T.MeshLambertMaterial() : new T.MeshStandardMaterial({ roughness: 0.6 }));
  // A ghost is drawn twice, first into the depth buffer alone, so that its inner parts stay hidden.
  const veil = new T.MeshBasicMaterial({ colorWrite: false });
  const ghostly = () => new T.MeshBasicMaterial({ transparent: true, opacity: 0.34 });
  const [ball, tube] = plain ? [new T.SphereGeometry(1, 10, 7), new T.CylinderGeometry(1, 1, 1, 10, 1, true)]
    : [new T.SphereGeometry(1, 24, 16), new T.CylinderGeometry(1, 1, 1, 24, 1, true)];
  tube.rotateX(Math.PI / 2);
  const wood = new T.MeshStandardMaterial({ roughness: 0.9 });
  const shown = { a: null, b: null, c: null };
  let boxes = [], target = new T.Vector3(0, 0, 0.9), placed = false, moved = new T.Vector3();

  // A figure of bones as capsules, and a head: all balls are drawn at once, and all tubes.
  function figure(motion, ghost) {
    const first = motion.at(0, new Float32Array(3 * motion.J));
    const bones = [];
    motion.parents.forEach((parent, joint) => {
      // The head's own bones lie inside of it.
      if (parent < 0 || parent === motion.head) return;
      const [i, p] = [3 * joint, 3 * parent];
      const length = Math.hypot(first[i] - first[p], first[i + 1] - first[p + 1], first[i + 2] - first[p + 2]);
      if (length < 1e-4) return;
      const radius = Math.min(motion.radii[joint], Math.max(0.45 * length, 0.006));
      bones.push({ joint, parent, radius, half: Math.max(length / 2 - 0.35 * radius, 0.001) });
    });
    if (motion.head !== null) bones.push({ joint: motion.head, parent: crown(motion, first), head: true, radius: motion.head_m });
    const root = new T.Group(), tubes = bones.filter((b) => !b.head).length;
    const layer = (material, order) => {
      const made = [new T.InstancedMesh(ball, material, tubes + bones.length), new T.InstancedMesh(tube, material, tubes)];
      for (const mesh of made) {
        mesh.castShadow = material !== veil && !ghost;
        mesh.receiveShadow = !ghost;
        mesh.frustumCulled = false;
        mesh.renderOrder = order;
        mesh.instanceMatrix.setUsage(T.DynamicDrawUsage);
      }
      root.add(...made);
      return made;
    };
    const material = ghost ? ghostly() : skin();
    const [balls, rods] = layer(material, ghost ? 2 : 0);
    if (ghost) layer(veil, 1).forEach((mesh, k) => { mesh.instanceMatrix = [balls, rods][k].instanceMatrix; });
    scene.add(root);
    return { root, balls, rods, material, bones, motion, at: new Float32Array(3 * motion.J), ghost };
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
    for (const mesh of who.root.children) mesh.dispose();
    who.material.dispose();
  }
  // Three axes and a place as a matrix of an instance.
  function set(out, k, ux, uy, uz, vx, vy, vz, wx, wy, wz, x, y, z) {
    const i = 16 * k;
    out[i] = ux; out[i + 1] = uy; out[i + 2] = uz; out[i + 3] = 0;
    out[i + 4] = vx; out[i + 5] = vy; out[i + 6] = vz; out[i + 7] = 0;
    out[i + 8] = wx; out[i + 9] = wy; out[i + 10] = wz; out[i + 11] = 0;
    out[i + 12] = x; out[i + 13] = y; out[i + 14] = z; out[i + 15] = 1;
  }
  function pose(who, frame, dx, dy) {
    const at = who.motion.at(frame, who.at), balls = who.balls.instanceMatrix, rods = who.rods.instanceMatrix;
    who.root.position.set(dx, dy, 0);
    let b = 0, r = 0;
    for (const bone of who.bones) {
      const ahead = bone.head && bone.parent < -1, i = 3 * bone.joint, p = 3 * (ahead ? ~bone.parent : bone.parent);
      const sign = ahead ? -1 : 1, a = bone.radius;
      let x = 0, y = 0, z = 1;
      if (bone.parent !== -1) { x = sign * (at[i] - at[p]); y = sign * (at[i + 1] - at[p + 1]); z = sign * (at[i + 2] - at[p + 2]); }
      const n = Math.hypot(x, y, z) || 1;
      x /= n; y /= n; z /= n;
      if (bone.head) {
        set(balls.array, b++, a, 0, 0, 0, a, 0, 0, 0, a, at[i] + 0.6 * a * x, at[i + 1] + 0.6 * a * y, at[i + 2] + 0.6 * a * z);
        continue;
      }
      // The shortest turn from Z onto the bone.
      const s = 1 + z < 1e-5 ? 0 : 1 / (1 + z), h = bone.half;
      const [ux, uy, vx, vy] = s ? [1 - x * x * s, -x * y * s, -x * y * s, 1 - y * y * s] : [1, 0, 0, -1];
      const mx = (at[i] + at[p]) / 2, my = (at[i + 1] + at[p + 1]) / 2, mz = (at[i + 2] + at[p + 2]) / 2;
      set(rods.array, r++, a * ux, a * uy, -a * x, a * vx, a * vy, -a * y, 2 * h * x, 2 * h * y, 2 * h * z, mx, my, mz);
      set(balls.array, b++, a, 0, 0, 0, a, 0, 0, 0, a, mx + h * x, my + h * y, mz + h * z);
      set(balls.array, b++, a, 0, 0, 0, a, 0, 0, 0, a, mx - h * x, my - h * y, mz - h * z);
    }
    balls.needsUpdate = rods.needsUpdate = true;
  }
  const tint = new T.Color();
  function paint(who) {
    if (who.ghost) return who.material.color.set(css("--ref"));
    const names = { left: css("--left"), right: css("--right") }, other = css("--sim");
    let b = 0, r = 0;
    for (const bone of who.bones) {
      tint.set(names[who.motion.sides[bone.joint]] || other);
      who.balls.setColorAt(b++, tint);
      if (bone.head) continue;
      who.balls.setColorAt(b++, tint);
      who.rods.setColorAt(r++, tint);
    }
    who.balls.instanceColor.needsUpdate = who.rods.instanceColor.needsUpdate = true;
  }
  const view = {
    canvas: base.canvas, camera, controls,
    theme() {
      base.theme("--bg");
      wood.color.set(css("--thing"));
      for (const who of [shown.a, shown.b, shown.c]) if (who) paint(who);
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
        if (motion) paint(shown[name]);
      }
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
    // Calls of the last picture.
    get calls() { return base.renderer.info.render.calls; },
    get places() { return shown.a ? shown.a.at : null; },
  };
  view.theme();
  view.resize();
  new ResizeObserver(view.resize).observe(host);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", view.theme);
  return view;
}
