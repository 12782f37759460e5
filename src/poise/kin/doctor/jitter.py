"""Trembling bones: noise between neighbouring frames, told from motion by its frequency."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from poise.kin.doctor.faults import Fault, spell_faults
from poise.kin.series import fade_beside, gaussian_sums
from poise.motion import Clip
from poise.spatial import normalize, quat_between, quat_mul, quat_rotate, quat_to_rotvec, unwrap_quats

#: Noise (m, rms) of the root, and of one end of a bone against the other, that counts as trembling.
ROOT_M, BONE_M = 0.003, 0.003
#: Fourth differences exceed second ones this much only above a quarter of the frame rate:
#: |2 sin(x / 2)|^2 is 2 at x = pi / 2. White noise has sqrt(70 / 6) = 3.4.
SHARP = 2.0
#: Half the window (s) over which both are averaged, and how many frames at least.
WINDOW_S, WINDOW_FRAMES = 0.1, 8
#: Spells nearer than this (s) are one.
GAP_S = 0.15
#: Deviations (frames) of the Gaussian that smooths, the first that suffices; the largest in seconds.
SIGMAS, WIDEST_S = (0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0), 0.05


def trembling(path: Tensor, fps: float, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Noise `(T)` in the unit of `path (T, n)`, and where it exceeds `limit` and is as sharp as noise.

    White noise of deviation s has fourth differences of deviation sqrt(70) s, and second ones that are
    `SHARP` times smaller or less. Of both the median over a window around each frame counts, so that a
    foot that strikes or a single jump is no noise.
    """
    frames = len(path)
    half = max(WINDOW_FRAMES, round(WINDOW_S * fps))
    if frames < 2 * half + 1:
        return np.zeros(frames), np.zeros(frames, dtype=bool)
    # Takes 0.2 s to load, which `poise info` need not wait for.
    from scipy.ndimage import median_filter

    # A fourth difference is centred on its third frame, a second difference on its second.
    high, low = (
        median_filter(
            np.pad(torch.diff(path, n=n, dim=0).norm(dim=-1).numpy(), n // 2, mode="edge"),
            2 * half + 1,
            mode="mirror",
        )
        for n in (4, 2)
    )
    size = high / math.sqrt(70.0)
    return size, (size > limit) & (high > SHARP * low)


def jitter_faults(clip: Clip) -> list[Fault]:
    """Bones that tremble, in mm of one end against the other, and a root path that does.

    The joint that is named is the one with a rotation that trembles, not those that only ride on it.
    """
    gap, least = round(GAP_S * clip.fps), WINDOW_FRAMES
    out = []
    size, bad = trembling(torch.tensor(clip.root_pos), clip.fps, ROOT_M)
    out += spell_faults("root jitter", clip.skeleton.names[0], size * 1e3, bad, gap, least)
    rot, world = torch.tensor(clip.rot), torch.tensor(clip.world()[1])
    for j, bones in enumerate(_bones(clip)):
        for bone in bones:
            size, bad = _bone_noise(world[:, j], bone, clip.fps, BONE_M)
            if not bad.any():
                continue
            own = _bone_noise(rot[:, j], bone, clip.fps, 0.7 * BONE_M)[1]
            name = clip.skeleton.names[j]
            found = spell_faults("jitter", name, size * 1e3, bad & own, gap, least)
            if found:
                out += found
                break
    return out


def mend_jitter(clip: Clip) -> Clip:
    """The clip smoothed where bones or the root tremble, as little as it takes; else as it is.

    A Gaussian mean, which shifts nothing in time, is blended in over the spell and its reach; its
    deviation is the smallest of `SIGMAS` after which the noise is below its limit. Rotations are
    smoothed in the world's frame, since in a captured chain the noise of one joint undoes that of the
    next.
    """
    skeleton = clip.skeleton
    root = _smoothed(torch.tensor(clip.root_pos), clip.fps, ROOT_M, None)
    rot, world = torch.tensor(clip.rot), torch.tensor(clip.world()[1])
    smooth = [_smoothed_bones(world[:, j], bones, clip.fps) for j, bones in enumerate(_bones(clip))]
    if root is None and all(s is None for s in smooth):
        return clip
    out, turned = rot.clone(), world.clone()
    for j, parent in enumerate(skeleton.parents):
        above = turned[:, parent] if parent >= 0 else None
        if smooth[j] is None and (above is None or _calmer(rot[:, j], world[:, j])):
            # Calm against its parent: it rides along.
            turned[:, j] = rot[:, j] if above is None else quat_mul(above, rot[:, j])
            continue
        own = smooth[j]
        turned[:, j] = world[:, j] if own is None else own
        local = turned[:, j] if above is None else quat_between(above, turned[:, j])
        changed = (turned[:, j] != world[:, j]).any(-1)
        if parent >= 0:
            changed |= (turned[:, parent] != world[:, parent]).any(-1)
        out[changed, j] = normalize(local[changed])
    path = clip.root_pos if root is None else root.numpy()
    return clip.replaced(root_pos=path, rot=unwrap_quats(out).numpy())


def _bones(clip: Clip) -> list[list[Tensor]]:
    """Per joint the vectors (m, its own frame) to its children and tips, the longest first."""
    skeleton = clip.skeleton
    out: list[list[Tensor]] = [[] for _ in range(len(skeleton))]
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            out[parent].append(torch.tensor(skeleton.offsets[j]))
    for j, tip in skeleton.tips:
        out[j].append(torch.tensor(tip, dtype=torch.float64))
    return [
        sorted((v for v in b if float(v.norm()) > 0.01), key=lambda v: -float(v.norm())) for b in out
    ]


def _bone_noise(track: Tensor, bone: Tensor, fps: float, limit: float) -> tuple[np.ndarray, np.ndarray]:
    return trembling(quat_rotate(track, bone.expand(len(track), 3)), fps, limit)


def _calmer(local: Tensor, world: Tensor) -> bool:
    """Whether a joint trembles less against its parent than in the world."""
    return bool(_shaking(local) <= _shaking(world))


def _shaking(track: Tensor) -> Tensor:
    steps = quat_to_rotvec(quat_between(track[:-1], track[1:]))
    return torch.diff(steps, n=3, dim=0).square().mean() if len(steps) > 3 else steps.sum() * 0


def _smoothed_bones(track: Tensor, bones: list[Tensor], fps: float) -> Tensor | None:
    tries = (_smoothed(unwrap_quats(track), fps, BONE_M, bone) for bone in bones)
    return next((t for t in tries if t is not None), None)


def _smoothed(path: Tensor, fps: float, limit: float, bone: Tensor | None) -> Tensor | None:
    """The path without its noise, None where it has none; with a `bone`, a path of its rotations."""

    def noise(now: Tensor) -> tuple[np.ndarray, np.ndarray]:
        return trembling(now, fps, limit) if bone is None else _bone_noise(now, bone, fps, limit)

    first = noise(path)
    spells = spell_faults("jitter", "", *first, round(GAP_S * fps), WINDOW_FRAMES)
    out = path
    for spell in spells:
        here = slice(spell.start, spell.stop + 1)
        before = out
        for sigma in SIGMAS:
            if sigma > max(SIGMAS[0], WIDEST_S * fps):
                break
            out = _blend(before, spell.start, spell.stop, sigma)
            out = out if bone is None else normalize(out)
            if not noise(out)[1][here].any():
                break
    return out if spells else None


def _blend(path: Tensor, start: int, stop: int, sigma: float) -> Tensor:
    """The Gaussian mean inside the spell, the path itself beyond the filter's reach."""
    total, weights, reach = gaussian_sums(path, sigma)
    weight = fade_beside(len(path), start, stop, reach + 1).unsqueeze(-1)
    return path + weight * (total / weights - path)
