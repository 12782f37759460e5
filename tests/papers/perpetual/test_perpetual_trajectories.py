"""A run that begins with a search for paths: found, killed in the middle and resumed, refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from poise.jobs.perpetual.perpetual_run import begin, train
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import LATEST, Until, load_checkpoint, save_checkpoint
from poise.motion import ClipLibrary
from poise.papers.perpetual.primitive_stages import PATHS
from poise.papers.perpetual.trajopt import TrajOptConfig, TrajOptStats
from poise.recipes.body_shapes import BodyShapes
from poise.recipes.perpetual_settings import config_of
from poise.settings import to_data
from refusals import refused
from toy_human import swing
from toy_library import tiny

PATH = TrajOptConfig(iterations=2, segment_s=0.3)


def run(folder: Path, stop_after: int = 0) -> list[TrajOptStats]:
    """Trains one iteration; Ctrl-C comes after so many iterations of the search."""
    seen: list[TrajOptStats] = []

    def path(stats: TrajOptStats, of: int) -> None:
        assert of == 2
        seen.append(stats)
        if len(seen) == stop_after:
            raise KeyboardInterrupt

    config = tiny(trajopt=PATH, help_start=0.0, style=None)
    clips = ClipLibrary.of([swing(0.3, name="calm"), swing(0.4, speed=1.0, name="walk")])
    imitation = begin(folder, clips, config)
    train(
        imitation,
        folder,
        Until(iterations=1),
        None,
        1,
        tensorboard=False,
        beginning=TrainingCallbacks(path=path),
    )
    return seen


def test_a_killed_search_goes_on_where_it_was(tmp_path: Path) -> None:
    assert [s.iteration for s in run(tmp_path / "whole")] == [1, 2]
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed", stop_after=1)
    assert (tmp_path / "killed" / PATHS).exists() and not (tmp_path / "killed" / LATEST).exists()
    assert [s.iteration for s in run(tmp_path / "killed")] == [2]
    one, other = (load_checkpoint(tmp_path / name / LATEST)[0] for name in ("whole", "killed"))
    policy = [name for name in one if name.startswith("policy")]
    assert policy and all(torch.equal(one[name], other[name]) for name in policy)


def test_paths_of_other_clips_are_refused(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / PATHS, {"qpos": torch.zeros(2, 3)}, {"kind": "paths", "clips": ["other"]})
    with refused("clips-differ"):
        run(tmp_path)


def test_settings_survive_and_shapes_are_refused() -> None:
    config = tiny(trajopt=PATH)
    assert config_of(to_data(config)) == config
    with refused("settings-conflict"):
        tiny(trajopt=PATH, shapes=BodyShapes(count=2))
