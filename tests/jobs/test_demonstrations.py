"""Recovery motions are learned as clips are, the policy stays what it was, and a killed run goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.env.recovery.get_up import CALM, QUICK
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import try_recovery
from poise.jobs.perpetual.perpetual_run import begin, resume, train
from poise.jobs.perpetual.stages import Progress, Stage, demonstrations, odds, practised, staged
from poise.jobs.track import TrackConfig, track
from poise.jobs.track import recovery_run as recovering
from poise.jobs.track.learning import learn
from poise.jobs.tracker import Tracker, load_tracker, save_tracker
from poise.learn import Until, load_policy
from poise.learn.composer import Composer
from poise.papers.perpetual.ablations import StagedPerpetual, going_on
from poise.papers.perpetual.primitive_stages import Owners
from poise.recipes.body_shapes import BodyShapes
from poise.recipes.perpetual import build, standing
from poise.recipes.perpetual_settings import WIDE
from refusals import refused
from toy_human import swing
from toy_library import PLAIN, Scripted, library, lively, tiny

RECOVERY, COMPOSER = Stage("recovery", 2), Stage("composer", 3, mixed=True)


def test_ways_are_clips_of_the_stages_that_recover() -> None:
    made = build(lively(), tiny(recovery=True, **PLAIN))
    assert made.recovery_clips is not None and made.task.recovery is None
    own, recovery_clips = len(made.library), demonstrations(made)
    assert (
        len(recovery_clips.names) == 4 and recovery_clips.qpos.shape[1] == made.reference.qpos.shape[1]
    )
    assert practised(made, Stage("primitive")) is made
    assert practised(made, RECOVERY).reference.names == recovery_clips.names
    both = practised(made, COMPOSER).reference
    assert both.names == (*made.reference.names, *recovery_clips.names)
    # Joined, every clip is what it was, also beyond its end.
    for ref, first in ((made.reference, 0), (recovery_clips, own)):
        clip = torch.arange(len(ref.names)).repeat_interleave(3)
        frame = torch.tensor([0, 5, 10_000]).repeat(len(ref.names))
        assert torch.equal(ref.gather_packed(clip, frame), both.gather_packed(clip + first, frame))
        rows = ref.rows(clip, frame)
        a = ref.follow(rows, clip, frame)[1]
        assert torch.equal(a, both.follow(both.rows(clip + first, frame), clip + first, frame)[1])
    # Of all episodes the share that the settings say are ways, however the library is drawn.
    drawn = odds(made, COMPOSER, torch.tensor([3.0, 1, 0, 0, 0]).double(), both.length)
    assert drawn[own:].sum() == pytest.approx(made.config.recovering.demonstration_share)
    assert drawn[0] == pytest.approx(3 * float(drawn[1])) and not drawn[2:own].any()
    assert {r.when for r in staged(made, COMPOSER).task.rewards} == {"always"}


def test_bodies_of_several_shapes_recover_on_the_first() -> None:
    config = replace(tiny(recovery=True, **PLAIN), shapes=BodyShapes(count=3, per_clip=2))
    made = build(lively(), config)
    assert made.recovery_clips is not None and made.task.recovery is None
    both = practised(made, COMPOSER).reference
    own = len(made.library)
    assert set(both.body[:own].tolist()) == {0, 1, 2} and not both.body[own:].any()
    assert int(made.reference.body[standing(made.reference)[0]]) == 0
    ready = staged(made, Stage("single", 2, mixed=True))
    trainer = ready.trainer(threads=1)
    card = try_recovery(ready, trainer.policy(), 4, threads=1)
    trainer.env.close()
    assert {row.trials for row in card.rows} == {4}


def test_a_library_without_getting_up_comes_back_to_a_point() -> None:
    made = build(library(), tiny(recovery=True, **PLAIN))
    assert made.recovery_clips is None and made.task.recovery is not None
    none = replace(tiny().recovering, demonstrations=0)
    assert build(lively(), tiny(recovery=True, recovering=none, **PLAIN)).recovery_clips is None
    assert build(lively(), tiny(recovery=False, **PLAIN)).recovery_clips is None


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    """A single network that tracks."""
    folder = tmp_path_factory.mktemp("first")
    config = tiny(single=True, action="additive", **PLAIN)
    train(begin(folder, lively(), config), folder, Until(iterations=2), None, 1, False)
    return open_run(folder).tracker


def test_a_policy_learns_to_come_back_and_stays_what_it_was(tracker: Tracker, tmp_path: Path) -> None:
    config = going_on(tracker.config, tiny(recovery=True))
    assert not config.single and config.ppo.obs_clip == WIDE
    assert config.ppo.policy_hidden == tracker.config.single_hidden
    told: list[tuple[str, int]] = []

    def show(p: Progress) -> None:
        told.append((p.stage.name, p.stage.number))

    whole, until = tmp_path / "whole", Until(iterations=8)
    own = begin(whole, lively(), config, earlier=tracker)
    done = train(own, whole, until, show, 1, False, trained=tracker.policy)
    assert list(dict.fromkeys(told)) == [("recovery", 2), ("composer", 3)]
    assert done.recovery is not None and (whole / "recovery.safetensors").exists()
    # The policy that was given is the first primitive, to the bit.
    after, before = load_policy(whole / "policy.safetensors"), tracker.policy
    assert isinstance(after.policy, Composer)
    columns = after.policy.primitives
    for a, b in zip(columns.column(0).parameters(), before.policy.mean.parameters(), strict=True):
        assert torch.equal(a, b)
    # Cut in every stage and gone on with: the same.
    parts = tmp_path / "parts"
    begin(parts, lively(), config, earlier=tracker)
    for stop in (2, 5, 99):
        again = resume(parts, config)
        cut = lambda p, stop=stop: p.iteration < stop  # noqa: E731
        train(again, parts, until, cut, 1, False, trained=tracker.policy)
    other = load_policy(parts / "policy.safetensors").state()
    assert all(torch.equal(v, other[k]) for k, v in after.state().items())
    # On ways the last primitive is the composer's teacher.
    env = staged(practised(own, COMPOSER), COMPOSER).env(2, threads=1)
    owner = Owners(env, after, torch.zeros(len(own.library), dtype=torch.long)).owner
    assert owner.tolist() == [0] * len(own.library) + [1] * 4
    env.close()


def test_one_network_learns_both(tracker: Tracker, tmp_path: Path) -> None:
    assert going_on(tracker.config, StagedPerpetual(recovery=False)).single
    fast = replace(tracker.config, ppo=replace(tracker.config.ppo, policy_lr=3e-4))
    assert going_on(fast, StagedPerpetual(recovery=False)).ppo.policy_lr == 1e-4
    config = going_on(tracker.config, replace(tiny(recovery=True), single=True))
    assert config.single and config.recovery and config.recovering.demonstrations == 4
    run, told = tmp_path / "run", []
    own = begin(run, lively(), config, earlier=tracker)
    show = lambda p: told.append(p.stage.name)  # noqa: E731
    done = train(own, run, Until(iterations=2), show, 1, False, trained=tracker.policy)
    assert set(told) == {"single with recovery"} and done.recovery is not None
    assert {r.kind for r in done.recovery.rows} == {"fallen", "far", "fallen and far"}
    # What it knows of coming back goes with it.
    learned = open_run(run).tracker
    save_tracker(learned, tmp_path / "p.safetensors")
    kept = load_tracker(tmp_path / "p.safetensors").recovery_clips
    assert learned.recovery_clips is not None and kept is not None
    for name, value in learned.recovery_clips.state().items():
        assert torch.allclose(kept.state()[name], value, atol=1e-6)
    # It is kept where the policy goes on with a library in which nothing gets up.
    more = tmp_path / "more"
    for made in (begin(more, library(), config, earlier=learned), resume(more, config)):
        assert made.recovery_clips is not None
        for name, value in learned.recovery_clips.state().items():
            assert torch.equal(made.recovery_clips.state()[name], value)
    again = try_recovery(open_run(run).task, learned.policy, 2, 1)
    assert again.rows == try_recovery(open_run(run).task, learned.policy, 2, 1).rows


def test_more_primitives_learn_what_a_policy_that_comes_back_fails(
    tracker: Tracker, tmp_path: Path
) -> None:
    config = going_on(tracker.config, tiny(recovery=True, max_primitives=2), returns=True)
    assert config.recovering.primitive == "first" and config.max_primitives == 2
    told: list[tuple[str, int]] = []

    def show(p: Progress) -> None:
        told.append((p.stage.name, p.clips))

    whole, until = tmp_path / "whole", Until(iterations=8)
    own = begin(whole, lively(), config, earlier=tracker)
    done = train(own, whole, until, show, 1, False, trained=tracker.policy)
    # What was given is evaluated, and what it fails is learned by the second primitive.
    rows = (whole / "success.csv").read_text().splitlines()[1:]
    first = [r.split(",") for r in rows if r.split(",")[1] == "primitive 1"]
    failed = sum(r[4] == "0" for r in first)
    assert len(first) == len(own.library) and failed
    assert told[0] == ("primitive 2", failed) and told[-1] == ("composer", len(own.library))
    assert done.primitives == 2 and done.recovery is not None
    policy = load_policy(whole / "policy.safetensors")
    assert isinstance(policy.policy, Composer)
    columns = policy.policy.primitives
    for a, b in zip(
        columns.column(0).parameters(), tracker.policy.policy.mean.parameters(), strict=True
    ):
        assert torch.equal(a, b)
    # Killed before the first checkpoint, in each stage, and gone on with: the same.
    parts = tmp_path / "parts"
    begin(parts, lively(), config, earlier=tracker)
    for stop in (1, 5, 99):
        cut = lambda p, stop=stop: p.iteration < stop  # noqa: E731
        train(resume(parts, config), parts, until, cut, 1, False, trained=tracker.policy)
    after = policy.state()
    other = load_policy(parts / "policy.safetensors").state()
    assert all(torch.equal(v, other[k]) for k, v in after.items())
    # The composer's teacher on ways is the one that was given.
    env = staged(practised(own, COMPOSER), COMPOSER).env(2, threads=1)
    owners = Owners(env, policy, torch.ones(len(own.library), dtype=torch.long), own=False)
    assert owners.owner.tolist() == [1] * len(own.library) + [0] * 4
    env.close()
    # In a library without a clip that gets up, recovery is learned by a primitive of its own.
    assert build(library(), config).config.recovering.primitive == "own"


def test_a_policy_that_fails_nothing_is_done(
    tracker: Tracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("stage_trainer", "perpetual_run"):
        path = f"poise.jobs.perpetual.{module}.evaluate_clips"
        monkeypatch.setattr(path, Scripted(lambda *_: True))
    config = going_on(tracker.config, tiny(recovery=True), returns=True)
    own = begin(tmp_path, lively(), config, earlier=tracker)
    done = train(own, tmp_path, Until(iterations=8), None, 1, False, trained=tracker.policy)
    assert done.solved and done.last is None and done.recovery is not None
    assert open_run(tmp_path).tracker.recovery_clips is not None


def test_a_policy_that_goes_on_learns_to_be_quick(tracker: Tracker) -> None:
    able = build(lively(), tiny(recovery=True, **PLAIN)).recovery_clips
    assert able is not None and able.pace == CALM
    wanted = replace(tiny(recovery=True), single=True)
    wanted = replace(wanted, recovering=replace(wanted.recovering, quick=True))
    config = going_on(tracker.config, wanted)
    hurried = build(lively(), config, known=able).recovery_clips
    assert hurried is not None and hurried.pace == QUICK and hurried.walks is able.walks
    # What goes on from that does not forget it.
    assert going_on(config, replace(tiny(recovery=True), single=True)).recovering.quick


def test_a_motion_that_is_lost_goes_on_where_it_waits(
    tracker: Tracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a policy that hardly stands, so that it is lost; what comes out holds together."""
    # It is waited for a short while.
    monkeypatch.setattr(recovering, "AWAY_S", 1.0)
    config = TrackConfig(recover=True, controller="policy")
    clip = swing(1.2, name="long")
    with refused("recovery-not-learned", says="come back"):
        track(clip, tracker, config)
    made = build(lively(), tiny(recovery=True, **PLAIN))
    able = replace(tracker, recovery_clips=made.recovery_clips)
    done = track(clip, able, config)
    again = track(clip, able, config)
    assert (done.evaluation.recordings[0].qpos == again.evaluation.recordings[0].qpos).all()
    assert done.losses is not None and done.failures[0] == (0, done.losses.lost[0])
    frames = len(done.evaluation.recordings[0].qpos)
    assert frames == int(done.imitation.reference.length[0]) == len(done.placed.qpos)
    # Up to where it was lost everything is as without.
    plain = track(clip, able, controller="policy")
    upto = round(done.losses.lost[0] * 30)
    a, b = (t.evaluation.recordings[0].qpos[:upto] for t in (done, plain))
    assert abs(a - b).max() < 1e-9
    assert "lost the motion" in done.losses.sentence()
    # A policy that learned the motion still knows its recovery clips.
    learned = learn(able, plain.placed, tmp_path / "learned", Until(minutes=0.01), threads=1)
    assert learned.tracker.recovery_clips is able.recovery_clips
    with refused("single-character-only"):
        TrackConfig(recover=True, count=2)
