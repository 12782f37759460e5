"""A character goes about: from a tiny kinematic policy to files."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from poise.env.walk_path import WalkPath
from poise.formats import read_clip
from poise.jobs.endless import dreamt as frames
from poise.jobs.endless.dream_world import DreamPush
from poise.jobs.endless.dreaming import begun, dream, past_of
from poise.jobs.endless.dreamt import NUMBER, ClipMaker, Dream, FrameStore, MotionWriter, Pieces
from poise.jobs.endless.endless_training import Endless, motions_of, train_generator
from poise.jobs.endless.model import GeneratorModel
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kinematics import hold_feet
from poise.kinematics.supports import Support
from poise.learn.cvae import CVAEConfig, CVAETraining
from poise.motion import ClipLibrary, trim
from poise.plan import LookaheadConfig
from poise.score.card import NO_HELP
from refusals import refused
from toy_policy import walk

SMALL = CVAEConfig(past=10, future=12, latent=4, hidden=32, layers=(32,))
FEW = LookaheadConfig(candidates=10, horizon=6, smoothing=(0.0, 0.5))


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def model(tracker: Tracker, tmp_path_factory: pytest.TempPathFactory) -> GeneratorModel:
    motions = motions_of(ClipLibrary.of([walk()]), tracker, SMALL, lambda _: None)
    config = Endless(SMALL, CVAETraining(batch=16), steps=60, ema=0.9)
    return train_generator(motions, tmp_path_factory.mktemp("run"), config)[0]


def test_it_goes_about_and_is_written(model: GeneratorModel, tracker: Tracker, tmp_path: Path) -> None:
    told: list[int] = []
    how = Dream(lookahead=FEW, threads=1, seed=1)
    made = dream(
        1.5, model, tracker, how, out=tmp_path / "live.bvh",
        progress=lambda what, k, n: told.append(k),
    )  # fmt: skip
    assert made.motion().frames == made.source.frames == told[-1] == 45
    assert "1.5 s without help" in made.sentence and made.paths == (tmp_path / "live.bvh",)
    # The character begins on its motion and moves as it is asked to.
    apart = np.linalg.norm(made.motion().positions() - made.source.positions(), axis=-1).mean(1)
    assert apart[:15].mean() < 0.1
    assert np.isfinite(made.motion().positions()).all()
    same = dream(1.5, model, tracker, how)
    np.testing.assert_array_equal(same.motion().rot, made.motion().rot)
    # What is written as it is made is the motion.
    live = read_clip(tmp_path / "live.bvh")
    np.testing.assert_allclose(live.positions(), made.clip.positions(), atol=1e-3)
    paths = made.save(tmp_path / "out")
    assert read_clip(paths["simulated"]).frames == 45
    score = json.loads(paths["score"].read_text())
    assert score["help"] == asdict(NO_HELP) and score["simulated"]["jerk"] > 0
    page = paths["report"].read_text()
    assert "Endless motion" in page and "not measured" not in page and "from every start" not in page
    made.save(tmp_path / "one.bvh")
    assert read_clip(tmp_path / "one.bvh").frames == 45


def test_it_goes_on_from_a_clip_of_any_skeleton(model: GeneratorModel, tracker: Tracker) -> None:
    generator = model.generator(tracker.humanoid)
    past = past_of(walk(), generator, tracker)
    assert past.shape == (10, tracker.humanoid.model.nq)
    pasts = begun(generator, Dream(count=2), past)
    assert pasts[0, -1, :2].tolist() == [0, 0]
    assert float((pasts[1, -1, :2] - pasts[0, -1, :2]).norm()) == pytest.approx(2.0)
    torch.testing.assert_close(pasts[0, :, 2:], past[:, 2:])
    made = dream(0.4, model, tracker, seed_clip=walk(), controller="policy", threads=1)
    assert made.motion().frames == 12
    with refused("clip-too-short", says=("10 frames", "30 Hz", "5")):
        dream(1.0, model, tracker, seed_clip=trim(walk(), 0, 5))


def test_a_fall_is_counted_and_got_up_from(model: GeneratorModel, tracker: Tracker) -> None:
    # Codes that are drawn so far out are no usual motion.
    made = dream(8.0, model, tracker, temperature=8.0, controller="policy", threads=1)
    stays = dream(8.0, model, tracker, temperature=8.0, controller="policy", recover=False, threads=1)
    assert made.falls_per_hour == pytest.approx(450.0 * len(made.falls))
    assert ("without a fall" in made.sentence) == (not made.falls)
    # One that stays where it falls does so once, and counts until then.
    assert len(stays.falls) == stays.stayed_down <= 1
    if stays.falls:
        assert stays.falls_per_hour == pytest.approx(3600.0 / stays.falls[0])


def test_two_characters_go_to_where_they_are_told(model: GeneratorModel, tracker: Tracker) -> None:
    made = dream(
        1.0, model, tracker, count=2, targets=((0.1, 0.0),), controller="policy", threads=1, seed=3
    )
    assert made.reached[0][0] == 0 and made.reached[0][1] < 1.0
    assert [c.done.count for c in made.characters] == [30, 30]
    assert len(made.report().others) == 1 and "of 2 targets reached" in made.sentence


@pytest.mark.parametrize("latent", [2, 9])
def test_a_generator_of_any_z_goes_with_the_shipped_tracker(
    tracker: Tracker, tmp_path: Path, latent: int
) -> None:
    net = CVAEConfig(past=8, future=9, latent=latent, hidden=16, layers=(16,))
    motions = motions_of(ClipLibrary.of([walk()]), tracker, net, lambda _: None)
    train_generator(motions, tmp_path, Endless(net, CVAETraining(batch=8), steps=4, ema=0.9))
    made = dream(0.5, tmp_path, tracker, controller="policy", threads=1)
    assert made.motion().frames == 15 and np.isfinite(made.motion().positions()).all()


def test_two_share_a_world_with_a_box_and_are_pushed(model: GeneratorModel, tracker: Tracker) -> None:
    chair = Support("seat", (0.5, 0.5, 0.45), (1.0, 0.0, 0.225))
    high = Support("seat", (0.5, 0.5, 0.9), (4.0, 0.0, 0.45))
    push = DreamPush(400.0, "chest", 0.2, 0.2, (0.0, 1.0, 0.0))
    how = Dream(count=2, supports=(chair, high), lookahead=FEW, threads=1, seed=2)
    made = dream(0.8, model, tracker, how)
    hit = dream(0.8, model, tracker, how, pushes=(push, push))
    assert "sat on; characters walk round it" in made.notes[0]
    assert len(made.report().things) == 2 and made.to_dict()["visits"] == []
    apart = hit.motion().root_pos[-1] - made.motion().root_pos[-1]
    assert apart[1] > 0.1
    np.testing.assert_allclose(hit.motion().root_pos[:5], made.motion().root_pos[:5], atol=1e-6)
    with refused("bodies-overlap", says="seat 1"):
        dream(0.5, model, tracker, supports=(replace(chair, pos=(0.3, 0.0, 0.225)),))
    with refused("unknown-body-part", says="nose"):
        dream(0.5, model, tracker, pushes=(DreamPush(at="nose"),))


def test_a_path_is_followed_and_a_hand_helps(model: GeneratorModel, tracker: Tracker) -> None:
    path = WalkPath(((0.0, 0.0), (3.0, 0.0)), 1.0)
    made = dream(1.0, model, tracker, path=path, help_limit=80.0, controller="policy", threads=1, seed=3)
    assert "up to 80 N of help" in made.sentence and any("Helped" in n for n in made.notes)
    score = made.to_dict()
    assert 0 < score["help"]["force_mean_n"] <= 80.0 and score["help"]["limit_n"] == 80.0
    assert score["path"][0]["most_m"] < 1.0 and "m of the path" in made.sentence
    with refused("option-conflict"):
        Dream(path=path, targets=((1.0, 0.0),))


def test_a_world_that_goes_bad_is_put_back(
    model: GeneratorModel, tracker: Tracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, calls = tracker.policy, [0]

    class Bad:
        num_obs, num_actions = policy.num_obs, policy.num_actions

        def act(self, obs: torch.Tensor) -> torch.Tensor:
            calls[0] += 1
            return policy.act(obs) * (float("nan") if calls[0] == 10 else 1.0)

    bad = replace(tracker, policy=Bad())  # type: ignore[arg-type]
    made = dream(1.0, model, bad, controller="policy", tries=1, threads=1)
    assert made.motion().frames == 30 and np.isfinite(made.motion().positions()).all()
    assert any("went bad at 0.3 s" in n for n in made.notes)


def test_what_cannot_be_is_said(
    model: GeneratorModel, tracker: Tracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seconds in (0.0, float("nan"), 1e6):
        with refused("out-of-range"):
            dream(seconds, model, tracker)
    with refused("file-unreadable"):
        dream(1.0, tmp_path / "none.safetensors", tracker)
    with refused("out-of-range", says="16"):
        Dream(count=0)
    with refused("out-of-range", says="temperature"):
        Dream(temperature=-1)
    with refused("out-of-range"):
        Dream(targets=((float("nan"), 0.0),))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with refused("disk-full"):
        dream(60.0, model, tracker, out=tmp_path / "big.bvh")
    # Two characters' motions need twice as much.
    need = 1.5 * NUMBER * 30 * 60 * (3 * len(tracker.example.skeleton) + 3)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=need))
    with refused("disk-full"):
        dream(60.0, model, tracker, out=tmp_path / "big.bvh", count=2)
    assert not list(tmp_path.iterdir())


def test_pieces_are_one_motion(
    tracker: Tracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, "PIECE", 30)
    monkeypatch.setattr(frames, "SHARED", 8)
    qpos = place(walk(), tracker).qpos
    store = FrameStore(qpos.shape[1])
    body = ClipMaker(tracker.humanoid.table, tracker.example, 30.0)
    writer = MotionWriter(tmp_path / "walk.bvh", tracker.example, len(qpos))
    pieces = Pieces(store, body, writer.add, "walk", hold=False)
    for row in qpos:
        store.append(row)
        pieces.more()
    pieces.finish()
    np.testing.assert_allclose(store.read(), qpos, atol=1e-6)
    assert writer.close() == tmp_path / "walk.bvh" and len(list(tmp_path.iterdir())) == 1
    whole = body.clip(qpos, "walk")
    np.testing.assert_allclose(
        read_clip(tmp_path / "walk.bvh").positions(), whole.positions(), atol=1e-4
    )
    # Held feet pass from piece to piece without a jump.
    got: list[np.ndarray] = []
    pieces = Pieces(store, body, lambda c: got.append(c.positions()), "walk")
    pieces.more()
    pieces.finish()
    pos = np.concatenate(got)
    held = hold_feet(whole, body.table)[0].positions()
    fastest = np.linalg.norm(np.diff(held, axis=0), axis=-1).max()
    assert len(pos) == len(qpos) and np.linalg.norm(np.diff(pos, axis=0), axis=-1).max() < 1.3 * fastest
