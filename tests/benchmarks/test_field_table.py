"""The field's errors and its three rules of success, by hand and beside a naive twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from benchmarks.common.clips import source_of
from benchmarks.common.field import FIGURES, done, episodes, figures, pooled
from benchmarks.common.success import under_rules
from poise.motion.rotations import axis_angle_to_quat
from poise.score.rollouts import RolloutSet


def rollouts(
    pos: torch.Tensor, ref: torch.Tensor, lengths: list[int], clips: list[str], **more
) -> RolloutSet:
    """Episodes of one clip each, in the order given; padding is NaN."""
    episodes, frames, bodies, _ = pos.shape
    alive = torch.arange(frames) < torch.tensor(lengths)[:, None]
    pos = torch.where(alive[..., None, None], pos, torch.nan)
    quat = torch.tensor([1.0, 0, 0, 0]).expand(episodes, frames, bodies, 4)
    zero = torch.zeros(episodes, frames, 1, 3)
    names = tuple(dict.fromkeys(clips))
    values = {
        "reached_end": torch.ones(episodes, dtype=torch.bool),
        "start": torch.zeros(episodes, dtype=torch.long),
        "fps": 30.0,
    }
    return RolloutSet(
        pos=pos, quat=quat, ref_pos=ref, ref_quat=quat, alive=alive, lengths=torch.tensor(lengths),
        force=zero, torque=zero, point_vel=zero, ang_vel=zero, mass=50.0, limit_n=0.0, limit_nm=0.0,
        clip=torch.tensor([names.index(c) for c in clips]), clip_names=names, **(values | more),
    )  # fmt: skip


def still(frames: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
    ref = torch.zeros(len(frames), max(frames), 3, 3, dtype=torch.float64)
    ref[:, :, 1, 2], ref[:, :, 2, 0] = 0.5, 0.3
    return ref.clone(), ref


def test_by_hand() -> None:
    pos, ref = still([11, 5])
    # Clip "a": one of three bodies, not the root, is 30 mm off. Clip "b": all are 60 mm off.
    pos[0, 1:, 1, 0] += 0.03
    pos[1, 1:, :, 1] += 0.06
    rows = episodes(rollouts(pos, ref, [11, 5], ["a", "b"]))
    assert [r["clip"] for r in rows] == ["a", "b"] and [r["tracked"] for r in rows] == [10, 4]
    assert done(rows) == 1.0
    assert pooled(rows, "g_mpjpe_mm") == pytest.approx((10 * 10 + 4 * 60) / 14)
    assert pooled(rows, "mpjpe_mm") == pytest.approx(10 * 10 / 14)
    assert pooled(rows[:1], "g_mpjpe_mm") == pytest.approx(10.0)


def test_speeds_by_hand() -> None:
    pos, ref = still([6])
    # Steps of 9 mm per frame of one body in three: 3 mm/frame; no acceleration.
    pos[0, :, 1, 0] += 0.009 * torch.arange(6)
    rows = episodes(rollouts(pos, ref, [6], ["a"]))
    assert pooled(rows, "vel_mm_per_frame") == pytest.approx(3.0)
    assert pooled(rows, "acc_mm_per_frame2") == pytest.approx(0.0, abs=1e-9)
    # 0.5 a t^2 with 6 mm/frame^2: 2 mm/frame^2 on average; at 60 Hz a frame is half as long.
    pos, ref = still([6])
    pos[0, :, 1, 0] += 0.003 * torch.arange(6) ** 2
    assert pooled(episodes(rollouts(pos, ref, [6], ["a"])), "acc_mm_per_frame2") == pytest.approx(2.0)
    fast = episodes(rollouts(pos, ref, [6], ["a"], fps=60.0))
    assert pooled(fast, "acc_mm_per_frame2") == pytest.approx(8.0)


def test_a_failed_clip_counts_up_to_its_failure() -> None:
    pos, ref = still([11, 11])
    pos[0, 1:, :, 0] += 0.01
    pos[1, 1:, :, 0] += 0.1
    pos[1, 4:, :, 0] += 0.7
    good, bad = episodes(rollouts(pos, ref, [11, 11], ["good", "bad"]))
    assert good["won"]["phc"] and not bad["won"]["phc"] and bad["tracked"] == 4
    assert pooled([bad], "g_mpjpe_mm") == pytest.approx((3 * 100 + 800) / 4)
    assert pooled([good, bad], "g_mpjpe_mm") == pytest.approx((10 * 10 + 3 * 100 + 800) / 14)
    # Sideways alone is no failure for the rules that look at height and turn.
    assert bad["won"]["sonic"] and bad["won"]["blinkmimic"]


def test_naive_twin() -> None:
    generator = torch.Generator().manual_seed(0)
    shape = (4, 20, 4, 3)
    ref = torch.randn(shape, generator=generator, dtype=torch.float64).cumsum(1) * 0.01
    pos = ref + 0.05 * torch.randn(shape, generator=generator, dtype=torch.float64)
    pos[1, 12:] += 0.9
    lengths = [20, 18, 9, 15]
    rows = episodes(rollouts(pos, ref, lengths, ["a", "b", "c", "d"]))
    sums = dict.fromkeys(FIGURES, 0.0)
    counts = dict.fromkeys(FIGURES, 0)
    for e, length in enumerate(lengths):
        p, q = pos[e].float().double().numpy(), ref[e].numpy()
        last = next(
            (t for t in range(length) if np.linalg.norm(p[t] - q[t], axis=-1).mean() > 0.5), length - 1
        )
        for t in range(1, last + 1):
            found = {
                "g_mpjpe_mm": np.linalg.norm(p[t] - q[t], axis=-1).mean(),
                "mpjpe_mm": np.linalg.norm((p[t] - p[t, 0]) - (q[t] - q[t, 0]), axis=-1).mean(),
            }
            if t + 1 <= last:
                v = (p[t + 1] - p[t]) - (q[t + 1] - q[t])
                found["vel_mm_per_frame"] = np.linalg.norm(v, axis=-1).mean()
            if t + 2 <= last:
                a = (p[t + 2] - 2 * p[t + 1] + p[t]) - (q[t + 2] - 2 * q[t + 1] + q[t])
                found["acc_mm_per_frame2"] = np.linalg.norm(a, axis=-1).mean()
            for k, v in found.items():
                sums[k], counts[k] = sums[k] + 1000 * float(v), counts[k] + 1
    for k in FIGURES:
        assert pooled(rows, k) == pytest.approx(sums[k] / counts[k], rel=1e-5), k


def turned(angle: float, axis: tuple[float, float, float]) -> torch.Tensor:
    return axis_angle_to_quat(torch.tensor(axis), torch.tensor(angle))


@pytest.mark.parametrize(
    ("height", "angle", "axis", "won"),
    [
        (0.24, 0.99, (0.0, 0.0, 1.0), {"phc": True, "sonic": True, "blinkmimic": True}),
        # The pelvis too low for both that look at it, and all bodies near enough for PHC's mean.
        (-0.26, 0.0, (0.0, 0.0, 1.0), {"phc": True, "sonic": False, "blinkmimic": False}),
        # About the vertical BlinkMimic's rule sees no turn.
        (0.0, 1.1, (0.0, 0.0, 1.0), {"phc": True, "sonic": False, "blinkmimic": True}),
        # cos(1.3) = 0.27 and cos(1.4) = 0.17: 0.73 and 0.83 off.
        (0.0, 1.3, (1.0, 0.0, 0.0), {"phc": True, "sonic": False, "blinkmimic": True}),
        (0.0, 1.4, (1.0, 0.0, 0.0), {"phc": True, "sonic": False, "blinkmimic": False}),
    ],
)
def test_the_three_rules(height: float, angle: float, axis: tuple, won: dict[str, bool]) -> None:
    pos, ref = still([6])
    made = rollouts(pos, ref, [6], ["a"])
    made.pos[0, 3, 0, 2] += height
    quat = made.quat.clone()
    quat[0, 3, 0] = turned(angle, axis)
    object.__setattr__(made, "quat", quat)
    assert {k: bool(v[0]) for k, v in under_rules(made).items()} == won


def test_an_episode_that_did_not_come_to_its_end_has_failed_by_all() -> None:
    pos, ref = still([6])
    short = rollouts(pos, ref, [6], ["a"], reached_end=torch.zeros(1, dtype=torch.bool))
    assert not any(bool(v[0]) for v in under_rules(short).values())


def test_drawn_starts_stand_beside_exact_ones_with_their_spread() -> None:
    pos, ref = still([6])
    pos[0, 1:, :, 0] += 0.02
    (one,) = episodes(rollouts(pos, ref, [6], ["a"]))
    sums = {k: [3 * s, n] for k, (s, n) in one["sums"].items()}
    rows = [
        one,
        one | {"trial": 1},
        one | {"trial": 2, "sums": sums, "won": dict.fromkeys(one["won"], False)},
    ]
    found = {(f.subject, f.metric): f for f in figures("x", rows)}
    assert found["x", "g_mpjpe_mm"].value == pytest.approx(20.0)
    drawn = next(f for (s, m), f in found.items() if s != "x" and m == "g_mpjpe_mm")
    assert drawn.value == pytest.approx(40.0) and drawn.spread == "20 to 60" and drawn.seeds == 2
    shares = next(f for (s, m), f in found.items() if s != "x" and m == "done")
    assert shares.value == 0.5 and shares.spread == "0 to 1" and "0.05 rad" in shares.subject
    assert math.isnan(pooled([], "g_mpjpe_mm"))


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("cmu_expmaps-train_walking_13_extra", "CMU, walks published for prediction"),
        ("cmu_expmaps-test_running_1", "CMU, runs, jumps and ball games published for prediction"),
        ("deepmimic-humanoid3d_dance_a", "DeepMimic"),
        ("bandai_bvh-dataset_2_walk_active_015", "Bandai"),
        ("held_out-cmu_amc-rfc-05_06", "CMU, dances"),
        ("cmu_amc-02-02_05", "CMU, other"),
    ],
)
def test_clips_have_a_source(name: str, source: str) -> None:
    assert source_of(name) == source
