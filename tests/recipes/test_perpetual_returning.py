"""Recovery that is taught: what who is taught sees, how it acts, and that a killed run goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_library import library, rises, tiny

from poise.env import ImitationEnv
from poise.env.recovery import FALLEN
from poise.learn import IterationStats, Until, WarmStart, first_column, load_policy, next_column
from poise.motion import ClipLibrary
from poise.nets import Composer
from poise.recipes.expert import Beginning
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import Perpetual, build, returning
from poise.recipes.perpetual.config import WIDE
from poise.recipes.perpetual.next import staged
from poise.recipes.perpetual.progress import Progress, Stage
from poise.recipes.perpetual.returning import WAYS, Blindfold, demonstrations, learn_returning
from poise.recipes.perpetual.run import Earlier, begin, going_on, resume, train
from poise.recipes.track.policy import Tracker, policy_of_run
from toy_human import swing

PLAIN = {"style": None, "help_start": 0.0, "expert": False}


def lively() -> ClipLibrary:
    """A library of somebody who walks and somebody who gets up."""
    return ClipLibrary.of([*library(), swing(1.2, speed=1.0, name="on"), rises()])


def recovering(**changes: object) -> Imitation:
    made = build(lively(), tiny(recovery=True, **(PLAIN | changes)))
    return staged(made, Stage("recovery", 2))


@pytest.mark.parametrize("action", ["additive", "absolute"])
def test_who_is_blindfolded_sees_and_does_as_who_recovers(action: str) -> None:
    """The same state, the same goal: the same observation, and the same actions move it alike."""
    own = recovering(action=action)
    shown = demonstrations(own)
    assert shown is not None and len(shown.reference.names) == 4
    demo = shown.env(4, threads=1)
    recovery = own.task.recovery
    assert recovery is not None
    blind = Blindfold(demo, recovery)
    seen = blind.reset()
    # The ends of the demonstrations as the references of who recovers.
    other = replace(own, reference=shown.reference)
    env: ImitationEnv = other.env(4, auto_reset=False, threads=1)
    last = shown.reference.length - 1
    env.reset_to(demo.clip, last[demo.clip], torch.full((4,), FALLEN))
    s = demo.backend.state
    env.backend.write(None, s.qpos.clone().double(), s.qvel.clone().double())
    apart = (s.qpos[:, :3] - shown.reference.qpos[shown.reference.start + last][demo.clip, :3]).norm(
        dim=-1
    )
    assert env.recoveries is not None
    env.recoveries.before.copy_(apart)
    assert torch.allclose(env._observe(), seen, atol=1e-4)
    acts = 0.1 * torch.randn(4, demo.num_actions, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(blind.shifted(blind.shifted(acts), -1.0), acts, atol=1e-6)
    env.step(acts)
    before = demo.backend.state.qpos.clone()
    done = blind.step(acts)
    moved = ~(done.terminated | done.truncated)
    assert bool(moved.any()) and not torch.equal(before, demo.backend.state.qpos)
    there, here = env.backend.state.qpos[moved], demo.backend.state.qpos[moved]
    assert torch.allclose(there, here, atol=1e-4)
    blind.close()
    env.close()


def test_a_library_without_getting_up_has_nothing_to_show() -> None:
    made = build(library(), tiny(recovery=True, **PLAIN))
    assert demonstrations(staged(made, Stage("recovery", 2))) is None
    none = recovering(recovering=replace(tiny().recovering, ways=0))
    assert demonstrations(none) is None


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    """A single network that tracks."""
    folder = tmp_path_factory.mktemp("first")
    config = tiny(single=True, action="additive", **PLAIN)
    train(begin(folder, lively(), config), folder, Until(iterations=2), None, 1, False)
    return policy_of_run(folder)


def test_a_policy_learns_to_come_back_and_stays_what_it_was(tracker: Tracker, tmp_path: Path) -> None:
    config = going_on(tracker.config, tiny(recovery=True))
    assert not config.single and config.ppo.obs_clip == WIDE
    assert config.ppo.policy_hidden == tracker.config.single_hidden
    told: list[tuple[str, int]] = []

    def show(p: Progress) -> None:
        told.append((p.stage.name, p.stage.number))

    whole, until = tmp_path / "whole", Until(iterations=8)
    went = Earlier(tracker.about["samples"], tracker.about["seconds"], tracker.target)
    own = begin(whole, lively(), config, earlier=went)
    train(own, whole, until, show, 1, False, trained=tracker.policy)
    assert list(dict.fromkeys(told)) == [("recovery", 2), ("composer", 3)]
    assert (whole / WAYS).exists() and (whole / "recovery.safetensors").exists()
    # The policy that was given is the first primitive, to the bit.
    after, before = load_policy(whole / "policy.safetensors"), tracker.policy
    assert isinstance(after.policy, Composer)
    columns = after.policy.primitives
    for a, b in zip(columns.column(0).parameters(), before.policy.mean.parameters(), strict=True):
        assert torch.equal(a, b)
    # Cut in every stage and gone on with: the same.
    parts = tmp_path / "parts"
    begin(parts, lively(), config, earlier=went)
    for stop in (2, 5, 99):
        again = resume(parts, config)
        cut = lambda p, stop=stop: p.iteration < stop  # noqa: E731
        train(again, parts, until, cut, 1, False, trained=tracker.policy)
    other = load_policy(parts / "policy.safetensors").state()
    assert all(torch.equal(v, other[k]) for k, v in after.state().items())


def test_killed_while_ways_are_learned_goes_on_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(returning, "SAVE_S", 0.0)
    own = recovering(action="additive")
    env = own.env(1, threads=1)
    env.close()
    rng = torch.Generator().manual_seed(0)
    first = first_column(env.num_obs, env.num_actions, (16,), std=0.05, generator=rng)
    start = WarmStart(next_column(first, generator=rng))
    pupil = next_column(first, "random", generator=rng)
    whole = learn_returning(start, pupil, own, tmp_path / "whole", 1, Beginning())

    def killed(stats: IterationStats, of: int) -> None:
        assert stats.samples < of
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn_returning(start, pupil, own, tmp_path / "cut", 1, Beginning(way=killed))
    seen: list[int] = []
    tell = Beginning(way=lambda stats, of: seen.append(stats.samples))
    again = learn_returning(start, pupil, own, tmp_path / "cut", 1, tell)
    assert seen == [64] and whole.samples == again.samples > 64
    # And no longer than the time allows.
    short = learn_returning(
        start, pupil, own, tmp_path / "short", 1, Beginning(), lambda samples, _: samples >= 32
    )
    assert whole.samples - short.samples == 32
    other = again.policy.state()
    assert all(torch.equal(v, other[k]) for k, v in whole.policy.state().items())


def test_one_network_can_learn_both(tracker: Tracker) -> None:
    config = going_on(tracker.config, replace(Perpetual(), recovery=True, single=True))
    assert config.single and config.recovery
    assert going_on(tracker.config, Perpetual(recovery=False)).single
