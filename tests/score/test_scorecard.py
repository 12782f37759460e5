"""The score card: hand-computed rollouts, stable keys, files that are whole or absent."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from poise.metrics import KINDS, Shapes
from poise.score import table
from poise.score.card import read_score, write_score
from poise.score.rollouts import RolloutSet
from poise.score.scorecard import PLAUSIBILITY, TRACKING, score_rollouts
from refusals import refused

KEYS = [
    "succ", "succ_rule", "mpjpe_mm", "mpjpe_global_mm", "vel_mm_per_frame", "acc_mm_per_frame2",
    "foot_slide_mm_per_s", "penetration_mm", "float_mm", "jerk", "reward", "help", "seconds",
    "samples", "seed", "version", "clip", "method", "episodes", "frames", "mpjpe_succ_mm",
    "tracked", "needs", "reference", "per_clip", "weighting", "variants", "nothing", "starts", "spread",
    "delivered",
]  # fmt: skip
HELP_KEYS = [
    "limit_n", "limit_nm", "force_mean_n", "force_p95_n", "torque_mean_nm", "torque_p95_nm",
    "work_j_per_s", "share_of_body_weight",
]  # fmt: skip
TOLD = [
    "clip", "episodes", "frames", "succ", "first_fail_s", "tracked", "fallen_s", "off_feet_s",
]  # fmt: skip
CLIP_KEYS = [*TOLD, *TRACKING, *PLAUSIBILITY, "force_mean_n"]

BALL = 0.05


def rollouts(**changes):
    """Two episodes (10 and 4 frames) of a root and a ball-shaped foot that stand still.

    Episode 0 follows with the foot 20 mm to the side and 10 mm deep; episode 1 of another clip is
    100 mm off with its whole body. Padding is NaN.
    """
    ref = torch.zeros(2, 12, 2, 3, dtype=torch.float64)
    ref[:, :, 0, 2], ref[:, :, 1, 2] = 0.9, BALL
    pos = ref.clone()
    pos[0, :, 1] += torch.tensor([0.02, 0.0, 0.0])
    pos[1, :, :, 0] += 0.1
    lengths = torch.tensor([10, 4])
    alive = torch.arange(12) < lengths[:, None]
    pos[~alive] = torch.nan
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(2, 12, 2, 4)
    zero = torch.zeros(2, 12, 1, 3, dtype=torch.float64)
    made = RolloutSet(
        pos=pos, quat=quat, ref_pos=ref, ref_quat=quat, alive=alive, lengths=lengths,
        reached_end=torch.tensor([True, True]), force=zero, torque=zero, point_vel=zero, ang_vel=zero,
        reward={"total": torch.ones(2, 12), "pose": torch.full((2, 12), 0.5)},
        clip=torch.tensor([1, 0]), start=torch.tensor([0, 30]), clip_names=("walk", "run"),
        fps=30.0, mass=50.0, limit_n=100.0, limit_nm=math.inf, feet=(1,),
        shapes=Shapes(
            torch.tensor([KINDS["sphere"]]), torch.tensor([[BALL, 0, 0]]), torch.zeros(1, 3),
            torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([1]),
        ),
    )  # fmt: skip
    return replace(made, **changes)


def test_keys_are_stable():
    d = score_rollouts(rollouts(), method="residual_force", seed=3, samples=10, seconds=1.5).to_dict()
    assert list(d) == KEYS
    assert list(d["help"]) == HELP_KEYS
    assert [list(entry) for entry in d["per_clip"]] == [CLIP_KEYS, CLIP_KEYS]
    assert list(d["reward"]) == ["total", "pose"]
    assert list(d["reference"]) == ["foot_slide_mm_per_s", "penetration_mm", "float_mm", "jerk"]
    weighted = ["frame", "episode", "succ_frame", "succ_episode", "uncut_frame", "uncut_episode"]
    assert list(d["variants"]) == weighted


def test_hand_computed_figures_frame_and_episode_weighted():
    card = score_rollouts(rollouts())
    assert card.succ == 1.0 and card.episodes == 2 and card.frames == 14
    # Episode 0: joints 0 and 20 mm off, mean 10 mm, 10 frames. Episode 1: 100 mm, 0 after the root.
    assert card.mpjpe_global_mm == pytest.approx((10 * 10 + 4 * 100) / 14)
    assert card.mpjpe_mm == pytest.approx(10 * 10 / 14) == card.mpjpe_succ_mm
    assert card.variants["episode"]["mpjpe_global_mm"] == pytest.approx((10 + 100) / 2)
    by_episode = score_rollouts(rollouts(), weighting="episode")
    assert by_episode.mpjpe_global_mm == pytest.approx(55.0) and by_episode.weighting == "episode"
    assert card.vel_mm_per_frame == pytest.approx(0.0) and card.jerk == pytest.approx(0.0)
    assert card.foot_slide_mm_per_s == pytest.approx(0.0) and card.float_mm == pytest.approx(0.0)
    assert card.reward == {"total": 1.0, "pose": 0.5}
    assert card.clip == "walk, run"


def test_plausibility_of_both_sides():
    r = rollouts()
    pos, ref = r.pos.clone(), r.ref_pos.clone()
    pos[..., 2] -= 0.010
    ref[..., 2] += 0.015
    ref[:, :, :, 1] += 0.1 * torch.arange(12).view(1, 12, 1) / 30.0
    card = score_rollouts(replace(r, pos=pos, ref_pos=ref))
    assert card.penetration_mm == pytest.approx(10.0) and card.float_mm == pytest.approx(0.0)
    assert card.reference["float_mm"] == pytest.approx(15.0)
    assert card.reference["penetration_mm"] == pytest.approx(0.0)
    assert card.reference["foot_slide_mm_per_s"] == pytest.approx(100.0)


def test_a_failed_episode_counts_until_it_fails():
    r = rollouts()
    pos = r.pos.clone()
    pos[1, 2:, :, 0] += 0.6  # 0.7 m off from its frame 2, one second into the clip
    card = score_rollouts(replace(r, pos=pos))
    assert card.succ == 0.5 and card.frames == 13
    assert card.mpjpe_global_mm == pytest.approx((10 * 10 + 2 * 100 + 700) / 13)
    assert card.mpjpe_succ_mm == pytest.approx(10.0)
    walk, run = card.per_clip
    assert (walk["clip"], walk["succ"], walk["first_fail_s"]) == ("walk", 0.0, pytest.approx(32 / 30))
    assert (run["clip"], run["succ"]) == ("run", 1.0) and math.isnan(run["first_fail_s"])
    strict = score_rollouts(replace(r, pos=pos), rule="any_25cm")
    assert strict.succ_rule == "any_25cm"
    # Over all frames the one after the failure counts too, and the table says so.
    uncut = (10 * 10 + 2 * 100 + 2 * 700) / 14
    assert card.variants["uncut_frame"]["mpjpe_global_mm"] == pytest.approx(uncut)
    shown = {row[0]: row[1] for row in table(card)}
    assert shown["Joint error, global, all frames"] == pytest.approx(uncut)


def test_perturbed_starts_have_a_spread():
    r = rollouts()
    exact = score_rollouts(r)
    assert (exact.starts, exact.spread) == (1, {})
    pos = r.pos.clone()
    pos[1, 2:, :, 0] += 0.6
    card = score_rollouts(replace(r, pos=pos, trial=torch.tensor([0, 1])))
    assert card.starts == 2 and card.succ == 0.5
    # One start succeeds and the other one fails; 10 mm and a mean of 300 mm.
    assert card.spread["succ"] == pytest.approx(0.5**0.5)
    assert card.spread["mpjpe_global_mm"] == pytest.approx((300 - 10) / 2**0.5)
    assert "Success, spread over 2 starts" in [row[0] for row in table(card)]
    beside = replace(card, nothing={"succ": 0.25})
    assert ("Success, doing nothing", 25.0, "%", "") in table(beside)


def test_an_episode_that_stops_early_does_not_succeed():
    card = score_rollouts(rollouts(reached_end=torch.tensor([True, False])))
    assert card.succ == 0.5
    assert card.per_clip[0]["first_fail_s"] == pytest.approx(33 / 30)


def test_a_state_that_blows_up_fails_and_spoils_no_mean():
    r = rollouts()
    pos = r.pos.clone()
    pos[0, 5:] = torch.nan
    card = score_rollouts(replace(r, pos=pos))
    assert card.succ == 0.5 and card.frames == 5 + 4
    assert card.mpjpe_global_mm == pytest.approx((5 * 10 + 4 * 100) / 9)


def test_episodes_stopped_by_alive_are_read_until_then():
    r = rollouts()
    alive = r.alive.clone()
    alive[0, 6:] = False
    ref = r.ref_pos.clone()
    ref[0, 6:] = torch.nan
    card = score_rollouts(replace(r, alive=alive, ref_pos=ref, reached_end=torch.tensor([False, True])))
    assert card.succ == 0.5 and card.frames == 6 + 4
    assert card.per_clip[1]["first_fail_s"] == pytest.approx(5 / 30)


def test_no_help_is_exactly_zero_and_help_is_audited():
    free = score_rollouts(rollouts()).help
    assert (free.force_mean_n, free.force_p95_n, free.work_j_per_s, free.share_of_body_weight) == (
        0,
    ) * 4
    r = rollouts()
    force = torch.full_like(r.force, torch.nan)
    force[r.alive] = torch.tensor([[0.0, 0.0, 49.05]]).double()
    vel = torch.full_like(force, 2.0)
    card = score_rollouts(replace(r, force=force, point_vel=vel))
    assert card.help.force_mean_n == pytest.approx(49.05)
    assert card.help.share_of_body_weight == pytest.approx(0.1)
    assert card.help.work_j_per_s == pytest.approx(98.1)
    assert card.help.limit_n == 100.0 and card.per_clip[0]["force_mean_n"] == pytest.approx(49.05)


def test_json_round_trip_is_finite_and_exact(tmp_path):
    card = score_rollouts(rollouts(shapes=None), seed=7, seconds=12.5, samples=1000, method="perpetual")
    path = write_score(card, tmp_path / "run" / "score.json")
    text = path.read_text()
    assert "NaN" not in text and "Infinity" not in text
    raw = json.loads(text)
    assert raw["foot_slide_mm_per_s"] is None and raw["help"]["limit_nm"] is None
    back = read_score(path)
    assert back.to_dict() == card.to_dict() and back.help.limit_nm == math.inf
    assert math.isnan(back.float_mm) and back.per_clip[0]["clip"] == "walk"
    assert [p.name for p in path.parent.iterdir()] == ["score.json"]
    write_score(replace(card, seed=8), path)
    assert read_score(path).seed == 8


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = write_score(score_rollouts(rollouts()), tmp_path / "score.json")
    before = path.read_text()
    with pytest.raises(TypeError):
        write_score(replace(score_rollouts(rollouts()), clip=object()), path)  # type: ignore[arg-type]
    assert path.read_text() == before and len(list(tmp_path.iterdir())) == 1


def test_bad_files_are_told(tmp_path):
    path = tmp_path / "score.json"
    with refused("file-unreadable", says="score.json"):
        read_score(path)
    path.write_text('{\n "succ": 1,\n oops}')
    with refused("bad-json"):
        read_score(path)
    path.write_text('{"succ": 1}')
    with refused("key-missing", says="succ_rule"):
        read_score(path)
    path.write_text("[]")
    with refused("not-a-score-card"):
        read_score(path)


def test_bad_rollouts_are_told():
    r = rollouts()
    with refused("wrong-shape", says=("quat", "(2, 12, 1, 4)")):
        rollouts(quat=r.quat[:, :, :1])
    with refused("key-missing", says="['pose']"):
        rollouts(reward={"pose": torch.ones(2, 12)})
    with refused("wrong-shape", says="reward['total']"):
        rollouts(reward={"total": torch.ones(2, 11)})
    with refused("index-outside", says=("0", "1")):
        rollouts(clip_names=("walk",))
    with refused("out-of-range", says=("fps", "0")):
        rollouts(fps=0.0)
    with refused("unknown-choice", says=("clip", "weighting")):
        score_rollouts(r, weighting="clip")  # type: ignore[arg-type]


def test_random_rollouts_equal_a_naive_loop():
    g = torch.Generator().manual_seed(11)
    r = rollouts()
    episodes, frames, bodies = 5, 9, 3
    ref = torch.randn(episodes, frames, bodies, 3, generator=g, dtype=torch.float64)
    pos = ref + 0.2 * torch.randn(episodes, frames, bodies, 3, generator=g, dtype=torch.float64)
    lengths = torch.tensor([9, 3, 1, 7, 5])
    quat = torch.tensor([1.0, 0, 0, 0]).double().expand(episodes, frames, bodies, 4)
    wrench = torch.randn(episodes, frames, 2, 3, generator=g, dtype=torch.float64)
    big = replace(
        r, pos=pos, ref_pos=ref, quat=quat, ref_quat=quat, lengths=lengths,
        alive=torch.arange(frames) < lengths[:, None], reached_end=torch.ones(episodes).bool(),
        force=wrench, torque=wrench, point_vel=wrench, ang_vel=wrench, reward={},
        clip=torch.tensor([0, 0, 1, 1, 1]), start=torch.zeros(episodes).long(), shapes=None,
    )  # fmt: skip
    errors, forces, won = [], [], 0
    for e in range(episodes):
        failed = False
        for t in range(int(lengths[e])):
            d = [float((pos[e, t, b] - ref[e, t, b]).norm()) for b in range(bodies)]
            errors.append(1000 * sum(d) / bodies)
            forces.append(sum(float(wrench[e, t, m].norm()) for m in range(2)))
            if max(d) > 0.5:
                failed = True
                break
        won += not failed
    card = score_rollouts(big, rule="phc_strict")
    assert card.succ == won / episodes and 0 < won < episodes
    assert card.frames == len(errors)
    assert card.mpjpe_global_mm == pytest.approx(sum(errors) / len(errors))
    assert card.help.force_mean_n == pytest.approx(sum(forces) / len(forces))
    assert math.isnan(card.reward["total"])


def test_parts_of_an_evaluation_score_as_the_whole():
    whole = rollouts(force=torch.rand(2, 12, 1, 3, generator=torch.Generator().manual_seed(0)))
    parts = []
    for k in (1, 0):
        # Another part may be padded otherwise.
        frames = int(whole.lengths[k])
        cut = {
            name: getattr(whole, name)[k : k + 1, :frames]
            for name in ("pos", "quat", "ref_pos", "ref_quat", "alive", "force", "torque", "point_vel")
        }
        cut["ang_vel"] = whole.ang_vel[k : k + 1, :frames]
        rows = {n: getattr(whole, n)[k : k + 1] for n in ("lengths", "reached_end", "clip", "start")}
        reward = {n: v[k : k + 1, :frames] for n, v in whole.reward.items()}
        parts.append(replace(whole, **cut, **rows, reward=reward))
    one, other = (score_rollouts(x).to_dict() for x in (whole, iter(parts)))

    def same(a, b):
        if isinstance(a, dict):
            return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
        if isinstance(a, list):
            return len(a) == len(b) and all(map(same, a, b))
        return a == (pytest.approx(b) if isinstance(b, float) else b)

    assert same(one, other)
    with refused("no-rollouts"):
        score_rollouts([])


def with_head(frames: int = 60, **changes):
    """Two episodes of root, foot and head that stand, the second begins at frame 30."""
    ref = torch.zeros(2, frames, 3, 3, dtype=torch.float64)
    ref[..., 2] = torch.tensor([0.9, BALL, 1.6])
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(2, frames, 3, 4)
    zero = torch.zeros(2, frames, 1, 3, dtype=torch.float64)
    return rollouts(
        pos=changes.pop("pos", ref.clone()), quat=quat, ref_pos=ref, ref_quat=quat,
        alive=torch.ones(2, frames, dtype=torch.bool), lengths=torch.tensor([frames, frames]),
        force=zero, torque=zero, point_vel=zero, ang_vel=zero, reward={}, head=2, **changes,
    )  # fmt: skip


def test_survived_is_not_tracked():
    assert score_rollouts(with_head()).tracked == 1.0
    assert math.isnan(score_rollouts(rollouts()).tracked)
    pos = with_head().ref_pos.clone()
    # Down from frame 20 on, its bodies 0.43 m off on average.
    pos[0, 20:, 0, 2], pos[0, 20:, 2, 2] = 0.5, 0.7
    card = score_rollouts(with_head(pos=pos))
    assert (card.succ, card.tracked, card.survived) == (1.0, 0.5, True)
    fallen, other = sorted(card.per_clip, key=lambda c: c["tracked"])
    assert (fallen["tracked"], fallen["fallen_s"]) == (0.0, pytest.approx(20 / 30))
    assert other["tracked"] == 1.0 and math.isnan(other["fallen_s"]) and math.isnan(fallen["off_feet_s"])
    # A stumble of 0.4 s is none; a second in the air is.
    pos = with_head().ref_pos.clone()
    pos[0, 20:32, 2, 2] = 0.7
    pos[1, 10:40, 1, 2] += 0.2
    card = score_rollouts(with_head(pos=pos))
    assert (card.succ, card.tracked) == (1.0, 0.5)
    (off,) = [c for c in card.per_clip if c["tracked"] == 0.0]
    # Seconds of the clip: this episode begins at its frame 30.
    assert off["off_feet_s"] == pytest.approx(40 / 30) and math.isnan(off["fallen_s"])


def test_what_is_lost_is_not_tracked_and_parts_are_the_whole():
    pos = with_head().ref_pos.clone()
    pos[1, 30:, :, 0] += 2.0
    made = with_head(pos=pos)
    card = score_rollouts(made)
    assert (card.succ, card.tracked, card.survived) == (0.5, 0.5, False)
    again = score_rollouts(iter([made]))
    assert again.tracked == card.tracked
    label, value, unit, verdict = table(card)[1]
    assert (label, value, unit, verdict) == ("Tracked", 50.0, "%", "poor")


def test_a_card_without_the_new_keys_is_read(tmp_path):
    path = write_score(score_rollouts(with_head()), tmp_path / "score.json")
    old = json.loads(path.read_text())
    del old["tracked"], old["needs"]
    path.write_text(json.dumps(old))
    card = read_score(path)
    assert math.isnan(card.tracked) and card.needs == () and not card.survived
    assert "Tracked" not in [row[0] for row in table(card)]
