"""Takes a picture of a .glb in three.js: the figure at several moments of its motion, side by side.

    python docs/show_glb.py clip.glb picture.png --three node_modules/three

Needs Chromium and three.js with its GLTFLoader (`npm install three`). The page is served on this
machine only, and the script fails where three.js reports an error.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

PARTS = (
    "build/three.module.js",
    "build/three.core.js",
    "examples/jsm/loaders/GLTFLoader.js",
    "examples/jsm/utils/BufferGeometryUtils.js",
    "examples/jsm/utils/SkeletonUtils.js",
)
PAGE = """<!doctype html><meta charset="utf-8"><title>loading</title>
<style>body{margin:0;background:#f4f2ee}canvas{display:block}</style>
<script type="importmap">{"imports":{"three":"./build/three.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
import {GLTFLoader} from './examples/jsm/loaders/GLTFLoader.js';
import {clone} from './examples/jsm/utils/SkeletonUtils.js';
const shots = SHOTS, w = WIDTH, h = HEIGHT;
try {
  const gltf = await new GLTFLoader().loadAsync('clip.glb');
  const motion = gltf.animations[0];
  const scene = new THREE.Scene();
  scene.background = new THREE.Color('#f4f2ee');
  scene.add(new THREE.HemisphereLight('#ffffff', '#8a8378', 2.2));
  const sun = new THREE.DirectionalLight('#ffffff', 2.0);
  sun.position.set(2, 5, 3); scene.add(sun);
  const box = new THREE.Box3(), figures = [];
  for (let k = 0; k < shots; k++) {
    const figure = clone(gltf.scene), mixer = new THREE.AnimationMixer(figure);
    mixer.clipAction(motion).play();
    mixer.setTime(START + (Math.min(END, 0.999 * motion.duration) - START) * k / (shots - 1));
    figure.updateMatrixWorld(true);
    const own = new THREE.Box3();
    figure.traverse(o => { if (o.isBone) own.expandByPoint(o.getWorldPosition(new THREE.Vector3())); });
    const c = own.getCenter(new THREE.Vector3());
    figure.position.set(k * SPACING - c.x, 0, -c.z);
    figure.traverse(o => { o.frustumCulled = false; });
    figure.updateMatrixWorld(true);
    figures.push(figure); scene.add(figure);
    box.union(own.translate(new THREE.Vector3(k * SPACING - c.x, 0, -c.z)));
  }
  const grid = new THREE.GridHelper(24, 24, '#b9b3a8', '#d8d3ca');
  grid.position.x = (shots - 1) * SPACING / 2; scene.add(grid);
  const mid = box.getCenter(new THREE.Vector3()), size = box.getSize(new THREE.Vector3());
  const camera = new THREE.PerspectiveCamera(25, w / h, 0.05, 200);
  const far = 0.5 * Math.max((size.y + 0.35), (size.x + 0.5) * h / w) / Math.tan(Math.PI * 12.5 / 180);
  camera.position.set(mid.x, mid.y + 0.1 * far, mid.z + far + 0.6);
  camera.lookAt(mid);
  const renderer = new THREE.WebGLRenderer({antialias: true, preserveDrawingBuffer: true});
  renderer.setSize(w, h); document.body.append(renderer.domElement);
  renderer.render(scene, camera);
  const bones = []; figures[0].traverse(o => { if (o.isBone) bones.push(o.name); });
  await fetch('done?' + encodeURIComponent(`${bones.length} bones, ${motion.duration.toFixed(3)} s`));
} catch (error) { await fetch('failed?' + encodeURIComponent(String(error))); }
</script>"""
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-gl=angle"),
    *("--use-angle=swiftshader", "--disable-quic", "--no-first-run", "--virtual-time-budget=8000"),
)


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves one folder and remembers what the page reported."""

    reports: list[str]

    def do_GET(self) -> None:
        if self.path.startswith(("/done", "/failed")):
            self.reports.append(self.path[1:])
            self.send_response(204)
            self.end_headers()
        else:
            super().do_GET()

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not printed."""


def picture(
    glb: Path, png: Path, three: Path, shots: int, size: tuple[int, int], **numbers: float
) -> str:
    """Writes the picture and returns what three.js reported about the file."""
    chromium = (
        shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    )
    if chromium is None:
        raise SystemExit("Chromium was not found")
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as profile:
        for part in PARTS:
            target = Path(folder, part)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(three / part, target)
        shutil.copy(glb, Path(folder, "clip.glb"))
        # A headless window's inner height is smaller than its picture.
        page = (
            PAGE.replace("SHOTS", str(shots))
            .replace("WIDTH", str(size[0]))
            .replace("HEIGHT", str(size[1]))
        )
        for name, value in numbers.items():
            page = page.replace(name.upper(), str(value))
        Path(folder, "index.html").write_text(page)
        reports: list[str] = []
        handler = type("Handler", (Handler,), {"reports": reports})
        server = http.server.ThreadingHTTPServer(
            ("127.0.0.1", 0), functools.partial(handler, directory=folder)
        )
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = [chromium, *FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}"]
        command += [f"--screenshot={png.resolve()}", f"http://127.0.0.1:{server.server_port}/index.html"]
        subprocess.run(command, check=True, capture_output=True, env=dict(os.environ), timeout=240)
        server.shutdown()
    if not reports or not reports[0].startswith("done"):
        raise SystemExit(f"three.js did not show the file: {reports or 'no answer'}")
    return reports[0].removeprefix("done?").replace("%20", " ").replace("%2C", ",")


def main() -> None:
    """Reads the arguments and takes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--three", type=Path, default=Path("node_modules/three"))
    parser.add_argument("--shots", type=int, default=7)
    parser.add_argument("--start", type=float, default=0.0, help="seconds of the first figure")
    parser.add_argument("--end", type=float, default=1e9, help="seconds of the last figure")
    parser.add_argument("--spacing", type=float, default=1.2, help="metres between the figures")
    parser.add_argument("--size", type=int, nargs=2, default=(1200, 380))
    a = parser.parse_args()
    moments = {"start": a.start, "end": a.end, "spacing": a.spacing}
    sys.stdout.write(picture(a.glb, a.png, a.three, a.shots, tuple(a.size), **moments) + "\n")


if __name__ == "__main__":
    main()
