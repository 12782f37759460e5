"""Walks, runs, jumps, basketball and soccer of CMU, as they are published for prediction, as BVH.

    python training/cmu_expmaps.py data/cmu_mocap --skeleton FOLDER/01_01.bvh -o LIBRARY/cmu_expmaps

`data/cmu_mocap` is that folder of the repository of Li et al. (CVPR 2018), "Convolutional Sequence to
Sequence Model for Human Dynamics": one row of 117 numbers a frame, the root's place in CMU's units and
the exponential maps of 38 joints, the ends of limbs among them, at 120 Hz. `--skeleton` is any BVH of
CMU's 31 joints. Its proportions are not the performers', with which standing feet would slide: the root
travels as far as they say. Takes with feet that slide in spite of that are left out, and so are those of
performers that are held out (05, 11, 14).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from poise.formats import read_clip, write_clip
from poise.formats.guess import ASF_UNIT_M
from poise.motion import Clip, Skeleton
from poise.motion.rotations import rotvec_to_quat

#: Rows of the 31 joints among the 38; the others are the ends of limbs.
ENDS = (6, 12, 19, 26, 28, 35, 37)
ROWS = [j for j in range(38) if j not in ENDS]
ACTIONS = ("walking", "walking_extra", "running", "jumping", "basketball", "soccer")
#: 02_01 again, 05_01, what may be of 14, and 11_01.
NOT = ("train-walking_1", "train-walking_2", "train-jumping_2", "test-jumping_1", "test-soccer_1")
#: m/s of standing feet, beyond which a take is left out.
SLIDE = 0.4
FEET = ("LeftToeBase", "RightToeBase")


def to_z_up(vectors: np.ndarray) -> np.ndarray:
    """`(..., 3)` with Y up as with Z up."""
    return np.stack((vectors[..., 0], -vectors[..., 2], vectors[..., 1]), -1)


def clip_of(path: Path, skeleton: Skeleton, name: str) -> Clip:
    """A file's motion. Its first row is a T-pose; its maps turn row vectors, the other way round."""
    # Some rows end in a comma.
    rows = [[float(x) for x in line.split(",") if x.strip()] for line in path.read_text().splitlines()]
    data = np.array([r for r in rows if len(r) == 117])[1:]
    turns = -to_z_up(data[:, 3:].reshape(len(data), 38, 3)[:, ROWS])
    rot = rotvec_to_quat(torch.tensor(turns)).numpy()
    clip = Clip(skeleton, to_z_up(data[:, :3]) * ASF_UNIT_M, rot, 120.0, name)
    return clip.replaced(root_pos=clip.root_pos * travel(clip))


def standing(clip: Clip) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps `(T - 1, 2, 2)` of both toes relative to the root, of the root, and which toes stand."""
    toes = clip.positions()[:, [clip.skeleton.index(n) for n in FEET]]
    low = toes[..., 2] < np.quantile(toes[..., 2], 0.1, axis=0) + 0.02
    own = np.diff(toes - clip.root_pos[:, None], axis=0)[..., :2]
    root = np.broadcast_to(np.diff(clip.root_pos, axis=0)[:, None, :2], own.shape)
    return own, root, low[1:] & low[:-1]


def travel(clip: Clip) -> float:
    """The scale of the root's path with which standing feet slide least."""
    own, root, stands = standing(clip)
    own, root = own[stands], root[stands]
    scale = -float((own * root).sum()) / max(float((root**2).sum()), 1e-12)
    far = np.linalg.norm(np.diff(clip.root_pos[:, :2], axis=0), axis=1).sum() > 1.0
    return scale if far and 0.8 < scale < 1.25 else 1.0


def slide(clip: Clip) -> float:
    """Median speed of standing toes, m/s."""
    own, root, stands = standing(clip)
    return float(np.median(np.linalg.norm(own + root, axis=-1)[stands])) * clip.fps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--skeleton", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    a = parser.parse_args()
    skeleton = read_clip(a.skeleton).skeleton
    assert len(skeleton) == len(ROWS), f"{a.skeleton} has {len(skeleton)} joints and not {len(ROWS)}"
    a.out.mkdir(parents=True, exist_ok=True)
    for path in sorted(p for action in ACTIONS for p in a.data.glob(f"*/{action}/*.txt")):
        part = path.parent.parent.name
        extra = "-extra" if path.parent.name == "walking_extra" else ""
        name = f"{part}-{path.stem}{extra}"
        if name in NOT:
            continue
        clip = clip_of(path, skeleton, name)
        if (speed := slide(clip)) > SLIDE:
            print(f"{clip.name}: left out, its feet slide at {speed:.2f} m/s")
            continue
        write_clip(clip, a.out / f"{clip.name}.bvh")


if __name__ == "__main__":
    main()
