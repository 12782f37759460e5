"""The LAFAN1 protocol against a second implementation that shares no code with the first.

The twin reads BVH text itself, keeps Y up and centimetres as the benchmark states them, and loops over
windows, frames and joints one at a time.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.suites.inbetween_complete import Baseline
from poise.formats import read_clip
from poise.learn.transition import SkeletonLayout
from poise.metrics import physics
from poise.score.gaps import BANDAI, LAFAN1, Protocol, deviation, evaluate, slide, test_set
from poise.score.gaps import TestSet as InbetweenTestSet
from poise.synthesis.windows import LAFAN1_FACING, pack_frames, without_still_root

# pytest would take the function for a test.
make_test_set = test_set
del test_set

LENGTHS = (5, 15, 30, 45)


def mul(a, b):
    w, x, y, z = a
    p, q, r, s = b
    return np.array([
        w * p - x * q - y * r - z * s, w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q, w * s + x * r - y * q + z * p,
    ])  # fmt: skip


def turn(q, v):
    """q v q^-1, q not normalised where the benchmark does not."""
    t = 2 * np.cross(q[1:], v)
    return v + q[0] * t + np.cross(q[1:], t)


def about(axis, degrees):
    half = math.radians(degrees) / 2
    q = np.zeros(4)
    q[0], q[1 + "XYZ".index(axis)] = math.cos(half), math.sin(half)
    return q


def read_text(path, most):
    """Offsets, parents, root path and local quaternions of a plain BVH, file axes and unit."""
    names, parents, offsets, orders, stack, end = [], [], [], [], [], False
    lines = path.read_text().splitlines()
    at = lines.index("MOTION")
    for line in lines[:at]:
        words = line.split()
        if words[0] in ("ROOT", "JOINT"):
            names.append(words[1])
            parents.append(stack[-1] if stack else -1)
            stack.append(len(names) - 1)
            end = False
        elif words[0] == "End":
            end = True
            stack.append(-2)
        elif words[0] == "OFFSET" and not end:
            offsets.append([float(w) for w in words[1:]])
        elif words[0] == "CHANNELS":
            orders.append("".join(w[0] for w in words[2:] if w.endswith("rotation")))
        elif words[0] == "}" and stack.pop() == -2:
            end = False
    rows = [[float(w) for w in line.split()] for line in lines[at + 3 : at + 3 + most]]
    root, quats = [], []
    for row in rows:
        root.append(row[:3])
        pose, k = [], 3
        for order in orders:
            q = np.array([1.0, 0, 0, 0])
            for letter in order:
                q = mul(q, about(letter, row[k]))
                k += 1
            pose.append(q)
        quats.append(pose)
    quats = np.array(quats)
    for t in range(1, len(quats)):
        for j in range(len(names)):
            if (quats[t, j] * quats[t - 1, j]).sum() < (quats[t, j] * -quats[t - 1, j]).sum():
                quats[t, j] = -quats[t, j]
    return np.array(offsets), parents, np.array(root), quats


def kinematics(offsets, parents, root, quats):
    pos, glob = np.zeros((len(parents), 3)), np.zeros((len(parents), 4))
    for j, p in enumerate(parents):
        pos[j] = root if p < 0 else pos[p] + turn(glob[p], offsets[j])
        glob[j] = quats[j] if p < 0 else mul(glob[p], quats[j])
    return pos, glob


class Twin:
    """The protocol written out: windows, baselines and figures of clips in their files' own axes."""

    def __init__(self, clips, forward):
        self.clips, self.forward = clips, np.array(forward)

    def windows(self, length, step):
        out = []
        for offsets, parents, root, quats in self.clips:
            i = 0
            while i + length < len(root):
                out.append(self.placed(offsets, parents, root[i : i + length], quats[i : i + length]))
                i += step
        return out

    def placed(self, offsets, parents, root, quats):
        root, quats = root.copy(), quats.copy()
        root[:, 0] -= root[:, 0].mean()
        root[:, 2] -= root[:, 2].mean()
        ahead = turn(quats[9, 0], self.forward) * [1, 0, 1]
        ahead /= np.linalg.norm(ahead)
        # The turn from +X to ahead, then its inverse on every frame.
        q = np.array([1 + ahead[0], *np.cross([1, 0, 0], ahead)])
        q /= np.linalg.norm(q)
        back = q * [1, -1, -1, -1]
        for t in range(len(root)):
            root[t], quats[t, 0] = turn(back, root[t]), mul(back, quats[t, 0])
        return offsets, parents, root, quats

    def std(self):
        rows = []
        for window in self.windows(50, 20):
            offsets, parents, root, quats = window
            rows += [kinematics(offsets, parents, root[t], quats[t])[0] for t in range(50)]
        return np.std(np.array(rows), axis=0)

    def figures(self, windows, std, n, kind):
        l2p, l2q, mine, true = [], [], [], []
        for offsets, parents, root, quats in windows:
            for i in range(n):
                t = 10 + i
                r, q = root[9], quats[9]
                if kind == "interpolation":
                    w = float(np.linspace(0, 1, n + 2, dtype=np.float32)[i + 1])
                    r = (1 - w) * root[9] + w * root[10 + n]
                    q = np.array([arc(a, b, w) for a, b in zip(quats[9], quats[10 + n], strict=True)])
                p, g = kinematics(offsets, parents, r, q)
                p0, g0 = kinematics(offsets, parents, root[t], quats[t])
                l2p.append(math.sqrt((((p - p0) / std) ** 2).sum()))
                l2q.append(math.sqrt(((g - g0) ** 2).sum()))
                mine.append(g.ravel())
                true.append(g0.ravel())
        shape = (len(windows), n, -1)
        return np.mean(l2p), np.mean(l2q), spectra(np.reshape(mine, shape), np.reshape(true, shape))


def arc(a, b, t):
    dot = (a * b).sum()
    b, dot = (-b, -dot) if dot < 0 else (b, dot)
    if 1 - dot < 0.01:
        return (1 - t) * a + t * b
    angle = math.acos(dot)
    return (math.sin((1 - t) * angle) * a + math.sin(t * angle) * b) / math.sin(angle)


def spectra(mine, true):
    total, weights = 0.0, 0.0
    for a, b in zip(mine, true, strict=True):
        for d in range(a.shape[1]):
            power_a, power_b = np.fft.fft(a[:, d]).real ** 2, np.fft.fft(b[:, d]).real ** 2
            if power_b.sum() == 0:
                continue
            emd = np.abs(np.cumsum(power_a / power_a.sum()) - np.cumsum(power_b / power_b.sum())).sum()
            total, weights = total + emd * power_b.sum(), weights + power_b.sum()
    return total / weights


def compare(bank, twin, protocol):
    std = deviation(bank, protocol)
    their_std = twin.std()
    # (x, y, z) with Y up is (x, -z, y) with Z up; deviations have no sign.
    assert np.allclose(std.numpy() * 100, their_std[:, [0, 2, 1]], atol=1e-6)
    test = make_test_set(bank, std, protocol)
    windows = twin.windows(65, 40)
    assert len(test.root) == len(windows)
    layout = SkeletonLayout(bank.parents, bank.feet, bank.facing)
    for kind in ("zero-velocity", "interpolation"):
        for row in evaluate(Baseline(kind, layout), test, LENGTHS):
            theirs = twin.figures(windows, their_std, row.length, kind)
            assert (row.l2p, row.l2q, row.npss) == pytest.approx(theirs, abs=1e-6)


def test_the_lafan1_take_scores_as_in_a_second_implementation(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "lafan1_bvh/walk4_subject1.bvh"
    frames = 266
    offsets, parents, root, quats = read_text(path, frames)
    clip = read_clip(path)
    clip = clip.replaced(root_pos=clip.root_pos[:frames], rot=clip.rot[:frames])
    bank = pack_frames([clip], facing=LAFAN1_FACING)
    protocol = Protocol("LAFAN1", final="subject5")
    compare(bank, Twin([(offsets, parents, root, quats)], [0, 1, 0]), protocol)


def test_bandai_scores_as_in_a_second_implementation(data_dir: Path) -> None:
    names = ("dataset-1_walk_sad_001", "dataset-1_run_proud_001", "dataset-2_walk_youthful_005")
    clips = [read_clip(data_dir / f"other/bandai_bvh/{name}.bvh") for name in names]
    clips = [without_still_root(c.replaced(root_pos=c.root_pos[:150], rot=c.rot[:150])) for c in clips]
    bank = pack_frames(clips)
    # Back into the file's axes, by (x, y, z) -> (x, z, -y), and centimetres.
    back = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    raw = []
    for clip in clips:
        quats = np.concatenate((clip.rot[..., :1], clip.rot[..., 1:] @ back.T), -1)
        offsets, root = clip.skeleton.offsets @ back.T * 100, clip.root_pos @ back.T * 100
        raw.append((offsets, clip.skeleton.parents, root, quats))
    compare(bank, Twin(raw, back @ np.array(bank.facing)), BANDAI)


def test_splits_keep_the_final_styles_away_from_training_and_choices() -> None:
    part = BANDAI.part_of
    assert part("dataset-1_walk_old_001") == part("dataset-1_walk-left_giant_002") == "final"
    assert part("dataset-1_bow_tired_001") == part("dataset-2_run_elderly_010") == "final"
    assert part("dataset-1_walk_sad_001") == part("dataset-2_walk_youthful_003") == "validation"
    assert part("dataset-1_walk_normal_001") == part("dataset-2_run_active_003") == "train"
    assert LAFAN1.part_of("walk4_subject5") == "final" and LAFAN1.part_of("walk4_subject1") == "train"


def test_the_truth_has_its_own_physics(data_dir: Path) -> None:
    bank = pack_frames([read_clip(data_dir / "other/bandai_bvh/dataset-1_walk_sad_001.bvh")])
    test = make_test_set(bank, torch.ones(len(bank.names), 3, dtype=torch.float64), BANDAI)
    for n in test.protocol.lengths:
        depth, share, joints, moved = physics(test.truth(n)[0], test.feet, test.fps)
        assert moved > 0 and depth <= 0 and 0 <= share <= 1 and 0 <= joints <= 1
        assert slide(test, test.truth(n)[0], n) >= 0


def test_feet_slide_where_the_recorded_ones_stand_and_only_there() -> None:
    pos = torch.zeros(1, 65, 3, 3, dtype=torch.float64)
    # Joint 1 stands, joint 2 walks: only joint 1 counts.
    pos[:, :, 2, 0] = torch.arange(65) * 0.02
    turns, plain = torch.zeros(1, 65, 3, 4), torch.zeros(1, 65, 3)
    held = InbetweenTestSet(
        BANDAI, plain, turns, pos, turns, plain[:, 0], plain[0], (1, 2), (-1, 0, 0), 30
    )
    made = pos[:, 10:15].clone()
    assert slide(held, made, 5) == 0.0
    made[0, :, 1, 0] = torch.arange(1, 6) * 0.01
    made[0, :, 2, 0] += 1.0
    # Five steps of 10 mm, and 50 mm back to where it stands.
    assert slide(held, made, 5) == pytest.approx(100 / 6)
    assert slide(held, made, 5) != slide(held, made[:, :4], 4)
