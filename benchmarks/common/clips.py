"""Sets of clips, each named once, with what the policies that ship have learned of them.

known: they were trained on it. validation: never trained on, but settings were chosen by its figures.
test: neither; it is measured for each policy that ships, and nothing is chosen by it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import poise
from poise.body import BodyConfig
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.files import BACKWARDS as IS_BACKWARDS
from poise.jobs.library.files import MIRRORED, matches, motion_files_of, subject_of
from poise.jobs.library.folder import library_of
from poise.jobs.open import open_run
from poise.motion import Clip, trim
from training.tracker import BACKWARDS, HELD_OUT, SIXTY, TWINS

WALK = Path(poise.__file__).parent / "data/walk.bvh"
#: Words of Bandai's styles that are kept for the test.
STYLES = ("_old_", "_giant_", "_tired_", "_elderly_")

Learned = Literal["known", "validation", "test"]


@dataclass(frozen=True)
class ClipSet:
    """A set by its name.

    Attributes:
        title: as subjects of rows state it.
        learned: what the tracker, the policy of keypoints and the generator have learned of it.
        pattern: of files in the folder of data, several with spaces between them; "" for clips of the
            training library.
        without, only: words in their paths of which none, or one, must be there.
    """

    name: str
    title: str
    learned: Learned
    pattern: str = ""
    without: tuple[str, ...] = ()
    only: tuple[str, ...] = ()


SETS = {
    s.name: s
    for s in (
        ClipSet(
            "bandai",
            "Bandai, never learned (validation)",
            "validation",
            "other/bandai_bvh/*.bvh",
            STYLES,
        ),
        ClipSet(
            "bandai-test",
            "Bandai, four styles never looked at (test)",
            "test",
            "other/bandai_bvh/*.bvh",
            (),
            STYLES,
        ),
        ClipSet(
            "held-out",
            "held-out CMU subjects 05, 11, 14",
            "test",
            "cmu_amc/rfc/05_*.amc cmu_amc/11/11_*.amc cmu_bvh/ad/14_14.bvh",
        ),
        ClipSet("library", "recordings and their retimed copies, learned", "known"),
        ClipSet("copies", "mirrored and backwards copies, learned", "known"),
        ClipSet(
            "acrobatics",
            "flips, rolls, cartwheels, spins and subject 90's acrobatics, learned",
            "known",
            only=("_backflip", "_cartwheel", "_roll", "_sideflip", "_spin", "-90_"),
        ),
        ClipSet("subject 49", "CMU subject 49, learned", "known", only=("-49_",)),
        ClipSet(
            "salsa",
            "salsa, partners of dancers that were learned",
            "validation",
            "cmu_bvh/acrnn_salsa/*.bvh",
            tuple(f"/{k:02d}.bvh" for k in (*range(1, 8), 9, 10, 12)),
        ),
        ClipSet("estimators", "files of real pose estimators", "validation", "noisy/*"),
    )
}

#: Clips of which each is imitated by itself: file, skeleton, frames/s where the file's are wrong, title.
#: In flight 90_08 and 90_11 fall with four times gravity at 120 frames per second, with gravity at 60.
RFC = "cmu_amc/rfc"
SINGLE: dict[str, tuple[str, str | None, float | None, str]] = {
    "05_06": (f"{RFC}/05_06.amc", "01.asf", None, "CMU 05_06, dance, never learned"),
    "05_07": (f"{RFC}/05_07.amc", "01.asf", None, "CMU 05_07, dance, never learned"),
    "05_13": (f"{RFC}/05_13.amc", "01.asf", None, "CMU 05_13, dance, never learned"),
    "90_02": (f"{RFC}/90_02.amc", "08.asf", None, "CMU 90_02, cartwheel"),
    "90_05": (f"{RFC}/90_05.amc", "08.asf", None, "CMU 90_05, jump kick"),
    "90_08": (f"{RFC}/90_08.amc", "08.asf", 60.0, "CMU 90_08, side flip"),
    "90_11": (f"{RFC}/90_11.amc", "08.asf", 60.0, "CMU 90_11, handspring"),
    "02_01": ("cmu_amc/02/02_01.amc", None, None, "CMU 02_01, walk"),
    "02_03": ("cmu_amc/02/02_03.amc", None, None, "CMU 02_03, run"),
    "02_04": ("cmu_amc/02/02_04.amc", None, None, "CMU 02_04, jump"),
    "02_05": ("cmu_amc/02/02_05.amc", None, None, "CMU 02_05, punch"),
    **{
        k: (f"deepmimic_txt/humanoid3d_{k}.txt", None, None, f"DeepMimic {k}")
        for k in ("walk", "run", "cartwheel", "backflip", "spin", "kick")
    },
}


@dataclass(frozen=True)
class Places:
    """Folders of the clips.

    Attributes:
        data: the development set with its `INDEX.tsv`. library: the training library of
            `training/README.md`. work: what is kept between commands. smoke: a moment of the walk that
            comes with Poise in place of every clip.
    """

    data: Path
    library: Path
    work: Path
    smoke: bool = False

    def file(self, path: str) -> Path:
        """A file of the development set; the walk in a smoke test."""
        return WALK if self.smoke else self.data / path


def single(places: Places, name: str) -> Clip:
    """One of `SINGLE`."""
    if places.smoke:
        return moment(name)
    file, skeleton, fps, _ = SINGLE[name]
    path = places.data / file
    return read_clip(path, skeleton=path.with_name(skeleton) if skeleton else None, fps=fps)


def moment(name: str = "walk", seconds: float = 1.0) -> Clip:
    """The first second of the walk."""
    clip = read_clip(WALK)
    return trim(clip, 0, round(seconds * clip.fps)).replaced(name=name)


def names_of(places: Places, name: str) -> list[str]:
    """The clips of a set, sorted.

    Raises:
        PoiseError: there are none.
    """
    if places.smoke:
        return ["walk"]
    own = SETS[name]
    found = sorted(files(places, own) if own.pattern else library(places, name))
    if not found:
        where = places.data if own.pattern else places.library
        raise PoiseError(f"holds no clip of the set '{name}'", where, code="no-clips")
    return found


def clip_of(places: Places, name: str, clip: str) -> Clip:
    """A clip of a set."""
    if places.smoke:
        return moment(clip)
    own = SETS[name]
    if not own.pattern:
        return library(places, name)[clip]
    path = files(places, own)[clip]
    # The clips of Residual Force Control have their skeletons by subject.
    skeleton = path.with_name("01.asf" if clip.startswith("05") else "08.asf")
    return read_clip(path, skeleton=skeleton if f"{RFC}/" in path.as_posix() else None)


@cache
def files(places: Places, own: ClipSet) -> dict[str, Path]:
    """The files of a set by their names."""
    if own.name == "estimators":
        folders = sorted(p for p in places.data.glob(own.pattern) if p.is_dir())
        return {f.name: f.path for f in motion_files_of(folders)} if folders else {}
    out = {}
    for file in (f for pattern in own.pattern.split() for f in places.data.glob(pattern)):
        path = file.as_posix()
        if not _holds(path, own.without) and (not own.only or _holds(path, own.only)):
            out[file.stem] = file
    return out


def _holds(path: str, words: Sequence[str]) -> bool:
    return any(w in path for w in words)


@cache
def library(places: Places, name: str) -> dict[str, Clip]:
    """Clips of the training library as the tracker learns them: recordings, or copies made of them."""
    tracker = open_run(None).tracker
    how = LibraryConfig(
        rates=SIXTY,
        leave_out=TWINS,
        mirror=name == "copies",
        backwards=BACKWARDS if name == "copies" else (),
    )
    found, _ = library_of(
        places.library,
        tracker.target,
        tracker.config.sim.control_hz,
        config=how,
        body=tracker.config.body if isinstance(tracker.config.body, BodyConfig) else BodyConfig(),
        cache=places.work / "cache",
        tell=print,
    )
    out = {}
    for c in found:
        made, words = c.name.endswith((MIRRORED, IS_BACKWARDS)), SETS[name].only
        wanted = made == (name == "copies") and (not words or _holds(c.name, words))
        if wanted and not matches(HELD_OUT, c.name, subject_of(c.name)):
            out[c.name] = c
    return out


#: Sources and what names of their clips hold, of which the first that fits counts.
SOURCES: tuple[tuple[str, str], ...] = (
    ("CMU, walks published for prediction", r"expmaps.*walking"),
    ("CMU, runs, jumps and ball games published for prediction", "expmaps"),
    ("DeepMimic", "deepmimic|humanoid3d"),
    ("Bandai", "bandai|^dataset[-_]"),
    ("CMU, dances", "salsa|indian|dance|-05_"),
    ("CMU, martial arts", "martial|kick|heiansyodan"),
    ("CMU, other", ""),
)


def source_of(name: str) -> str:
    """The source of a clip of that name."""
    return next(source for source, pattern in SOURCES if re.search(pattern, name))
