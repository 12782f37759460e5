"""One policy for bodies of many shapes: what differs between worlds; a training of it resumes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.body import make_humanoid
from poise.env import observations as obs
from poise.env.events import BodyAssignment
from poise.env.reference import differing
from poise.formats import read_clip
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.kinematics import Kinematics, retarget
from poise.learn import LATEST, Until, load_checkpoint
from poise.motion import ClipLibrary, resample
from poise.recipes.body_shapes import GROUPS, BodyShapes, scaled_skeleton, scaled_table, shaped
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build, task
from poise.recipes.perpetual_settings import Perpetual
from poise.sim import CpuBackend, alone
from refusals import refused
from toy_library import library, tiny

SHAPES = BodyShapes(count=3, seed=2)
CONFIG = tiny(max_primitives=1, expert=False, style=None, shape=True)


def make(shapes: BodyShapes = SHAPES, config: Perpetual = CONFIG) -> Imitation:
    return shaped(build(library(), config), shapes, lambda body: task(config, body))


@pytest.fixture(scope="module")
def imitation() -> Imitation:
    return make()


def test_parts_are_scaled_as_drawn_and_masses_with_the_cube(imitation: Imitation) -> None:
    first, *others = imitation.reference.bodies
    sizes = SHAPES.factors()
    assert sizes.shape == (3, len(GROUPS)) and (sizes[0] == 1).all()
    assert sizes.min() >= 0.85 and sizes.max() <= 1.15
    for body, own in zip(others, sizes[1:], strict=True):
        thigh, shin = (first.table.index(n) for n in ("LeftUpLeg", "LeftLeg"))
        a, b = first.model, body.model
        # The shin hangs at the end of the thigh, the foot at the end of the shin.
        foot = first.table.index("LeftFoot")
        for row, size in ((shin, own[3]), (foot, own[4])):
            np.testing.assert_allclose(b.body_pos[row + 1], a.body_pos[row + 1] * size, rtol=1e-12)
        for row, size in ((thigh, own[3]), (shin, own[4])):
            assert b.body_mass[row + 1] == pytest.approx(a.body_mass[row + 1] * size**3)
            # One shape of one density at another size: inertia goes with the fifth power.
            np.testing.assert_allclose(
                b.body_inertia[row + 1], a.body_inertia[row + 1] * size**5, rtol=1e-6
            )
        # m g L: all torques by one factor; within an adult's heights that of the mass.
        most = b.actuator_forcerange[:, 1] / a.actuator_forcerange[:, 1]
        np.testing.assert_allclose(most, most[0])
        if 1.55 <= body.table.height_m <= 1.8:
            assert most[0] == pytest.approx(body.mass / first.mass)


def test_the_skeleton_has_the_bones_of_the_body(imitation: Imitation) -> None:
    base = imitation.humanoid
    sizes = (0.9, 1.1, 1.0, 0.85, 1.15)
    skeleton = scaled_skeleton(base.skeleton, base.table, sizes)
    table = scaled_table(base.table, sizes)
    for row in table.rows[1:]:
        have = np.linalg.norm(skeleton.offsets[row.joint])
        assert have == pytest.approx(np.linalg.norm(row.pos))
    assert scaled_table(base.table, np.ones(len(GROUPS))) == base.table
    # The tip of the head belongs to the trunk's group.
    assert skeleton.ends[0][1][2] == pytest.approx(0.9 * base.skeleton.ends[0][1][2])


def test_each_world_is_the_body_of_its_clip(imitation: Imitation) -> None:
    """A world of the batch against a simulation of that body alone, step by step."""
    env = imitation.env(6, threads=1, auto_reset=False, help_scale=0.0)
    clip = torch.tensor([8, 1, 4, 0, 7, 3])
    env.reset_to(clip, torch.zeros_like(clip))
    body, rng = imitation.reference.body[clip], torch.Generator().manual_seed(0)
    actions = 0.3 * torch.randn(10, 6, env.num_actions, generator=rng)
    kept = []
    for action in actions:
        env.step(action)
        kept.append((env.backend.state.qpos.clone(), env.backend.drive.ctrl.clone()))
    for i in range(6):
        single = CpuBackend(alone(imitation.reference.bodies[int(body[i])]), 1, 1)
        single.write(
            None, *imitation.reference.coordinates(clip[i : i + 1], torch.zeros(1, dtype=torch.long))
        )
        for qpos, ctrl in kept:
            single.drive.clear()
            single.drive.ctrl.copy_(ctrl[i : i + 1])
            single.step(env.substeps)
            # The solver's stopping rule knows the first body's mean inertia alone.
            torch.testing.assert_close(single.state.qpos[0], qpos[i], rtol=1e-6, atol=1e-6)
        total = env.backend.get_model(i).body_mass.sum()
        assert total == pytest.approx(imitation.reference.bodies[int(body[i])].mass)
        single.close()
    env.close()


def test_references_stand_on_the_floor_of_their_bodies(imitation: Imitation) -> None:
    r = imitation.reference
    for k, humanoid in enumerate(r.bodies):
        rows = torch.cat([torch.arange(s, s + n) for s, n, b in zip(
            r.start.tolist(), r.length.tolist(), r.body.tolist(), strict=True) if b == k])  # fmt: skip
        pos = Kinematics(humanoid.table)(r.qpos[rows]).pos
        torch.testing.assert_close(r.pose.pos[rows], pos.float())
        feet = pos[:, list(humanoid.feet), 2].min(1).values
        base = r.pose.pos[: int(r.length[0]), list(humanoid.feet), 2].min()
        # Ankles of larger feet stand higher, by as much as the feet are larger.
        assert abs(float(feet.min()) - float(base)) < 0.02
    low, high = r.bodies[0].model.jnt_range[1:].T
    assert bool((r.qpos[:, 7:].numpy() >= low - 1e-9).all())
    assert bool((r.qpos[:, 7:].numpy() <= high + 1e-9).all())


def test_the_observation_tells_the_bodies_apart(imitation: Imitation) -> None:
    env = imitation.env(9, threads=1, auto_reset=False)
    at = obs.self_state(env.view()).shape[1]
    width = 2 * len(imitation.humanoid.bodies) - 1
    clip = torch.arange(9)
    seen = env.reset_to(clip, torch.zeros_like(clip))[:, at : at + width]
    for row, k in zip(seen, imitation.reference.body.tolist(), strict=True):
        assert torch.equal(row, obs.shape_of(imitation.reference.bodies[k]))
    assert len({tuple(row.tolist()) for row in seen}) == 3
    # Also in what a step gives, through the recorded terms.
    after = env.step(torch.zeros(9, env.num_actions)).final_obs[:, at : at + width]
    assert torch.equal(after, seen)
    env.close()


def test_worlds_change_bodies_when_episodes_begin(imitation: Imitation) -> None:
    env = imitation.env(16, threads=1)
    env.reset()
    worn = set()
    for _ in range(60):
        env.step(torch.zeros(16, env.num_actions))
        body = imitation.reference.body[env.clip]
        worn |= set(body.tolist())
        bodies = env.event(BodyAssignment)
        assert bodies is not None and torch.equal(bodies.body, body)
        mass = env.backend.expand("body_mass").sum(1)
        own = torch.tensor([h.mass for h in imitation.reference.bodies], dtype=torch.float64)
        torch.testing.assert_close(mass, own[body])
    assert worn == {0, 1, 2}
    env.close()


def test_an_environment_goes_on_from_its_state_bit_for_bit(imitation: Imitation) -> None:
    rng = torch.Generator().manual_seed(3)
    one, other = imitation.env(8, threads=1), imitation.env(8, seed=9, threads=1)
    one.reset(), other.reset()
    actions = 0.2 * torch.randn(30, 8, one.num_actions, generator=rng)
    for a in actions[:10]:
        one.step(a)
    other.load_state(one.state())
    for a in actions[10:]:
        x, y = one.step(a), other.step(a)
        assert torch.equal(x.obs, y.obs) and torch.equal(x.reward, y.reward)
    one.close(), other.close()


def trained(folder: Path, imitation: Imitation, *stops: int) -> dict[str, torch.Tensor]:
    """The last checkpoint of a training that was stopped and resumed."""
    folder.mkdir()
    for stop in stops:
        course = StageTrainer(imitation, folder, Until(iterations=6), 1, tensorboard=False, save_s=0.0)
        while course.iteration < stop and not course.finished:
            course.iterate()
        course.save()
        course.close()
    return load_checkpoint(folder / LATEST)[0]


def test_a_training_resumes_bit_for_bit(imitation: Imitation, tmp_path: Path) -> None:
    whole = trained(tmp_path / "whole", imitation, 6)
    parts = trained(tmp_path / "parts", imitation, 3, 6)
    assert set(whole) == set(parts)
    for name, value in whole.items():
        if name == "trainer/counters":
            # Iterations, samples, seconds, and means: the seconds are the machine's.
            value, parts[name] = value[[0, 1, 3, 4, 5]], parts[name][[0, 1, 3, 4, 5]]
        assert torch.equal(value, parts[name]), name
    policy = imitation.trainer(threads=1)
    results = evaluate_clips(imitation, policy.policy(), threads=1)
    policy.env.close()
    assert len(results.clip) == 9 and results.frames.tolist() == imitation.reference.length.tolist()


def test_the_expert_knows_the_body(imitation: Imitation) -> None:
    """Inverse dynamics of a clip on body k are those of that body alone."""
    from poise.env import Reference
    from poise.plan import make_plan

    r, c = imitation.reference, 4
    plan, body = make_plan(r), r.bodies[int(r.body[c])]
    own = r.qpos[int(r.start[c]) : int(r.start[c] + r.length[c])].numpy()
    own_plan = make_plan(Reference(body, [own], r.rate_hz, ["own"]))
    rows = slice(int(r.start[c]), int(r.start[c] + r.length[c]))
    torch.testing.assert_close(plan.torque[rows], own_plan.torque)


def test_each_clip_on_some_bodies_only() -> None:
    few = BodyShapes(count=8, per_clip=3, seed=1)
    picks = few.bodies_of(40)
    assert all(len(p) == 3 and p[0] == 0 and list(p) == sorted(set(p)) for p in picks)
    assert {k for p in picks for k in p} == set(range(8)) and picks == few.bodies_of(40)
    made = make(BodyShapes(count=3, per_clip=2, seed=4))
    assert len(made.library) == 6 == len(made.reference.length)
    assert made.library.names == made.reference.names


def test_one_body_changes_nothing() -> None:
    plain = build(library(), CONFIG)
    assert shaped(plain, BodyShapes(), lambda body: task(CONFIG, body)) is plain


def test_a_policy_for_shapes_also_takes_the_observation_of_one(imitation: Imitation) -> None:
    single = build(library(), CONFIG).env(1, threads=1)
    several = imitation.env(1, threads=1)
    assert single.num_obs == several.num_obs
    single.close(), several.close()


def test_real_clips_stand_where_they_stood(data_dir: Path) -> None:
    names = ("walk", "kick")
    clips = [read_clip(data_dir / f"deepmimic_txt/humanoid3d_{n}.txt") for n in names]
    base = build(ClipLibrary.of(clips), CONFIG).humanoid
    there = scaled_skeleton(base.skeleton, base.table, (1.0, 1.0, 1.0, 0.85, 1.15))
    for clip in clips:
        target = clips[0].replaced(skeleton=there)
        _, report = retarget(clip, target, example=clips[0])
        assert report.slide_mm_s[1] == pytest.approx(report.slide_mm_s[0], abs=1.0)
        assert report.direction_deg < 2.5


def test_bad_settings_and_bodies(imitation: Imitation) -> None:
    with refused("out-of-range", says="count"):
        BodyShapes(count=0)
    with refused("not-rising"):
        BodyShapes(low=1.2, high=1.1)
    with refused("out-of-range", says=("3", "4")):
        BodyShapes(count=3, per_clip=4)
    blind = replace(CONFIG, shape=False)
    with refused("settings-conflict"):
        make(config=blind)
    base = imitation.humanoid
    fewer = replace(base.table, contact_exclusions=())
    with refused("bodies-differ"):
        differing([base.model, make_humanoid(base.skeleton, fewer).model])


def test_clips_stand_on_bodies_of_their_own_bones(tmp_path: Path) -> None:
    base = library()
    clips, first = list(base.clips), base.clips[0].skeleton
    longer = replace(first, offsets=first.offsets * 1.1)
    # Two millimetres are the same body.
    nearly = replace(first, offsets=first.offsets * 1.1 + 0.001)
    clips[1] = clips[1].replaced(skeleton=longer, root_pos=clips[1].root_pos * 1.1)
    clips[2] = clips[2].replaced(skeleton=nearly, root_pos=clips[2].root_pos * 1.1)
    config = replace(CONFIG, shape=False, shapes=BodyShapes(own=True))
    made = build(ClipLibrary.of(clips), config)
    reference = made.reference
    assert reference.body.tolist()[:3] == [0, 1, 1] and len(reference.bodies) == 2
    small, large = reference.bodies
    assert (small.bodies, small.hinges) == (large.bodies, large.hinges)
    assert large.table.height_m == pytest.approx(1.1 * small.table.height_m)
    assert made.library.names == base.names
    # The motion is that of the clip, not a retargeted one.
    at = int(reference.length[0])
    q = reference.qpos[at : at + int(reference.length[1])].numpy()
    pos = Kinematics(large.table)(torch.tensor(q)).pos[:, large.table.index("LeftFoot")].numpy()
    joint = clips[1].skeleton.index("LeftFoot")
    wanted = resample(clips[1], reference.rate_hz).positions()[:, joint]
    assert np.ptp(np.linalg.norm((pos - wanted)[:, :2], axis=-1)) < 0.02
    env = made.env(3, threads=1, auto_reset=False)
    env.reset_to(torch.arange(3), torch.zeros(3, dtype=torch.long))
    assert env.backend.get_model(1).body_mass.sum() == pytest.approx(large.mass)
    env.close()
    with refused("settings-conflict"):
        BodyShapes(count=2, own=True)
