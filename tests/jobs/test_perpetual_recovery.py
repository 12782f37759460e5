"""Recovery in the perpetual recipe: on which clips, with which goals, by which teacher, how judged."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.env.recovery.clock import FALLEN, FAR, RecoveryClock
from poise.errors import PoiseError
from poise.jobs.library.folder import library_of
from poise.jobs.open import open_run
from poise.jobs.perpetual import evaluation as perpetual_recovery
from poise.jobs.perpetual.evaluation import RECOVERY_WORTH, StageRecord, back, check_falls, try_recovery
from poise.jobs.perpetual.perpetual_run import begin, train
from poise.jobs.perpetual.stages import Progress, Stage, staged
from poise.jobs.run_file import FINAL, RUN_FILE
from poise.learn import Until, compose, first_column, load_checkpoint, load_policy, next_column
from poise.learn.checkpoint import save_checkpoint
from poise.learn.composer import Composer
from poise.learn.primitives import primitive
from poise.motion import Clip, ClipLibrary
from poise.papers.perpetual.primitive_stages import Owners
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build, standing, walking_clips
from poise.recipes.perpetual_settings import Perpetual, config_of
from poise.score import ClipResults
from poise.settings import to_data
from refusals import refused
from toy_human import swing
from toy_library import library, tiny

STAGES = (Stage("primitive"), Stage("recovery", 2), Stage("composer", 3, mixed=True))


@pytest.fixture(scope="module")
def built() -> Imitation:
    return build(library(), tiny(recovery=True))


def low(name: str) -> Clip:
    """A motion that lies on the back all the time."""
    clip = swing(1.2, name=name)
    rot = clip.rot.copy()
    rot[:, 0] = [math.cos(math.pi / 4), 0.0, -math.sin(math.pi / 4), 0.0]
    return clip.replaced(rot=rot, root_pos=clip.root_pos * [1.0, 1.0, 0.2])


def test_walks_and_standing_are_found() -> None:
    clips = [
        swing(1.2, name="calm"), swing(1.2, speed=1.0, name="walk"), low("lies"),
        swing(1.2, speed=4.0, name="sprint"), swing(0.5, name="moment"), swing(1.2, name="again"),
    ]  # fmt: skip
    made = build(ClipLibrary.of(clips), tiny())
    assert walking_clips(made.reference).tolist() == [True, True, False, False, False, True]
    # None that walks leaves all of them.
    hasty = build(ClipLibrary.of([swing(1.2, speed=4.0, name=n) for n in "ab"]), tiny())
    assert walking_clips(hasty.reference).tolist() == [True, True]


def test_trials_stand_on_the_quietest_last_frame() -> None:
    still = swing(1.2, name="still")
    still = still.replaced(rot=still.rot[:1].repeat(still.frames, 0))
    made = build(ClipLibrary.of([swing(1.2, speed=1.0, name="walk"), still, low("lies")]), tiny())
    assert standing(made.reference) == (1, 36)


def test_all_stages_see_as_much_and_near_the_reference_the_same(built: Imitation) -> None:
    clip, frame = torch.tensor([0, 1, 2, 1]), torch.tensor([3, 0, 5, 9])
    seen = []
    for stage in STAGES:
        env = staged(built, stage).env(4, auto_reset=False, threads=1)
        seen.append(env.reset_to(clip, frame).clone())
        assert (env.event(RecoveryClock) is None) == (stage.recovers is None)
        assert env.task.recovery is None or env.task.recovery.drop.count == 4
        env.close()
    assert torch.equal(seen[0], seen[1]) and torch.equal(seen[0], seen[2])
    odds = [staged(built, s).task.recovery for s in STAGES[1:]]
    assert [(r.fallen, r.continues) for r in odds if r is not None] == [(1.0, 0.0), (0.3, 0.5)]


def test_the_finished_policy_knows_point_goals(built: Imitation) -> None:
    composed = staged(built, STAGES[2]).task
    assert built.task.recovery is not None and built.task.recovery == composed.recovery
    assert [t.name for t in built.task.rewards] == [t.name for t in composed.rewards]
    assert "point_goal" not in [t.name for t in staged(built, STAGES[0]).task.rewards]
    assert build(library(), tiny()).task.recovery is None


def test_who_is_far_or_fallen_is_taught_by_the_primitive_of_recovery(built: Imitation) -> None:
    env = staged(built, STAGES[2]).env(4, auto_reset=False, threads=1)
    rng = torch.Generator().manual_seed(0)
    columns = first_column(env.num_obs, env.num_actions, (8,), generator=rng)
    for _ in range(2):
        columns = next_column(columns, "random", generator=rng)
    kinds, zero = torch.tensor([0, FALLEN, FAR, FALLEN | FAR]), torch.zeros(4, dtype=torch.long)
    obs = env.reset_to(zero, zero, kinds)
    acts = Owners(env, compose(columns, hidden=(8,), generator=rng), torch.tensor([1, 0, 0])).act(obs)
    own, recovery = (primitive(columns, k).act(obs) for k in (1, 2))
    assert torch.allclose(acts[0], own[0], atol=1e-6)
    assert torch.allclose(acts[1:], recovery[1:], atol=1e-6) and not torch.allclose(own, recovery)
    env.close()


def test_trials_are_repeatable_and_counted(built: Imitation) -> None:
    own = staged(built, STAGES[1])
    env = own.env(1, threads=1)
    policy = first_column(env.num_obs, env.num_actions, (8,), generator=torch.Generator().manual_seed(0))
    env.close()
    one, two = (try_recovery(own, policy, 3, 1) for _ in range(2))
    assert one == two and back(one) == (0, 9)
    some = replace(one, rows=tuple(replace(r, within=(0.0, 2 / 3)) for r in one.rows))
    assert back(some) == (6, 9)


def test_a_body_that_never_lies_is_told_before_the_training(
    built: Imitation, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_falls(built)

    def never(*_: object) -> None:
        raise PoiseError(
            "4 of 4 characters did not come to lie",
            hint="Drop them for more steps",
            code="fall-unsettled",
        )

    monkeypatch.setattr(perpetual_recovery, "fall_states", never)
    with refused("fall-unsettled", says=("recovery", "--no-recovery")):
        check_falls(built)


def test_the_best_of_a_mixed_stage_tracks_and_recovers(built: Imitation) -> None:
    config, rng = tiny(recovery=True), torch.Generator().manual_seed(0)
    stage_record = StageRecord(config, built.reference.length)
    policies = [first_column(4, 2, (3,), generator=rng) for _ in range(3)]

    def results(won: list[bool]) -> ClipResults:
        frames, error = torch.full((3,), 10), torch.full((3,), 30.0).double()
        return ClipResults(torch.arange(3), torch.tensor(won), frames, frames, error, error)

    stage_record.record(results([True, True, False]), policies[0], 0.0, 0.0)
    stage_record.record(results([True, True, False]), policies[1], 0.0, 0.9)
    # One clip of three is worth more than all recovery.
    stage_record.record(results([True, False, False]), policies[2], 0.0, 1.0)
    assert RECOVERY_WORTH < 1 / 3 and stage_record.best_key[1] == pytest.approx(
        2 / 3 + 0.9 * RECOVERY_WORTH
    )
    assert all(torch.equal(stage_record.best[k], v) for k, v in policies[1].state().items())


def trained(folder: Path, config: Perpetual, iterations: int = 6) -> tuple[list[str], dict]:
    stages: list[str] = []

    def show(p: Progress) -> None:
        stages.append(p.stage.name)

    until = Until(iterations=iterations)
    result = train(begin(folder, library(), config), folder, until, show, 1, False)
    said = json.loads((folder / "result.json").read_text())
    assert (result.recovery is None) == (said["recovery"]["policy"] is None)
    return list(dict.fromkeys(stages)), said


def test_one_network_learns_recovery_in_a_second_stage(tmp_path: Path) -> None:
    stages, said = trained(tmp_path, tiny(recovery=True, single=True, expert=False))
    assert stages == ["single", "single with recovery"]
    assert said["stage"] == "single with recovery" and said["recovery"]["policy"]["seconds"] == [
        0.1,
        0.2,
    ]
    assert said["recovery"]["primitive"] is None and said["method"] == "perpetual-single"
    assert load_policy(tmp_path / FINAL).shape["hidden"] == [24, 16]


def test_without_multiplicative_control_there_is_one_network_of_a_primitives_size(
    tmp_path: Path,
) -> None:
    stages, said = trained(tmp_path, tiny(multiplicative=False, expert=False), 2)
    assert stages == ["single"] and said["method"] == "perpetual-plain"
    assert load_policy(tmp_path / FINAL).shape["hidden"] == [16]


def test_without_progressive_training_all_primitives_learn_with_the_composer(tmp_path: Path) -> None:
    config = tiny(progressive=False, recovery=True, max_primitives=2)
    stages, said = trained(tmp_path, config)
    assert stages == ["joint", "joint with recovery"] and said["method"] == "perpetual-joint"
    policy = load_policy(tmp_path / FINAL).policy
    assert isinstance(policy, Composer) and policy.joint and len(policy.primitives) == 2
    # They began different, and both have learned: no column is as it was made.
    one, two = (policy.primitives.column(k).last.weight for k in (0, 1))
    assert not torch.equal(one, two)


def test_a_policy_that_has_not_come_to_recovery_sees_no_point_goals(tmp_path: Path) -> None:
    config = tiny(recovery=True, expert=False, composer_clone=False)
    begun = begin(tmp_path, library(), config)
    train(begun, tmp_path, Until(iterations=20), lambda p: False, 1, False)
    seen = open_run(tmp_path).task
    assert seen.task.recovery is None and not seen.config.recovery
    # Going on with the run is going on with recovery.
    assert begin(tmp_path, library(), config).task.recovery is not None


def test_runs_of_before_there_was_recovery_stay_as_they_were(tmp_path: Path) -> None:
    old = to_data(tiny(recovery=False))
    for name in ("recovery", "recovering", "multiplicative", "progressive"):
        del old[name]
    assert config_of(old) == replace(tiny(recovery=False), recovering=Perpetual().recovering)
    config = tiny(recovery=False, recovering=Perpetual().recovering)
    begin(tmp_path, library(), config)
    tensors, meta = load_checkpoint(tmp_path / RUN_FILE)
    save_checkpoint(tmp_path / RUN_FILE, tensors, meta | {"config": old})
    assert begin(tmp_path, library(), config).config == config
    # How it was cloned is its own business, and no reason to refuse it.
    begin(tmp_path, library(), replace(config, clone=None))
    with refused("settings-differ", says="recovery"):
        begin(tmp_path, library(), replace(config, recovery=True))


def test_real_walks_are_told_from_what_is_none(data_dir: Path) -> None:
    names = ("walk", "zombie_walk", "run", "crawl", "roll", "getup_faceup", "backflip", "kick", "jump")
    files = [data_dir / f"deepmimic_txt/humanoid3d_{name}.txt" for name in names]
    clips, _ = library_of(files)
    made = build(clips, tiny())
    walks = walking_clips(made.reference)
    found = {clips.names[c].partition("humanoid3d_")[2] for c in walks.nonzero().flatten().tolist()}
    assert found == {"walk", "zombie_walk"}
