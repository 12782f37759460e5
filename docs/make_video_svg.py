"""Draws docs/sam3d.svg, gvhmr.svg and hy_motion.svg: motion as those projects write it, and mended.

    python docs/make_video_svg.py docs

The files are made here, in the form of each project, from the walk that comes with Poise and errors of
known size: they are none that the projects made. `poise doctor FILE --fix` mends them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from poise.formats import read_clip
from poise.formats.raw import quats_from_z_up, vectors_from_z_up
from poise.formats.smpl import PELVIS
from poise.kinematics import anatomy_of, retarget, support_of
from poise.motion import Clip
from poise.motion.noise import Drift, Jitter, Noise, perturb_clip
from poise.motion.rotations import quat_to_rotvec

WALK = Path(__file__).parents[1] / "src" / "poise" / "data" / "walk.bvh"
SIZE, SCALE = (860, 320), 104.0
#: Height of the floor, and of the middle of what is seen from above, sideways twice as wide.
FLOOR, ABOVE, WIDE = 222.0, 272.0, 2.0
MOMENTS = 5
COLOURS = {"before": "#3b6fb6", "after": "#dd7722", "stands": "#1f8a4c"}
#: m that the path drifts aside over the clip, m that it floats, and other errors, by project.
DIRT: dict[str, tuple[float, float, tuple[Noise, ...]]] = {
    "sam3d": (0.0, 0.0, (Drift(strength=0.35), Jitter(strength=0.2))),
    "gvhmr": (0.5, 0.04, (Jitter(strength=0.05),)),
    "hy_motion": (0.45, -0.04, (Drift(strength=0.1),)),
}


def dirty(name: str) -> Clip:
    """The walk on SMPL's body with the errors of a project."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.npz"
        np.savez(rig, poses=np.zeros((2, 66)), trans=np.zeros((2, 3)), fps=30.0, up_axis="Y")
        clip = retarget(read_clip(WALK), read_clip(rig))[0]
    aside, up, noise = DIRT[name]
    share = np.linspace(0, 1, clip.frames)[:, None]
    way = clip.root_pos[-1] - clip.root_pos[0]
    beside = np.cross([0.0, 0.0, 1.0], way) / np.linalg.norm(way)
    moved = clip.root_pos + share * aside * beside + [0.0, 0.0, up]
    return perturb_clip(clip.replaced(root_pos=moved), noise, seed=1)


def turns(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Axis-angle vectors `(T, 22, 3)` and `trans (T, 3)` of SMPL's body, Y up."""
    root = vectors_from_z_up(clip.root_pos, "Y") - np.array(PELVIS)
    return quat_to_rotvec(quats_from_z_up(clip.rot, "Y")), root


def write_gvhmr(clip: Clip, folder: Path) -> Path:
    """`hmr4d_results.pt`."""
    rot, trans = turns(clip)
    told = {"global_orient": rot[:, 0], "body_pose": rot[:, 1:].reshape(len(rot), -1), "transl": trans}
    tensors = {k: torch.tensor(v, dtype=torch.float32) for k, v in told.items()}
    tensors["betas"] = torch.zeros(1, 10).expand(len(rot), 10)
    path = folder / "hmr4d_results.pt"
    torch.save({"smpl_params_global": tensors, "smpl_params_incam": tensors}, path)
    return path


def write_hy_motion(clip: Clip, folder: Path) -> Path:
    """npz with `Rh`, `trans` and `poses`."""
    rot, trans = turns(clip)
    poses = rot.reshape(len(rot), -1)
    path = folder / "hy_motion.npz"
    np.savez(path, Rh=rot[:, 0], trans=trans, poses=poses, betas=np.zeros((1, 16)), gender="neutral")
    return path


def write_sam3d(clip: Clip, folder: Path) -> Path:
    """npz with `pred_keypoints_3d` and `pred_cam_t` of all frames, from a camera beside the walk."""
    pos, names = clip.positions(), clip.skeleton.names
    way = (clip.root_pos[-1] - clip.root_pos[0]) * [1.0, 1.0, 0.0]
    right = way / np.linalg.norm(way)
    ahead = np.cross([0.0, 0.0, 1.0], right)
    pos = np.stack([pos @ right, -pos[..., 2], pos @ ahead + 5.0], -1)
    points = np.repeat(pos[:, names.index("head"), None], 70, axis=1)
    for k, part in enumerate(("shoulder", "elbow", "hip", "knee", "ankle")):
        for s, side in enumerate(("left", "right")):
            points[:, 5 + 2 * k + s] = pos[:, names.index(f"{side}_{part}")]
    for s, side in enumerate(("left", "right")):
        toe, ankle = (pos[:, names.index(f"{side}_{part}")] for part in ("foot", "ankle"))
        points[:, 15 + 3 * s] = points[:, 16 + 3 * s] = toe
        back = np.array([-0.3, 0.0, -0.3]) * (toe - ankle)
        points[:, 17 + 3 * s] = ankle + back + np.array([0.0, 0.05, 0.0])
        points[:, (62, 41)[s]] = pos[:, names.index(f"{side}_wrist")]
    points[:, 69] = pos[:, names.index("neck")]
    root = pos[:, 0]
    path = folder / "sam3d.npz"
    np.savez(path, pred_keypoints_3d=points - root[:, None], pred_cam_t=root)
    return path


WRITERS: dict[str, Callable[[Clip, Path], Path]] = {
    "sam3d": write_sam3d,
    "gvhmr": write_gvhmr,
    "hy_motion": write_hy_motion,
}


def picture(clips: dict[str, Clip]) -> str:
    """Both motions from the side at several moments, and below them, from above, the ways of their feet,
    thick where they stand."""
    parts = [f'<rect width="{SIZE[0]}" height="{SIZE[1]}" rx="8" fill="#f6f4f0"/>']
    for k, (name, clip) in enumerate(clips.items()):
        way = (clip.root_pos[-1] - clip.root_pos[0]) * [1.0, 1.0, 0.0]
        right = way / np.linalg.norm(way)
        away = np.cross([0.0, 0.0, 1.0], right)
        middle = (clip.root_pos[0] + clip.root_pos[-1]) / 2 * [1.0, 1.0, 0.0]
        pos = clip.positions() - middle
        along = pos @ right * SCALE + (k + 0.5) * SIZE[0] / 2
        flat = np.stack([along, FLOOR - pos[..., 2] * SCALE], -1)
        above = np.stack([along, ABOVE - pos @ away * WIDE * SCALE], -1)
        first, last = k * SIZE[0] / 2 + 16, (k + 1) * SIZE[0] / 2 - 16
        parts.append(f'<path stroke="#999" d="M{first:.0f} {FLOOR:.0f}H{last:.0f}"/>')
        parts.append(f'<text x="{20 + k * SIZE[0] / 2:.0f}" y="28" fill="{COLOURS[name]}">{name}</text>')
        for t in np.linspace(0, clip.frames - 1, MOMENTS).astype(int):
            bones = [(p, j) for j, p in enumerate(clip.skeleton.parents) if p >= 0]
            ends = ((*flat[t, p], *flat[t, j]) for p, j in bones)
            line = "".join("M{:.0f} {:.0f}L{:.0f} {:.0f}".format(*four) for four in ends)
            parts.append(f'<path stroke="{COLOURS[name]}" stroke-width="6" opacity="0.55" d="{line}"/>')
        parts += steps(clip, above, COLOURS[name])
    inside = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE[0]} {SIZE[1]}" '
        'font-family="sans-serif" font-size="16" fill="none" stroke-linecap="round">\n'
        f"<title>Before and after</title>\n{inside}\n</svg>\n"
    )


def steps(clip: Clip, flat: np.ndarray, colour: str) -> list[str]:
    """The ways of both toes, and thick those parts where the foot stands."""
    support = support_of(clip, anatomy_of(clip))
    assert support is not None
    out: list[str] = []
    for foot in dict.fromkeys(support.feet):
        stands = np.any(support.contacts[1][:, np.array(support.feet) == foot], axis=-1)
        toe = next((j for j, p in enumerate(clip.skeleton.parents) if p == foot), foot)
        every = "M" + "L".join("{:.0f} {:.0f}".format(*p) for p in flat[:, toe])
        pieces = (t for t in range(1, len(stands)) if stands[t - 1] and stands[t])
        thick = "".join(
            "M{:.1f} {:.1f}L{:.1f} {:.1f}".format(*flat[t - 1, toe], *flat[t, toe]) for t in pieces
        )
        out.append(f'<path stroke="{colour}" stroke-width="1" d="{every}"/>')
        out.append(f'<path stroke="{COLOURS["stands"]}" stroke-width="4" d="{thick}"/>')
    return out


def main(out: Path) -> None:
    """Writes the pictures."""
    for name, write in WRITERS.items():
        with tempfile.TemporaryDirectory() as folder:
            path, mended = write(dirty(name), Path(folder)), Path(folder) / "mended.npz"
            how = ["--allow-pickle"] + (["--fps", "30"] if name != "hy_motion" else [])
            words = ["doctor", str(path), "--fix", "-o", str(mended), *how]
            subprocess.run([sys.executable, "-m", "poise.cli.main", *words], check=True)
            clips = {
                "before": read_clip(path, fps=30, allow_pickle=True),
                "after": read_clip(mended),
            }
            (out / f"{name}.svg").write_text(picture(clips), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
