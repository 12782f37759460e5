// The replay on the stage. Same four functions as the canvas stage: draw, project, resize, theme.
Poise.stageGL = (host, data, extent) => {
  const base = threeStage(host, {
    fov: 26, polar: 1.56, far: 30, reach: 2.2 + extent.gap, depth: 20, fade: [1, 7.5], fog: [14, 40],
    sunAt: [2.2, -2.8, 6.5], detail: 12,
  });
  const { T, canvas, scene, camera, controls, place, solid } = base;
  controls.dampingFactor = 0.12;
  const skin = () => new T.MeshStandardMaterial({ roughness: 0.62, metalness: 0.0 });
  const ghost = new T.ShaderMaterial({
    transparent: true,
    uniforms: { tint: { value: new T.Color() }, rim: { value: new T.Color() } },
    vertexShader: `varying vec3 n; varying vec3 v; void main() { vec4 p = modelViewMatrix * vec4(position, 1.0);
      n = normalMatrix * normal; v = -p.xyz; gl_Position = projectionMatrix * p; }`,
    fragmentShader: `varying vec3 n; varying vec3 v; uniform vec3 tint; uniform vec3 rim;
      void main() { float facing = clamp(dot(normalize(n), normalize(v)), 0.0, 1.0);
        float edge = pow(1.0 - facing, 1.6);
        gl_FragColor = vec4(mix(tint, rim, edge), 0.42 + 0.5 * edge);
        #include <colorspace_fragment>
      }`,
  });
  const veil = new T.MeshBasicMaterial({ colorWrite: false, transparent: true });
  const feet = [0, 1].map((side) => new Set(data.feet[side]));

  // The ghost is drawn twice, first into the depth buffer alone, so that its inner parts stay hidden.
  const ghostly = (shape) => [veil, ghost].map((material, k) => {
    const mesh = solid(shape, material);
    mesh.castShadow = material !== veil;
    mesh.receiveShadow = false;
    mesh.renderOrder = k + 1;
    return mesh;
  });
  function character(isGhost) {
    const mats = [skin(), skin(), skin()];
    const side = ({ body }) => (feet[0].has(body) ? 1 : feet[1].has(body) ? 2 : 0);
    const dress = isGhost ? ghostly : (shape) => [solid(shape, mats[side(shape)])];
    return { ...base.figure(data.bodies, data.shapes, dress), mats };
  }
  // What stands in the world, beside each character where they are apart.
  const wood = new T.MeshStandardMaterial({ roughness: 0.9, metalness: 0.0 });
  const grouped = (shapes) => {
    const group = new T.Group();
    for (const shape of shapes) group.add(solid(shape, wood));
    scene.add(group);
    return group;
  };
  const things = [0, 1].map(() => grouped(data.things || []));
  const movers = data.movers.map((shape) => grouped([shape]));
  const reference = character(true);
  const simulated = character(false);
  const others = data.others.map(() => character(false));
  const keys = (data.keys || []).map((frame) => {
    const at = { pos: new Float32Array(3 * data.bodies.length), quat: new Float32Array(4 * data.bodies.length) };
    return { who: character(true), at: Poise.sample(data.reference, data.bodies.length, data.frames, frame, at) };
  });

  const arrowMaterial = new T.MeshBasicMaterial({ depthTest: false, transparent: true });
  const shaft = new T.Mesh(new T.CylinderGeometry(0.016, 0.016, 1, 16).translate(0, 0.5, 0), arrowMaterial);
  const tip = new T.Mesh(new T.ConeGeometry(0.045, 0.11, 20).translate(0, 0.055, 0), arrowMaterial);
  const arrow = new T.Group().add(shaft, tip);
  shaft.renderOrder = tip.renderOrder = 5;
  scene.add(arrow);
  const pushMaterial = new T.MeshBasicMaterial({ depthTest: false, transparent: true });
  const pool = (length, material) => Array.from({ length }, () => {
    const one = new T.Mesh(new T.CylinderGeometry(0.01, 0.01, 1, 10).translate(0, 0.5, 0), material);
    const head = new T.Mesh(new T.ConeGeometry(0.03, 0.08, 14).translate(0, 0.04, 0), material);
    const group = new T.Group().add(one, head);
    one.renderOrder = head.renderOrder = 5;
    scene.add(group);
    return { group, one, head };
  });
  const pushed = pool(16, pushMaterial);
  const helped = pool(data.helps ? data.bodies.length : 0, arrowMaterial);
  const [up, along] = [new T.Vector3(0, 1, 0), new T.Vector3()];

  function pose(who, state, dx, dy) {
    who.root.position.set(dx, dy, 0);
    who.parts.forEach((part, b) => {
      part.position.fromArray(state.pos, b * 3);
      part.quaternion.set(state.quat[b * 4 + 1], state.quat[b * 4 + 2], state.quat[b * 4 + 3], state.quat[b * 4]);
    });
  }

  const colors = {};
  let placed = false;
  const target = new T.Vector3();
  const moved = new T.Vector3();
  const stage = {
    kind: "webgl",
    canvas,
    theme() {
      base.theme("--stage");
      ghost.uniforms.tint.value.set(Poise.css("--ref"));
      ghost.uniforms.rim.value.set(Poise.css("--ref-rim"));
      arrowMaterial.color.set(Poise.css("--help"));
      pushMaterial.color.set(Poise.css("--push"));
      wood.color.set(Poise.css("--thing"));
      colors.sim = new T.Color(Poise.css("--sim"));
      colors.other = new T.Color(Poise.css("--other"));
      colors.lit = new T.Color(Poise.css("--contact"));
    },
    resize: base.resize,
    // Looks from the front and the side, far enough for both characters.
    home() {
      const view = 2 * Math.tan((camera.fov * Math.PI) / 360);
      const wide = (extent.gap + 2.1 * extent.reach) / (view * Math.max(camera.aspect, 0.3));
      const far = Math.max((1.62 * (extent.top + 0.2)) / view, wide);
      camera.position.set(extent.view[0], extent.view[1], 0.2).multiplyScalar(far).add(target);
      controls.target.copy(target);
    },
    draw(frame) {
      const [x, y, z] = frame.target;
      if (!placed) {
        target.set(x, y, z);
        stage.home();
        placed = true;
      } else if (frame.follow) {
        moved.set(x, y, z).sub(target);
        target.add(moved);
        camera.position.add(moved);
        controls.target.add(moved);
      }
      controls.update();
      const [rx, ry] = frame.shift[0];
      const [sx, sy] = frame.shift[1];
      pose(reference, frame.reference, rx, ry);
      pose(simulated, frame.simulated, sx, sy);
      keys.forEach(({ who, at }) => pose(who, at, sx, sy));
      others.forEach((who, k) => {
        pose(who, frame.others[k], sx, sy);
        for (const mat of who.mats) mat.color.copy(colors.other);
      });
      ghost.visible = true;
      things.forEach((group, k) => group.position.set(frame.shift[k][0], frame.shift[k][1], 0));
      movers.forEach((group, k) => {
        const w = frame.movers[k];
        place(group, w, 0);
        group.position.x += frame.shift[1][0];
        group.position.y += frame.shift[1][1];
      });
      things[0].visible = Math.hypot(rx - sx, ry - sy) > 1e-3;
      simulated.mats[0].color.copy(colors.sim);
      for (const side of [0, 1]) simulated.mats[side + 1].color.copy(frame.lit[side] ? colors.lit : colors.sim);
      arrow.visible = Boolean(frame.arrow);
      if (frame.arrow) {
        along.fromArray(frame.arrow);
        const length = along.length();
        arrow.visible = length > 0.004;
        const head = Math.min(1, length / 0.2);
        arrow.position.set(frame.simulated.pos[0] + sx, frame.simulated.pos[1] + sy, frame.simulated.pos[2]);
        arrow.quaternion.setFromUnitVectors(up, along.divideScalar(length || 1));
        shaft.scale.set(1, Math.max(length - 0.1 * head, 1e-3), 1);
        tip.position.y = Math.max(length - 0.11 * head, 0);
        tip.scale.setScalar(head);
      }
      const point = (rows) => ({ group, one, head }, k) => {
        const row = rows[k];
        const length = row ? Math.hypot(row[3], row[4], row[5]) : 0;
        group.visible = length > 0.01;
        if (!group.visible) return;
        along.set(row[3] / length, row[4] / length, row[5] / length);
        group.position.set(row[0] + sx, row[1] + sy, row[2]);
        group.quaternion.setFromUnitVectors(up, along);
        one.scale.set(1, Math.max(length - 0.07, 1e-3), 1);
        head.position.y = Math.max(length - 0.08, 0);
      };
      pushed.forEach(point(frame.pushes));
      helped.forEach(point(frame.helps));
      base.render();
    },
    project(x, y, z) {
      const p = new T.Vector3(x, y, z).project(camera);
      return p.z > 1 ? null : [(p.x + 1) / 2, (1 - p.y) / 2];
    },
  };
  stage.theme();
  return stage;
};
