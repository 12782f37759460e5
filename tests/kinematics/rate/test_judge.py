"""The frame rate is judged by known physics, and of real clips."""

from __future__ import annotations

import numpy as np
import pytest
from walker import hops, in_place, leap, played, walk

from poise.formats import read_clip
from poise.kinematics import examine, find_faults, find_guesses, fit_humanoid
from poise.kinematics.rate import RateJudgement, Reason, judge_rate
from poise.motion import Clip
from toy_human import swing

MOTIONS = {"walk": walk, "hops": hops, "leap": leap}


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
@pytest.mark.parametrize("name", MOTIONS)
def test_what_is_right_is_not_named_and_what_is_doubled_is(name: str, fps: float) -> None:
    clip = MOTIONS[name](fps)
    assert judge_rate(clip).likely is None
    judged = judge_rate(played(clip, 2.0))
    assert judged.likely == fps
    kinds = {"walk": {"gait"}, "hops": {"fall"}, "leap": {"fall"}}[name]
    assert kinds <= {r.kind for r in judged.reasons}
    said = judged.sentence()
    assert said is not None and said.endswith(f"state it with --fps {fps:g}.")
    assert f"likely has {fps:g} frames per second, not {2 * fps:g}" in said


def test_a_leap_tells_slow_motion_and_vouches_for_the_right_rate() -> None:
    assert judge_rate(leap()).vouched and not judge_rate(walk()).vouched
    for times, rate in ((0.5, 120.0), (0.25, 120.0), (4.0, 120.0), (0.8, None)):
        assert judge_rate(played(leap(), times)).likely == rate
    said = judge_rate(played(leap(), 0.5)).sentence() or ""
    assert said.startswith("In flight the body falls with 2.5 m/s^2, 0.25 times gravity, too slow")
    assert "4 times gravity, too fast" in (judge_rate(played(leap(), 2.0)).sentence() or "")
    # No other evidence tells that a motion is too slow.
    assert judge_rate(played(walk(), 0.5)).likely is judge_rate(played(hops(), 0.5)).likely is None


def test_a_quarter_is_told_only_where_the_half_is_wrong_too() -> None:
    slow = walk(step=0.5, seconds=0.6)
    assert judge_rate(played(slow, 4.0)).likely == 120.0
    half = judge_rate(played(slow, 2.0))
    assert half.likely == 120.0 and {r.kind for r in half.reasons} == {"balance", "gait"}


def test_motion_in_place_is_not_judged_as_if_it_travelled() -> None:
    assert judge_rate(in_place(walk())).likely is None
    assert judge_rate(played(in_place(walk()), 2.0)).likely is None


def test_noise_is_no_speed() -> None:
    clip = walk(60.0)
    noise = np.random.default_rng(0).normal(0.0, 0.02, clip.root_pos.shape)
    assert judge_rate(clip.replaced(root_pos=clip.root_pos + noise)).likely is None


def test_a_rest_frame_that_jumps_is_no_fall() -> None:
    clip = walk(60.0)
    path = clip.root_pos.copy()
    path[:3] += (3.0, 1.0, 1.2)
    assert judge_rate(clip.replaced(root_pos=path)).likely is None
    for fps in (30.0, 120.0):
        still = played(walk(fps), 0.2)
        path = still.root_pos.copy()
        path[30:75] += (0.0, 0.0, 0.6)
        assert judge_rate(still.replaced(root_pos=path, fps=fps)).likely is None


def test_too_few_frames_and_no_human_are_not_judged() -> None:
    clip = played(leap(30.0), 2.0)
    part = clip.replaced(root_pos=clip.root_pos[25:40], rot=clip.rot[25:40])
    assert judge_rate(part) == RateJudgement(60.0)
    assert judge_rate(swing(2.0, 60.0)).likely is None


def test_hints_are_clear_together() -> None:
    judged = RateJudgement(120.0, 60.0, (Reason("fall", 0.5, "one"), Reason("gait", 0.5, "two")))
    assert judged.why() == "one, and two"
    assert (judged.sentence() or "").startswith("One, and two: the clip likely has 60")


def test_every_examination_tells_it() -> None:
    clip = played(walk(60.0, step=0.5, seconds=0.6), 2.0)
    (fault,) = [f for f in examine(clip).faults if f.kind == "frame rate"]
    assert (
        fault.size == 60.0 and "--fps 60" in fault.detail and "beyond all that touches" in fault.detail
    )
    (told,) = [g for g in find_guesses(clip) if g.what == "fps"]
    assert told.override == "--fps 60" and "likely it has 60 frames per second" in told.evidence
    found = find_faults(clip)
    assert found is not None and found.numbers["likely_fps"] == 60.0
    assert "state it with --fps 60" in found.sentences[0]
    *_, report = fit_humanoid(clip)
    assert "state it with --fps 60" in report.sentences()[0]
    assert report.to_dict()["clips"]["walk"]["likely_fps"] == 60.0


def real(data_dir, name: str, fps: float | None = None) -> Clip:
    skeleton = data_dir / "cmu_amc/rfc/08.asf" if "/rfc/" in name else None
    clip = read_clip(data_dir / name, skeleton=skeleton)
    return clip.replaced(fps=fps or clip.fps)


@pytest.mark.parametrize(
    ("name", "stated", "rate"),
    [
        ("cmu_amc/rfc/90_08.amc", 120.0, 60.0),
        ("cmu_amc/rfc/90_11.amc", 120.0, 60.0),
        ("cmu_amc/rfc/90_05.amc", 120.0, None),
        ("cmu_amc/rfc/05_06.amc", 120.0, None),
        ("cmu_amc/rfc/90_05.amc", 60.0, 120.0),
        ("cmu_amc/rfc/90_05.amc", 30.0, 120.0),
        ("cmu_amc/rfc/90_08.amc", 60.0, None),
        ("cmu_amc/02/02_04.amc", 60.0, 120.0),
        ("cmu_amc/02/02_04.amc", 240.0, 120.0),
        ("cmu_amc/02/02_03.amc", 240.0, 120.0),
        ("cmu_amc/02/02_01.amc", 240.0, 120.0),
        ("cmu_amc/07/07_11.amc", None, None),
        ("cmu_amc/39/39_01.amc", 240.0, 120.0),
        ("cmu_bvh/acrnn_salsa/01.bvh", None, 60.0),
        ("cmu_bvh/acrnn_salsa/01.bvh", 60.0, None),
        ("cmu_bvh/acrnn_indian/07.bvh", None, None),
        ("other/bandai_bvh/dataset-1_run_normal_001.bvh", 60.0, 30.0),
        ("other/bandai_bvh/dataset-1_walk_normal_001.bvh", 60.0, 30.0),
        ("deepmimic_txt/humanoid3d_cartwheel.txt", None, None),
        ("deepmimic_txt/humanoid3d_backflip.txt", 32.0, 16.0),
    ],
)
def test_the_rate_of_real_clips(data_dir, name: str, stated: float | None, rate: float | None) -> None:
    assert judge_rate(real(data_dir, name, stated)).likely == rate
