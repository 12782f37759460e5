"""The structure of the source: no import cycle, also not inside functions; what nothing in it uses has a
reason to be there; worlds and clips are no persons."""

from __future__ import annotations

import pytest
import structure

from poise import __file__ as package

#: Public names that nothing in `src` reaches, and why they stand there.
EXPLAINED = {
    "twins in tests and benchmarks": (
        "control/pd.py:stable_pd_torque", "sim/backend.py:body_angular_velocity_w",
        "sim/backend.py:body_linear_velocity_w", "sim/backend.py:body_com_velocity_w",
        "metrics/plausibility.py:uhc_skate", "metrics/plausibility.py:uhc_penetration",
        "metrics/plausibility.py:physdiff_penetrate", "metrics/plausibility.py:physdiff_float",
        "metrics/tracking.py:mpjpe_pa",
    ),
    "figures of the benchmarks": (
        
        "jobs/track/noise.py:robustness", "jobs/track/noise.py:write_robustness",
    ),
    "analytic inverse kinematics, which keyframes will need": (
        "kin/ik/analytic.py:clip_ik",
        "kin/ik/polish.py:polish", "kin/limbs.py:two_bone",
    ),
    "for users of the library": (
        "jobs/imitate.py:imitate", "eval/card.py:read_score", "env/gym.py:GymVectorEnv",
        "env/gym.py:GymEnv", "env/rsl_rl.py:RslRlVecEnv", "env/goals/displaced.py:DisplacedGoal",
        "env/goals/generator.py:GeneratorGoal", "env/goals/stream.py:StreamGoal",
        "motion/io/numpy/smpl_write.py:smpl_skeleton", "sim/worlds.py:add_contact_sensors",
        "sim/guard.py:replay_dump",
    ),
    "called by the libraries that they belong to": (
        "env/gym.py:GymVectorEnv.close_extras", "motion/io/numpy/pickles.py:_Machine.find_class",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found() -> dict:
    return structure.structure(structure.Path(package).parent)


def test_no_module_imports_itself_over_others(found: dict) -> None:
    assert found["cycles_at_the_top"] == [] and found["cycles"] == []


def test_what_nothing_uses_is_explained(found: dict) -> None:
    unused = {name for names in found["unused"].values() for name in names}
    explained = [name for names in EXPLAINED.values() for name in names]
    assert sorted(unused - set(explained)) == []
    # What is used again needs no reason any more.
    assert sorted(set(explained) - unused) == []


def test_worlds_and_clips_are_no_persons(found: dict) -> None:
    assert found["who_whose"] == 0, found["persons"]
