// Decodes the embedded motion and samples it between frames. One global, `Poise`, holds the parts.
const Poise = {};
(() => {
  function bytes(text) {
    const raw = atob(text);
    const out = new Uint8Array(raw.length);
    for (let k = 0; k < raw.length; k++) out[k] = raw.charCodeAt(k);
    return out.buffer;
  }
  const floats = (text) => (text ? new Float32Array(bytes(text)) : null);

  const arrows = (data) => (data ? { rows: floats(data.rows), first: floats(data.first) } : null);

  function decodeTrack(data, frames, bodies) {
    const root = new Float32Array(bytes(data.root));
    const offset = new Int16Array(bytes(data.offset));
    const packed = new Int16Array(bytes(data.quat));
    const pos = new Float32Array(frames * bodies * 3);
    for (let t = 0; t < frames; t++)
      for (let b = 0; b < bodies; b++)
        for (let k = 0; k < 3; k++) {
          const i = (t * bodies + b) * 3 + k;
          pos[i] = root[t * 3 + k] + offset[i] * data.step;
        }
    const quat = new Float32Array(packed.length);
    for (let i = 0; i < packed.length; i += 4) {
      const n = Math.hypot(packed[i], packed[i + 1], packed[i + 2], packed[i + 3]) || 1;
      for (let k = 0; k < 4; k++) quat[i + k] = packed[i + k] / n;
    }
    return { name: data.name, pos, quat };
  }

  Poise.decode = (data) => {
    const n = data.bodies.length;
    const out = {
      ...data,
      reference: decodeTrack(data.reference, data.frames, n),
      simulated: decodeTrack(data.simulated, data.frames, n),
      force: floats(data.force),
      others: (data.others || []).map((track) => decodeTrack(track, data.frames, n)),
      movers: (data.movers || []).map((mover) => ({ ...mover, way: floats(mover.way) })),
      pushes: arrows(data.pushes),
      helps: arrows(data.helps),
      torque: floats(data.torque),
      error: floats(data.error),
      errorGlobal: floats(data.errorGlobal),
      contacts: data.contacts ? new Uint8Array(bytes(data.contacts)) : null,
    };
    out.forceNorm = out.force ? norms(out.force) : null;
    out.torqueNorm = out.torque ? norms(out.torque) : null;
    return out;
  };

  function norms(v) {
    const out = new Float32Array(v.length / 3);
    for (let t = 0; t < out.length; t++) out[t] = Math.hypot(v[3 * t], v[3 * t + 1], v[3 * t + 2]);
    return out;
  }

  // The pose at a time between two frames: positions are blended linearly, rotations by a
  // normalised linear blend on the shorter arc, which suffices at motion-capture rates.
  Poise.sample = (track, bodies, frames, at, pose) => {
    const t = Math.min(Math.floor(at), frames - 1);
    const u = Math.min(t + 1, frames - 1);
    const w = at - t;
    for (let i = 0; i < bodies * 3; i++) {
      const a = track.pos[t * bodies * 3 + i];
      pose.pos[i] = a + w * (track.pos[u * bodies * 3 + i] - a);
    }
    for (let b = 0; b < bodies; b++) {
      const i = (t * bodies + b) * 4;
      const j = (u * bodies + b) * 4;
      const q = track.quat;
      const dot = q[i] * q[j] + q[i + 1] * q[j + 1] + q[i + 2] * q[j + 2] + q[i + 3] * q[j + 3];
      const s = dot < 0 ? -w : w;
      let n = 0;
      for (let k = 0; k < 4; k++) {
        const v = (1 - w) * q[i + k] + s * q[j + k];
        pose.quat[b * 4 + k] = v;
        n += v * v;
      }
      n = 1 / Math.sqrt(n || 1);
      for (let k = 0; k < 4; k++) pose.quat[b * 4 + k] *= n;
    }
    return pose;
  };

  // Rotates v by the unit quaternion (w, x, y, z) that starts at q[i].
  Poise.rotate = (q, i, v) => {
    const [w, x, y, z] = [q[i], q[i + 1], q[i + 2], q[i + 3]];
    const tx = 2 * (y * v[2] - z * v[1]);
    const ty = 2 * (z * v[0] - x * v[2]);
    const tz = 2 * (x * v[1] - y * v[0]);
    return [
      v[0] + w * tx + y * tz - z * ty,
      v[1] + w * ty + z * tx - x * tz,
      v[2] + w * tz + x * ty - y * tx,
    ];
  };

  // Whether a tall box stands at first between the root of a motion and who looks at it from `view`.
  const hides = ({ kind, size, pos, way }, root, view) => {
    if (kind !== "box" || size[2] < 0.5) return false;
    const off = Poise.rotate(way, 3, pos);
    const [x, y] = [way[0] + off[0] - root[0], way[1] + off[1] - root[1]];
    const ahead = x * view[0] + y * view[1];
    return ahead > 0 && ahead < 3 && Math.abs(x * view[1] - y * view[0]) < Math.max(size[0], size[1]);
  };

  // How wide, tall and in which direction the clip moves; it places the camera and the two copies.
  Poise.extent = (data) => {
    const n = data.bodies.length;
    const { pos } = data.reference;
    let top = 0.5;
    let reach = 0.3;
    for (let t = 0; t < data.frames; t++)
      for (let b = 0; b < n; b++) {
        const i = (t * n + b) * 3;
        const r = t * n * 3;
        top = Math.max(top, pos[i + 2]);
        reach = Math.max(reach, Math.hypot(pos[i] - pos[r], pos[i + 1] - pos[r + 1]));
      }
    const last = (data.frames - 1) * n * 3;
    let dx = pos[last] - pos[0];
    let dy = pos[last + 1] - pos[1];
    if (Math.hypot(dx, dy) < 0.3) [dx, dy] = [1, 0];
    const norm = Math.hypot(dx, dy);
    const forward = [dx / norm, dy / norm];
    const gap = Math.min(2.2, Math.max(1.15, 1.6 * reach));
    // The camera looks from the front and a little from the right; the two copies stand apart across
    // that view, so that both are equally far away and appear equally tall.
    // From behind, where something tall, such as a door, would hide the character.
    const [a, b] = [0.85, -0.53];
    let view = [a * forward[0] - b * forward[1], a * forward[1] + b * forward[0]];
    if (data.movers.some((mover) => hides(mover, pos, view))) view = [-view[0], -view[1]];
    return { top, reach, view, apart: [-view[1], view[0]], gap };
  };

  Poise.css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // Newtons that one metre of arrow stands for: a round number that keeps the longest below 1 m.
  Poise.arrowScale = (norm) => {
    let most = 0;
    if (norm) for (const v of norm) if (v > most) most = v;
    let scale = 100;
    for (const next of [200, 500, 1000, 2000, 5000, 10000, 50000]) if (most > scale) scale = next;
    return scale;
  };
})();
