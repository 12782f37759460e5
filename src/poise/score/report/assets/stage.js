// The stage of the report and of the live page, in three.js: light, floor, camera, and figures of bodies.
// plain: without shadows and smooth edges, and lines as floor, for who draws without a GPU.
function threeStage(host, { fov, polar, far, reach, depth, fade, fog, sunAt, detail, plain = false }) {
  const T = THREE;
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const canvas = document.createElement("canvas");
  const renderer = new T.WebGLRenderer({ canvas, antialias: !plain, alpha: false });
  renderer.setPixelRatio(plain ? 1 : Math.min(window.devicePixelRatio || 1, 2));
  renderer.shadowMap.enabled = !plain;
  host.prepend(canvas);
  const scene = new T.Scene();
  const camera = new T.PerspectiveCamera(fov, 1, 0.05, 200);
  camera.up.set(0, 0, 1);
  const controls = new T.OrbitControls(camera, canvas);
  controls.enableDamping = true;
  controls.maxPolarAngle = polar;
  controls.minDistance = 1;
  controls.maxDistance = far;

  const sky = new T.HemisphereLight(0xffffff, 0xa39d98, 2.3);
  sky.position.set(0, 0, 1);
  const sun = new T.DirectionalLight(0xffffff, 2.1);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  sun.shadow.bias = -0.0004;
  sun.shadow.normalBias = 0.02;
  Object.assign(sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 1, far: depth });
  scene.add(sky, sun, sun.target);

  const grid = new T.ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: {
      center: { value: new T.Vector3() }, ink: { value: new T.Color() }, strength: { value: 0.3 },
      near: { value: fade[0] }, gone: { value: fade[1] },
    },
    vertexShader: `varying vec3 at; void main() { vec4 w = modelMatrix * vec4(position, 1.0); at = w.xyz;
      gl_Position = projectionMatrix * viewMatrix * w; }`,
    fragmentShader: `varying vec3 at; uniform vec3 center; uniform vec3 ink; uniform float strength; uniform float near; uniform float gone;
      float mesh(vec2 p) { vec2 w = fwidth(p); vec2 d = abs(fract(p - 0.5) - 0.5) / max(w, vec2(1e-6));
        vec2 seen = (1.0 - smoothstep(vec2(0.0), vec2(1.4), d)) * (1.0 - smoothstep(0.08, 0.4, w));
        return max(seen.x, seen.y); }
      void main() { float far = 1.0 - smoothstep(near, gone, distance(at.xy, center.xy));
        gl_FragColor = vec4(ink, max(mesh(at.xy), 0.35 * mesh(at.xy * 4.0)) * far * strength);
        #include <colorspace_fragment>
      }`,
  });
  const plane = new T.PlaneGeometry(60, 60);
  const lines = new T.LineBasicMaterial({ transparent: true });
  const floor = plain ? new T.LineSegments(metres(12), lines) : new T.Mesh(plane, grid);
  const shade = new T.Mesh(plane, new T.ShadowMaterial({ opacity: 0.2 }));
  floor.position.z = 0.001;
  shade.receiveShadow = true;
  scene.add(floor);
  if (!plain) scene.add(shade);
  // A line for each metre, both ways, in pieces, since long lines that pass the camera are not drawn.
  function metres(far) {
    const ends = [];
    for (let k = -far; k <= far; k++) for (let i = -far; i < far; i += 2) ends.push(k, i, 0, k, i + 2, 0, i, k, 0, i + 2, k, 0);
    return new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(ends, 3));
  }

  const place = (group, rows, at) => {
    group.position.set(rows[at], rows[at + 1], rows[at + 2]);
    group.quaternion.set(rows[at + 4], rows[at + 5], rows[at + 6], rows[at + 3]);
  };
  const shapes = new Map();
  function geometry(shape) {
    if (!shapes.has(shape)) {
      const [a, b, c] = shape.size;
      const made = shape.kind === "box" ? new T.BoxGeometry(2 * a, 2 * b, 2 * c)
        : shape.kind === "sphere" ? new T.SphereGeometry(a, 2 * detail + 8, detail + 8)
        : new T.CapsuleGeometry(a, 2 * b, 8, 2 * detail).rotateX(Math.PI / 2);
      shapes.set(shape, made);
    }
    return shapes.get(shape);
  }
  // A shape in its place on a body, with shadows.
  function solid(shape, material) {
    const mesh = new T.Mesh(geometry(shape), material);
    place(mesh, [...shape.pos, ...shape.quat], 0);
    mesh.castShadow = mesh.receiveShadow = true;
    return mesh;
  }
  return {
    T, css, canvas, renderer, scene, camera, controls, place, solid,
    // A group for each body; `dress` gives the meshes of a shape.
    figure(bodies, parts, dress) {
      const root = new T.Group();
      const groups = bodies.map(() => new T.Group());
      for (const shape of parts) groups[shape.body].add(...dress(shape));
      root.add(...groups);
      scene.add(root);
      return { root, parts: groups };
    },
    theme(background) {
      scene.background = new T.Color(css(background));
      scene.fog = new T.Fog(scene.background, ...fog);
      grid.uniforms.ink.value.set(css("--ink"));
      grid.uniforms.strength.value = lines.opacity = parseFloat(css("--grid")) || 0.2;
      lines.color.set(css("--ink"));
      shade.material.opacity = parseFloat(css("--shade")) || 0.2;
    },
    resize(width, height) {
      renderer.setSize(width, height, false);
      camera.aspect = width / Math.max(height, 1);
      camera.updateProjectionMatrix();
    },
    render() {
      const at = controls.target;
      sun.target.position.set(at.x, at.y, 0);
      sun.position.set(at.x + sunAt[0], at.y + sunAt[1], sunAt[2]);
      grid.uniforms.center.value.copy(at);
      shade.position.x = at.x;
      shade.position.y = at.y;
      // Lines stay on whole metres.
      floor.position.x = plain ? Math.round(at.x) : at.x;
      floor.position.y = plain ? Math.round(at.y) : at.y;
      renderer.render(scene, camera);
    },
  };
}
// Whether this browser draws with the processor alone.
function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const told = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = told ? gl.getParameter(told.UNMASKED_RENDERER_WEBGL) : "";
  if (gl) gl.getExtension("WEBGL_lose_context").loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
