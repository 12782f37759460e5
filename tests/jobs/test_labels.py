"""Styles: labels of a library's clips, and motion of one of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from poise.jobs.endless.endless_training import Endless, motions_of, train_generator
from poise.jobs.endless.model import (
    GeneratorModel,
    clips_of_seeds,
    kinds_of,
    load_generator,
    names_of,
    read_labels,
)
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.learn.cvae import CVAEConfig, CVAETraining
from poise.motion import ClipLibrary
from refusals import refused
from toy_policy import walk

SMALL = CVAEConfig(past=10, future=12, latent=4, hidden=16, decoder="cosine", cosines=6, blocks=1)
TEXT = "# a comment\nslow  (?i)stroll\nwalk _2$|^w # the second\nslow crawl\n"


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def test_the_first_label_that_fits_counts(tmp_path: Path) -> None:
    (tmp_path / "labels.txt").write_text(TEXT)
    labels = read_labels(tmp_path)
    assert names_of(labels) == ("slow", "walk")
    assert kinds_of(["a_Stroll_2", "b_2", "crawl", "nothing"], labels).tolist() == [0, 1, 0, -1]
    empty = tmp_path / "none"
    empty.mkdir()
    assert read_labels(empty) == ()
    for text, what in (("walk", ("line-malformed", "line 1")), ("\nwalk [", ("bad-regex", "line 2"))):
        (tmp_path / "labels.txt").write_text(text)
        with refused(*what):
            read_labels(tmp_path)
    with refused("file-unreadable"):
        read_labels(tmp_path / "no.txt")


def test_a_style_is_motion_of_its_label_alone(tracker: Tracker, tmp_path: Path) -> None:
    clips = [walk().replaced(name=name) for name in ("one", "two")]
    motions = motions_of(ClipLibrary.of(clips), tracker, SMALL, lambda _: None)
    (tmp_path / "labels.txt").write_text("first one\nsecond two\nthird three")
    config = Endless(SMALL, CVAETraining(batch=4), steps=2, codes=20)
    model = train_generator(motions, tmp_path, config, labels=read_labels(tmp_path))[0]
    seen = clips_of_seeds(motions, 10)
    assert len(seen) == len(motions.seeds) and set(seen.tolist()) == {0, 1}
    again = load_generator(tmp_path)
    for made in (model, again):
        assert made.labels == ("first", "second", "third")
        styled = made.generator(tracker.humanoid, style="second")
        assert made.codes is not None and made.codes.kinds is not None and styled.codes is not None
        assert torch.equal(styled.codes.mean, made.codes.mean[made.codes.kinds == 1])
        assert torch.equal(styled.seeds.float(), made.seeds[seen == 1].float())
        assert 0 < len(styled.codes.keys) < len(made.codes.keys)
    for wrong in ("third", "fourth"):
        with refused("unknown-style", says=(wrong, "first, second")):
            again.generator(tracker.humanoid, style=wrong)
    parts = model.net, model.seeds, model.bounds, model.hinges, model.fps
    plain = GeneratorModel(*parts, {}, model.codes)
    with refused("unknown-style"):
        plain.generator(tracker.humanoid, style="first")
