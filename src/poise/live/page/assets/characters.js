"use strict";
// The characters on the stage: their colours, where one looks from, and which body is under a finger.
function makeStage(host, hello) {
  const base = threeStage(host, {
    fov: 30, polar: 1.55, far: 40, reach: 5, depth: 24, fade: [2, 14], fog: [16, 48], sunAt: [2.4, -3, 8], detail: 10,
  });
  const { T, css, canvas, renderer, scene, camera, controls, place, solid } = base;
  const ghost = new T.MeshBasicMaterial({ transparent: true, opacity: 0.28, depthWrite: false });
  const character = (material) => ({ ...base.figure(hello.bodies, hello.shapes, (shape) => [solid(shape, material)]), material });
  const goal = (shape) => {
    const mesh = solid(shape, ghost);
    mesh.castShadow = mesh.receiveShadow = false;
    return [mesh];
  };
  const every = Array.from({ length: hello.characters });
  const people = every.map(() => character(new T.MeshStandardMaterial({ roughness: 0.62 })));
  const goals = every.map(() => base.figure(hello.bodies, hello.shapes, goal));
  const ballMaterial = new T.MeshStandardMaterial({ roughness: 0.5 });
  const ball = new T.Mesh(new T.SphereGeometry(hello.ball, 28, 20), ballMaterial);
  ball.castShadow = true;
  const cord = new T.Mesh(new T.CylinderGeometry(0.008, 0.008, 1, 8).translate(0, 0.5, 0), new T.MeshBasicMaterial({ depthTest: false, transparent: true }));
  cord.renderOrder = 5;
  cord.visible = false;
  scene.add(ball, cord);

  const B = hello.bodies.length;
  const target = new T.Vector3(0, 0, 0.9);
  const wanted = new T.Vector3();
  const point = new T.Vector3();
  const up = new T.Vector3(0, 1, 0);
  let begun = false, drawn = 0;
  const stage = {
    canvas, camera, controls,
    theme() {
      base.theme("--bg");
      ghost.color.set(css("--ref"));
      ballMaterial.color.set(css("--thing"));
      cord.material.color.set(css("--down"));
      stage.colors = ["--sim", "--other", "--down"].map((name) => new T.Color(css(name)));
    },
    resize() {
      const [w, h] = [host.clientWidth, Math.max(host.clientHeight, 1)];
      renderer.setSize(w, h, false);
      camera.aspect = w / h;
      // Beside the panel, or above it on a phone.
      if (w > 640) camera.setViewOffset(w, h, Math.min(142, 0.2 * w), 0, w, h);
      else camera.setViewOffset(w, h, 0, 0.2 * h, w, h);
      camera.updateProjectionMatrix();
    },
    draw(state, chosen, follow, showGoals) {
      people.forEach((who, k) => {
        who.parts.forEach((part, b) => place(part, state.bodies, 7 * (k * B + b)));
        const down = state.doing[k] >= 2;
        who.material.color.copy(stage.colors[down ? 2 : k === chosen ? 0 : 1]);
      });
      goals.forEach((who, k) => {
        who.root.visible = showGoals;
        who.parts.forEach((part, b) => place(part, state.goals, 7 * (k * B + b)));
      });
      place(ball, state.ball, 0);
      const at = 7 * chosen * B;
      wanted.set(state.bodies[at], state.bodies[at + 1], 0.9);
      if (!begun) {
        target.copy(wanted);
        const far = 5.2 * Math.max(1, 0.75 / camera.aspect) + 1.2 * (hello.characters > 1);
        camera.position.set(0.7 * far, -0.62 * far, 0.34 * far).add(target);
        controls.target.copy(target);
        begun = true;
      } else if (follow) {
        // As near in a second, however many pictures are drawn in it.
        const share = 1 - Math.exp((drawn - performance.now()) / 130);
        point.copy(wanted).sub(target).multiplyScalar(share);
        target.add(point);
        camera.position.add(point);
        controls.target.add(point);
      } else target.copy(controls.target);
      drawn = performance.now();
      controls.update();
      base.render();
    },
    // The body nearest to a place on the screen, px: which, and how deep it lies.
    pick(x, y, state) {
      let best = null;
      for (let k = 0; k < hello.characters; k++)
        for (const shape of hello.shapes) {
          const b = shape.body;
          const part = people[k].parts[b];
          point.set(...shape.pos).applyQuaternion(part.quaternion).add(part.position).project(camera);
          if (point.z > 1) continue;
          const px = ((point.x + 1) / 2) * host.clientWidth - x;
          const py = ((1 - point.y) / 2) * host.clientHeight - y;
          const far = Math.hypot(px, py);
          if (!best || far < best.far) best = { character: k, body: b, point: shape.pos, far, z: point.z };
        }
      return best && best.far < 44 ? best : null;
    },
    // The place in the world under a place on the screen, as deep as something that was picked.
    under(x, y, z) {
      point.set((x / host.clientWidth) * 2 - 1, 1 - (y / host.clientHeight) * 2, z).unproject(camera);
      return [point.x, point.y, point.z];
    },
    pull(held, to) {
      cord.visible = Boolean(held);
      if (!held) return;
      const part = people[held.character].parts[held.body];
      point.set(...held.point).applyQuaternion(part.quaternion).add(part.position);
      const along = new T.Vector3(...to).sub(point);
      const length = along.length();
      cord.position.copy(point);
      cord.scale.set(1, Math.max(length, 1e-3), 1);
      cord.quaternion.setFromUnitVectors(up, along.divideScalar(length || 1));
    },
    screen(character, body) {
      point.copy(people[character].parts[body].position).project(camera);
      return [((point.x + 1) / 2) * host.clientWidth, ((1 - point.y) / 2) * host.clientHeight];
    },
  };
  stage.theme();
  stage.resize();
  addEventListener("resize", stage.resize);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", stage.theme);
  return stage;
}
