// The replay on a plain 2D canvas, for browsers without WebGL. Same functions as the WebGL stage.
Poise.stage2D = (host, data, extent) => {
  const canvas = document.createElement("canvas");
  const layer = document.createElement("canvas");
  const g = canvas.getContext("2d");
  const l = layer.getContext("2d");
  host.prepend(canvas);
  let [width, height, ratio] = [1, 1, 1];
  const cam = { turn: Math.atan2(extent.view[1], extent.view[0]), tilt: 0.2, far: 0 };
  const centre = [0, 0, 0];
  const lens = 1 / Math.tan((Math.PI * 13) / 180);
  let axes = null;
  let colors = {};

  function aim() {
    const [ct, st, cp, sp] = [Math.cos(cam.turn), Math.sin(cam.turn), Math.cos(cam.tilt), Math.sin(cam.tilt)];
    const back = [ct * cp, st * cp, sp];
    axes = { back, right: [-st, ct, 0], up: [-ct * sp, -st * sp, cp] };
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  // A world point to [x px, y px, depth m, px per m], or null behind the camera.
  function project(p) {
    const d = [p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]];
    const depth = cam.far - dot(d, axes.back);
    if (depth < 0.1) return null;
    const scale = (lens * height) / 2 / depth;
    return [width / 2 + dot(d, axes.right) * scale, height / 2 - dot(d, axes.up) * scale, depth, scale];
  }

  canvas.addEventListener("pointermove", (e) => {
    if (!e.buttons) return;
    cam.turn -= e.movementX * 0.008;
    cam.tilt = Math.min(1.5, Math.max(0.02, cam.tilt + e.movementY * 0.006));
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    cam.far = Math.min(30, Math.max(1.2, cam.far * Math.exp(e.deltaY * 0.001)));
  }, { passive: false });

  function line(ctx, points, color, wide) {
    ctx.strokeStyle = color;
    ctx.lineWidth = wide;
    ctx.beginPath();
    points.forEach((p, k) => (k ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
    ctx.stroke();
  }

  function grid() {
    const [cx, cy] = [Math.round(centre[0]), Math.round(centre[1])];
    g.lineCap = "butt";
    for (let k = -6; k <= 6; k++) {
      for (const swap of [false, true]) {
        for (let m = -6; m < 6; m++) {
          const at = (u) => project(swap ? [cx + u, cy + k, 0] : [cx + k, cy + u, 0]);
          const [a, b] = [at(m), at(m + 1)];
          if (!a || !b) continue;
          g.globalAlpha = 0.22 * Math.max(0, 1 - Math.hypot(k, m + 0.5) / 6.5);
          line(g, [a, b], colors.ink, 1);
        }
      }
    }
    g.globalAlpha = 1;
  }

  function hull(points) {
    points.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    const half = (list) => {
      const out = [];
      for (const p of list) {
        while (out.length > 1) {
          const [a, b] = out.slice(-2);
          if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
          out.pop();
        }
        out.push(p);
      }
      out.pop();
      return out;
    };
    return half(points).concat(half(points.slice().reverse()));
  }

  // World points and radius of one shape: two ends of a capsule, the centre of a sphere, eight corners.
  function corners(shape, pose, shift) {
    const b = shape.body;
    const local = { capsule: [[0, 0, -1], [0, 0, 1]], sphere: [[0, 0, 0]], box: [] }[shape.kind];
    const size = shape.kind === "capsule" ? [0, 0, shape.size[1]] : shape.kind === "box" ? shape.size : [0, 0, 0];
    if (shape.kind === "box")
      for (let k = 0; k < 8; k++) local.push([k & 1 ? 1 : -1, k & 2 ? 1 : -1, k & 4 ? 1 : -1]);
    return local.map((v) => {
      const r = Poise.rotate(shape.quat, 0, [v[0] * size[0], v[1] * size[1], v[2] * size[2]]);
      const w = Poise.rotate(pose.quat, 4 * b, [r[0] + shape.pos[0], r[1] + shape.pos[1], r[2] + shape.pos[2]]);
      return [w[0] + pose.pos[3 * b] + shift[0], w[1] + pose.pos[3 * b + 1] + shift[1], w[2] + pose.pos[3 * b + 2]];
    });
  }

  function paint(ctx, kind, at, radius, color, rim) {
    ctx.lineCap = ctx.lineJoin = "round";
    if (kind === "box") {
      const edge = hull(at.slice());
      ctx.beginPath();
      edge.forEach((p, k) => (k ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
      ctx.closePath();
      ctx.fillStyle = color;
      ctx.strokeStyle = rim;
      ctx.lineWidth = 1.5;
      ctx.fill();
      ctx.stroke();
      return;
    }
    const wide = 2 * radius * at.reduce((sum, p) => sum + p[3], 0) / at.length;
    const points = at.length > 1 ? at : [at[0], [at[0][0] + 0.01, at[0][1]]];
    line(ctx, points, rim, wide);
    line(ctx, points, color, Math.max(1, wide - 3));
  }

  function wipe() {
    l.setTransform(ratio, 0, 0, ratio, 0, 0);
    l.clearRect(0, 0, width, height);
  }
  function stamp(alpha, filter) {
    g.save();
    g.globalAlpha = alpha;
    g.filter = filter;
    g.drawImage(layer, 0, 0, width, height);
    g.restore();
  }

  // What stands in the world, behind the characters.
  function things(shift) {
    const still = { pos: [0, 0, 0], quat: [1, 0, 0, 0] };
    for (const shape of data.things || []) {
      const at = corners({ ...shape, body: 0 }, still, shift).map(project);
      if (at.every(Boolean)) paint(g, shape.kind, at, shape.size[0], colors.thing, colors.ink);
    }
  }

  function movers(frame) {
    data.movers.forEach((shape, k) => {
      const w = frame.movers[k];
      const at = corners({ ...shape, body: 0 }, { pos: w.subarray(0, 3), quat: w.subarray(3, 7) }, frame.shift[1]).map(project);
      if (at.every(Boolean)) paint(g, shape.kind, at, shape.size[0], colors.thing, colors.ink);
    });
  }

  function character(pose, shift, color, rim, alpha, lit) {
    const items = [];
    wipe();
    for (const shape of data.shapes) {
      const world = corners(shape, pose, shift);
      const flat = world.map((p) => project([p[0], p[1], 0]));
      if (flat.every(Boolean)) paint(l, shape.kind, flat, shape.size[0] * 0.8, "#000", "#000");
      const at = world.map(project);
      if (at.some((p) => !p)) continue;
      const side = data.feet[0].includes(shape.body) ? 0 : data.feet[1].includes(shape.body) ? 1 : -1;
      items.push({ shape, at, depth: at.reduce((sum, p) => sum + p[2], 0) / at.length, on: side >= 0 && lit[side] });
    }
    stamp(0.16, "blur(5px)");
    wipe();
    items.sort((a, b) => b.depth - a.depth);
    for (const { shape, at, on } of items) paint(l, shape.kind, at, shape.size[0], on ? colors.lit : color, rim);
    stamp(alpha, "none");
  }

  function force(from, vector, color = colors.help) {
    const a = project(from);
    const b = project([from[0] + vector[0], from[1] + vector[1], from[2] + vector[2]]);
    if (!a || !b) return;
    const long = Math.hypot(b[0] - a[0], b[1] - a[1]);
    if (long < 2) return;
    line(g, [a, b], color, 4);
    const [dx, dy] = [(b[0] - a[0]) / long, (b[1] - a[1]) / long];
    const h = Math.min(11, long * 0.6);
    line(g, [[b[0] - h * (dx - 0.6 * dy), b[1] - h * (dy + 0.6 * dx)], b,
      [b[0] - h * (dx + 0.6 * dy), b[1] - h * (dy - 0.6 * dx)]], color, 4);
  }

  const stage = {
    kind: "2d",
    canvas,
    theme() {
      const names = { bg: "--stage", ink: "--ink", ref: "--ref", refRim: "--ref-rim", sim: "--sim",
        simRim: "--sim-rim", help: "--help", thing: "--thing", other: "--other", push: "--push", lit: "--contact" };
      for (const key in names) colors[key] = Poise.css(names[key]);
    },
    resize(w, h) {
      [width, height, ratio] = [w, h, Math.min(window.devicePixelRatio || 1, 2)];
      for (const c of [canvas, layer]) [c.width, c.height] = [Math.round(w * ratio), Math.round(h * ratio)];
      if (!cam.far) stage.home();
    },
    home() {
      const view = 2 / lens;
      const wide = (extent.gap + 2.1 * extent.reach) / (view * Math.max(width / height, 0.3));
      cam.far = Math.max((1.62 * (extent.top + 0.2)) / view, wide);
    },
    draw(frame) {
      if (frame.follow || !axes) for (const k of [0, 1, 2]) centre[k] = frame.target[k];
      aim();
      g.setTransform(ratio, 0, 0, ratio, 0, 0);
      g.fillStyle = colors.bg;
      g.fillRect(0, 0, width, height);
      grid();
      things(frame.shift[1]);
      if (Math.hypot(frame.shift[0][0] - frame.shift[1][0], frame.shift[0][1] - frame.shift[1][1]) > 1e-3)
        things(frame.shift[0]);
      movers(frame);
      for (const key of data.keys || []) {
        const at = { pos: new Float32Array(3 * data.bodies.length), quat: new Float32Array(4 * data.bodies.length) };
        Poise.sample(data.reference, data.bodies.length, data.frames, key, at);
        character(at, frame.shift[1], colors.ref, colors.refRim, 0.25, [false, false]);
      }
      for (const pose of frame.others) character(pose, frame.shift[1], colors.other, colors.simRim, 1, [false, false]);
      character(frame.simulated, frame.shift[1], colors.sim, colors.simRim, 1, frame.lit);
      character(frame.reference, frame.shift[0], colors.ref, colors.refRim, 0.3 + 0.3 * frame.blend, [false, false]);
      for (const [rows, color] of [[frame.pushes, colors.push], [frame.helps, colors.help]])
        for (const p of rows) {
          const [dx, dy] = frame.shift[1];
          force([p[0] + dx, p[1] + dy, p[2]], p.slice(3), color);
        }
      if (frame.arrow) {
        const [p, d] = [frame.simulated.pos, frame.shift[1]];
        force([p[0] + d[0], p[1] + d[1], p[2]], frame.arrow);
      }
    },
    project(x, y, z) {
      const p = axes && project([x, y, z]);
      return p ? [p[0] / width, p[1] / height] : null;
    },
  };
  stage.theme();
  return stage;
};
