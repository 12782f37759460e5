"""Files that state no frame rate are read at the one that physics vouches for, and the note says why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from walker import leap, played, walk

import poise
from poise.kinematics.rate import read_clip, settled
from poise.motion import Clip

NOTE = "AMC files state no frame rate: 120 frames per second taken"


def unstated(clip: Clip, rates: tuple[float, ...] = (120.0, 60.0)) -> Clip:
    """The clip as a reader hands it on that took the first of several rates."""
    source = replace(
        clip.skeleton.source, rates=rates, notes=("First.", NOTE), evidence=(("fps", NOTE), ("up", "Z"))
    )
    return clip.replaced(skeleton=replace(clip.skeleton, source=source))


@pytest.mark.parametrize("motion", [leap, walk])
def test_the_likely_rate_is_taken_and_said(motion) -> None:
    made = settled(unstated(played(motion(60.0), 2.0)))
    assert made.fps == 60.0
    first, note = made.skeleton.source.notes
    assert first == "First." and dict(made.skeleton.source.evidence) == {"fps": note, "up": "Z"}
    begins = "AMC files state no frame rate: 60 frames per second taken, not 120, at which "
    assert note.startswith(begins) and len(note) > len(begins) + 20
    # It is settled: read once more nothing changes.
    assert settled(made) is made


def test_what_is_right_stated_or_of_another_rate_stays() -> None:
    right, stated = unstated(leap(120.0)), played(leap(60.0), 2.0)
    assert settled(right) is right and settled(stated) is stated
    # Evidence for a rate that such files do not have is told by the verbs, but not taken.
    other = unstated(played(leap(30.0), 4.0))
    assert settled(other) is other


def test_an_amc_file_is_read_at_its_rate(data_dir: Path) -> None:
    folder = data_dir / "cmu_amc/rfc"
    for name, rate in (("90_08", 60.0), ("90_11", 60.0), ("90_05", 120.0)):
        clip = read_clip(folder / f"{name}.amc", skeleton=folder / "08.asf")
        assert clip.fps == rate == poise.read(folder / f"{name}.amc", skeleton=folder / "08.asf").fps
        assert any(f"{rate:g} frames per second taken" in n for n in clip.skeleton.source.notes)
    # The user's word is obeyed.
    clip = read_clip(folder / "90_08.amc", skeleton=folder / "08.asf", fps=120.0)
    assert clip.fps == 120.0 and clip.skeleton.source.rates == ()
