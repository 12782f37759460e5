"""The residual force recipe: what each setting switches, and runs that can be reopened."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from poise.body import BodyConfig
from poise.control import ExplicitResidual, ImplicitResidual, SuccessHelp
from poise.env import rewards as reward
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.runs import begin, evaluate
from poise.kinematics import without_noise
from poise.learn import load_checkpoint, save_checkpoint
from poise.motion import ClipLibrary
from poise.recipes import RECIPE, ResidualForce, build
from poise.recipes.residual_force import schedule, task
from poise.recipes.residual_force_settings import config_of, most_help
from poise.score import Nothing, run_episodes, start_frames
from poise.sim.scene import write_mjcf
from refusals import refused
from toy_human import swing, trembling

#: A setting, a value, and the term that this value brings in and that is not there by default.
SETTINGS = [
    ("reward", "local", "root_pose"),
    ("done", "height", "root_too_low"),
]


def names(terms) -> list[str]:
    return [t.name for t in terms]


@pytest.fixture(scope="module")
def built():
    return build(swing(), ResidualForce(num_envs=2))


def test_the_default_is_the_papers_reward_with_implicit_help(built):
    task = built.task
    assert isinstance(task.residual, ImplicitResidual) and task.residual.limit_n == 100.0
    weights = {t.name: t.weight for t in task.rewards}
    assert weights == {
        "pose": 0.3, "velocity": 0.1, "end_effectors": 0.5, "centre_of_mass": 0.1, "residual": 0.1,
    }  # fmt: skip
    # The imitation reward that is reported sums to one at the reference and leaves the help out.
    assert sum(t.weight for t in task.rewards if t.imitation) == pytest.approx(1.0)
    assert names(task.dones) == ["bodies_too_far"] and task.pd.mode == "additive"
    assert RECIPE["config"] is ResidualForce and RECIPE["build"] is build


@pytest.mark.parametrize(("setting", "value", "term"), SETTINGS)
def test_settings_bring_terms_in(built, setting, value, term):
    made = task(ResidualForce(**{setting: value}), built.humanoid)
    before, after = (
        {(type(t), t.name) for t in (*x.obs, *x.rewards, *x.dones)} for x in (built.task, made)
    )
    assert term in [name for _, name in after - before]


def test_where_paper_and_code_differ():
    code = build(swing(), ResidualForce(faithful="code")).task
    weights = {t.name: t.weight for t in code.rewards}
    assert weights["end_effectors"] == 0.45 and weights["residual"] == 0.05
    assert next(t for t in code.rewards if t.fn is reward.pose).params["half"] is True
    local = build(swing(), ResidualForce(reward="local")).task
    weights = {t.name: t.weight for t in local.rewards if t.imitation}
    assert weights == {"pose": 0.5, "end_effectors": 0.3, "root_pose": 0.1, "root_velocity": 0.1}


def test_methods_and_the_papers_own_setting():
    explicit = build(swing(), ResidualForce(method="rfc-explicit", help_start=None, help_limit=40.0))
    assert isinstance(explicit.task.residual, ExplicitResidual)
    assert explicit.task.residual.limit_nm == 40.0 and explicit.task.residual.bodies[0] == 0
    plain = build(swing(), ResidualForce(method="deepmimic"))
    assert plain.task.residual is None and "residual" not in names(plain.task.rewards)
    config = ResidualForce.paper()
    assert (config.observation, config.action, config.done) == ("phase", "absolute", "height")
    faithful = build(swing(), config)
    assert names(faithful.task.dones) == ["root_too_low"] and faithful.task.pd.mode == "absolute"
    assert "target_bodies" not in names(faithful.task.obs)
    assert faithful.model.opt.timestep == pytest.approx(1 / 450)
    env = faithful.env(2)
    assert torch.isfinite(env.step(torch.zeros(2, env.num_actions)).obs).all()
    env.close()


def test_the_papers_help_has_no_cap_and_the_codes_acts_on_all_bodies():
    ours = ResidualForce(method="rfc-explicit", help_limit=100.0, help_start=None)
    few = build(swing(), ours).task.residual
    assert isinstance(few, ExplicitResidual) and few.capped and len(few.bodies) == 3
    made = build(swing(), ResidualForce.code(swing(), method="rfc-explicit"))
    every = made.task.residual
    assert isinstance(every, ExplicitResidual) and not every.capped
    assert every.bodies == tuple(range(len(made.humanoid.bodies)))
    paper = build(swing(), ResidualForce.paper(swing(), method="rfc-explicit", num_envs=2))
    assert paper.task.residual == replace(few, capped=False)
    # A card says that such help had no limit; a limit of 0 is one all the same.
    policy = paper.trainer(threads=1).policy()
    starts = (torch.zeros(2, dtype=torch.long), torch.arange(2))
    assert math.isinf(evaluate(paper, policy, {}, starts=starts).card.help.limit_n)
    assert evaluate(paper, policy, {}, help_limit=0.0, starts=starts).card.help.limit_n == 0.0
    # Runs of earlier versions, which name neither setting, keep what they did.
    old = config_of({"method": "rfc-explicit", "faithful": "paper", "help_limit": 100.0})
    assert old.help_capped and old.help_bodies == "hip and feet"


def test_a_run_folder_rebuilds_the_task(tmp_path):
    config = ResidualForce(num_envs=2, seed=5, body=BodyConfig(overrides=(("thigh.torque", 150.0),)))
    library = ClipLibrary((swing(speed=1.0, cyclic=True, name="walk"), swing(0.5, name="short")))
    first = begin(tmp_path, library, config)
    again = open_run(tmp_path).task
    assert again.config == config and again.library.names == ("walk", "short")
    assert again.humanoid.identity == first.humanoid.identity
    assert torch.equal(again.reference.qpos, first.reference.qpos)
    assert again.reference.cyclic.tolist() == [True, False]
    begin(tmp_path, library, config)  # The same again is no conflict.
    with refused("settings-differ"):
        begin(tmp_path, library, replace(config, seed=6))
    with refused("clips-differ", says="walk, short"):
        begin(tmp_path, ClipLibrary((swing(),)), config)
    with refused("file-missing"):
        _ = open_run(tmp_path / "nowhere").task


def test_evaluation_starts_on_the_reference_and_counts_no_help(built):
    # The clip lasts 1 s: an episode from a later frame would be shorter.
    assert [x.tolist() for x in start_frames(built.reference)] == [[0], [0]]
    clip, start = torch.zeros(3, dtype=torch.long), torch.arange(3)
    env = built.env(1)
    width = env.num_actions
    env.close()
    rollouts, recordings = run_episodes(
        lambda n: built.env(n, auto_reset=False), Nothing(width), clip, start, 100.0
    )
    assert rollouts.lengths.tolist() == [31, 30, 29]
    assert rollouts.alive.sum(1).tolist() == [31, 30, 29]
    torch.testing.assert_close(rollouts.pos[:, 0], rollouts.ref_pos[:, 0], atol=1e-5, rtol=0)
    assert not rollouts.force.any() and not rollouts.torque.any()
    (kept,) = recordings
    assert (kept.clip, kept.start, kept.qpos.shape) == (0, 0, (31, built.reference.qpos.shape[1]))


def test_the_world_is_built_on_the_reference_for_a_real_deepmimic_clip(data_dir):
    # Its joints are not listed depth first: bodies must still be the reference's, row for row.
    task = build(read_clip(data_dir / "deepmimic_txt/humanoid3d_walk.txt"), ResidualForce(num_envs=4))
    env = task.env()
    env.reset()
    sim, ref = env.pose(), env.reference.gather(env.clip, env.frame)
    torch.testing.assert_close(sim.pos, ref.pos, atol=1e-4, rtol=0)
    torch.testing.assert_close(sim.com, ref.com, atol=1e-4, rtol=0)
    env.close()


def test_the_default_takes_the_help_away_and_old_runs_keep_what_they_did():
    plain = ResidualForce()
    assert (plain.help_start, plain.help_limit) == (100.0, 0.0)
    assert most_help(plain) == 100.0 and schedule(plain) == SuccessHelp(final=0.0)
    # What an earlier version left out was 100 N for ever.
    then = config_of({"method": "rfc-explicit"})
    assert (then.help_start, then.help_limit) == (None, 100.0) and schedule(then) is None
    assert config_of({"help_limit": 0.0, "help_start": 100.0}) == plain


def test_what_is_learned_has_no_noise_in_any_joint_and_that_is_judged_once(tmp_path):
    clip = swing(4.0, speed=0.5)
    shaken = trembling(clip)
    calm, noise = without_noise(shaken)
    made = build(shaken, ResidualForce(num_envs=2))
    # Joints without a body ride along in what is delivered: they are those of the calm clip.
    torch.testing.assert_close(torch.tensor(made.library.clips[0].rot), torch.tensor(calm.rot))
    assert made.report.clips[0].clean.noise == noise.noise and noise.noise
    # A body of one's own sees the motion without the noise of the skeleton that came in.
    path = tmp_path / "body.xml"
    write_mjcf(made.humanoid, path)
    there = build(shaken, ResidualForce(num_envs=2, body=BodyConfig(mjcf=str(path))))
    assert there.report.clips[0].clean.noise == noise.noise
    # By the user's word all stays as it is.
    raw = shaken.replaced(skeleton=shaken.skeleton.with_source(raw=True))
    assert build(raw, ResidualForce(num_envs=2)).library.clips[0] is raw
    # That is another run, but for a run of a version that did not know the word.
    folder, library = tmp_path / "run", ClipLibrary.of([shaken])
    begin(folder, library, ResidualForce(num_envs=2))
    with refused("clips-differ"):
        begin(folder, ClipLibrary.of([raw]), ResidualForce(num_envs=2))
    tensors, meta = load_checkpoint(folder / "run.safetensors")
    del meta["clips"][0]["source"]["raw"]
    save_checkpoint(folder / "run.safetensors", tensors, meta)
    begin(folder, ClipLibrary.of([raw]), ResidualForce(num_envs=2))
