"use strict";
// The characters in WebGL: what is shown, where one looks from, and which body is under a finger.
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function makeStage(host, hello) {
  const T = THREE;
  const canvas = document.createElement("canvas");
  const renderer = new T.WebGLRenderer({ canvas, antialias: true });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  renderer.shadowMap.enabled = true;
  host.prepend(canvas);
  const scene = new T.Scene();
  const camera = new T.PerspectiveCamera(30, 1, 0.05, 200);
  camera.up.set(0, 0, 1);
  const controls = new T.OrbitControls(camera, canvas);
  controls.enableDamping = true;
  controls.maxPolarAngle = 1.55;
  controls.minDistance = 1;
  controls.maxDistance = 40;

  const sky = new T.HemisphereLight(0xffffff, 0xa39d98, 2.3);
  sky.position.set(0, 0, 1);
  const sun = new T.DirectionalLight(0xffffff, 2.1);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  sun.shadow.bias = -0.0004;
  sun.shadow.normalBias = 0.02;
  Object.assign(sun.shadow.camera, { left: -5, right: 5, top: 5, bottom: -5, near: 1, far: 24 });
  scene.add(sky, sun, sun.target);

  const grid = new T.ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: { center: { value: new T.Vector3() }, ink: { value: new T.Color() }, strength: { value: 0.3 } },
    vertexShader: `varying vec3 at; void main() { vec4 w = modelMatrix * vec4(position, 1.0); at = w.xyz;
      gl_Position = projectionMatrix * viewMatrix * w; }`,
    fragmentShader: `varying vec3 at; uniform vec3 center; uniform vec3 ink; uniform float strength;
      float mesh(vec2 p) { vec2 w = fwidth(p); vec2 d = abs(fract(p - 0.5) - 0.5) / max(w, vec2(1e-6));
        vec2 seen = (1.0 - smoothstep(vec2(0.0), vec2(1.4), d)) * (1.0 - smoothstep(0.08, 0.4, w));
        return max(seen.x, seen.y); }
      void main() { float far = 1.0 - smoothstep(2.0, 14.0, distance(at.xy, center.xy));
        gl_FragColor = vec4(ink, max(mesh(at.xy), 0.35 * mesh(at.xy * 4.0)) * far * strength);
        #include <colorspace_fragment>
      }`,
  });
  const plane = new T.PlaneGeometry(60, 60);
  const floor = new T.Mesh(plane, grid);
  const shade = new T.Mesh(plane, new T.ShadowMaterial({ opacity: 0.2 }));
  floor.position.z = 0.002;
  shade.receiveShadow = true;
  scene.add(shade, floor);

  function geometry(shape) {
    const [a, b, c] = shape.size;
    if (shape.kind === "box") return new T.BoxGeometry(2 * a, 2 * b, 2 * c);
    if (shape.kind === "sphere") return new T.SphereGeometry(a, 24, 16);
    return new T.CapsuleGeometry(a, 2 * b, 8, 20).rotateX(Math.PI / 2);
  }
  const shapes = hello.shapes.map((shape) => ({ shape, geo: geometry(shape) }));
  const ghost = new T.MeshBasicMaterial({ transparent: true, opacity: 0.28, depthWrite: false });
  function character(material, solid) {
    const root = new T.Group();
    const parts = hello.bodies.map(() => new T.Group());
    for (const { shape, geo } of shapes) {
      const mesh = new T.Mesh(geo, material);
      mesh.position.set(...shape.pos);
      mesh.quaternion.set(shape.quat[1], shape.quat[2], shape.quat[3], shape.quat[0]);
      mesh.castShadow = mesh.receiveShadow = solid;
      parts[shape.body].add(mesh);
    }
    root.add(...parts);
    scene.add(root);
    return { root, parts, material };
  }
  const every = Array.from({ length: hello.characters });
  const people = every.map(() => character(new T.MeshStandardMaterial({ roughness: 0.62 }), true));
  const goals = every.map(() => character(ghost, false));
  const ballMaterial = new T.MeshStandardMaterial({ roughness: 0.5 });
  const ball = new T.Mesh(new T.SphereGeometry(hello.ball, 28, 20), ballMaterial);
  ball.castShadow = true;
  const cord = new T.Mesh(new T.CylinderGeometry(0.008, 0.008, 1, 8).translate(0, 0.5, 0), new T.MeshBasicMaterial({ depthTest: false, transparent: true }));
  cord.renderOrder = 5;
  cord.visible = false;
  scene.add(ball, cord);

  const place = (group, rows, at) => {
    group.position.set(rows[at], rows[at + 1], rows[at + 2]);
    group.quaternion.set(rows[at + 4], rows[at + 5], rows[at + 6], rows[at + 3]);
  };
  const B = hello.bodies.length;
  const target = new T.Vector3(0, 0, 0.9);
  const wanted = new T.Vector3();
  const point = new T.Vector3();
  const up = new T.Vector3(0, 1, 0);
  let begun = false, drawn = 0;
  const stage = {
    canvas, camera, controls,
    theme() {
      scene.background = new T.Color(css("--bg"));
      scene.fog = new T.Fog(scene.background, 16, 48);
      grid.uniforms.ink.value.set(css("--ink"));
      grid.uniforms.strength.value = parseFloat(css("--grid")) || 0.2;
      shade.material.opacity = parseFloat(css("--shade")) || 0.2;
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
      sun.target.position.set(controls.target.x, controls.target.y, 0);
      sun.position.set(controls.target.x + 2.4, controls.target.y - 3, 8);
      grid.uniforms.center.value.copy(controls.target);
      floor.position.x = shade.position.x = controls.target.x;
      floor.position.y = shade.position.y = controls.target.y;
      renderer.render(scene, camera);
    },
    // The body nearest to a place on the screen, px: which, and how deep it lies.
    pick(x, y, state) {
      let best = null;
      for (let k = 0; k < hello.characters; k++)
        for (const { shape } of shapes) {
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
