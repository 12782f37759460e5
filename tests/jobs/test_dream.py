"""A character goes about: from a tiny kinematic policy to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from poise.errors import PoiseError
from poise.jobs.endless.dreaming import Dream, dream
from poise.jobs.endless.model import GeneratorModel
from poise.jobs.endless.training import Endless, motions_of, train_generator
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.learn.cvae import CVAETraining
from poise.motion import ClipLibrary, read_clip
from poise.nets.cvae import CVAEConfig
from poise.plan import LookaheadConfig
from toy_policy import walk

SMALL = CVAEConfig(past=10, future=12, latent=4, hidden=32, layers=(32,))
FEW = LookaheadConfig(candidates=12, smoothing=(0.0, 0.5))


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def model(tracker: Tracker, tmp_path_factory: pytest.TempPathFactory) -> GeneratorModel:
    motions = motions_of(ClipLibrary.of([walk()]), tracker, SMALL, lambda _: None)
    config = Endless(SMALL, CVAETraining(batch=16), steps=200, ema=0.9)
    return train_generator(motions, tmp_path_factory.mktemp("run"), config)[0]


def test_it_goes_about_and_is_written(model: GeneratorModel, tracker: Tracker, tmp_path: Path) -> None:
    told: list[int] = []
    how = Dream(lookahead=FEW, threads=1, seed=1)
    made = dream(1.5, model, tracker, how, progress=lambda what, k, n: told.append(k))
    assert made.motion.frames == made.asked.frames == 46 and told[-1] == 45
    assert "1 s without help" in made.sentence or "2 s without help" in made.sentence
    # The character begins on its motion and moves as it is asked to.
    apart = np.linalg.norm(made.motion.positions() - made.asked.positions(), axis=-1).mean(1)
    assert apart[0] < 1e-3 and apart[:15].mean() < 0.1
    assert np.isfinite(made.motion.positions()).all()
    same = dream(1.5, model, tracker, how)
    np.testing.assert_array_equal(same.motion.rot, made.motion.rot)
    paths = made.save(tmp_path / "out")
    assert read_clip(paths["simulated"]).frames == 46
    made.save(tmp_path / "one.bvh")
    assert read_clip(tmp_path / "one.bvh").frames == 46


def test_a_fall_is_counted_and_got_up_from(model: GeneratorModel, tracker: Tracker) -> None:
    # Codes that are drawn so far out are no usual motion.
    made = dream(8.0, model, tracker, temperature=5.0, controller="policy", threads=1)
    stays = dream(8.0, model, tracker, temperature=5.0, controller="policy", recover=False, threads=1)
    assert made.falls_per_hour == pytest.approx(450.0 * len(made.falls))
    assert ("without a fall" in made.sentence) == (not made.falls)
    assert stays.falls == ()


def test_what_cannot_be_is_said(model: GeneratorModel, tracker: Tracker, tmp_path: Path) -> None:
    for seconds in (0.0, float("nan"), 1e6):
        with pytest.raises(PoiseError, match="to 10 hours"):
            dream(seconds, model, tracker)
    with pytest.raises(PoiseError, match="could not be read"):
        dream(1.0, tmp_path / "none.safetensors", tracker)
