"""The file that says what a run is: its clips, its settings, its body; and where run folders lie.

OUT/                        what a verb wrote: motions, score.json, report.html
OUT/run/                    the run folder itself
    run.safetensors         the run file
    checkpoint.safetensors  the trainer's whole state (`learn.run`)
    policy.safetensors      the policy of a run that came to an end by itself; it needs no help
    log.csv                 the learning curve
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np
from torch import Tensor

from poise.body import BodyTable, Humanoid
from poise.body.humanoid import make_humanoid
from poise.env.help import scale_in
from poise.errors import PoiseError
from poise.formats.own import pack_clips, unpack_clips
from poise.jobs.library.files import same_library
from poise.learn import LATEST, PolicyBundle, load_checkpoint, load_policy, save_checkpoint
from poise.learn.checkpoint import tensors_of
from poise.motion import ClipLibrary, Skeleton
from poise.settings import to_data

#: The file that says what a run is.
RUN_FILE = "run.safetensors"
#: The policy of a run that comes to an end by itself; it needs no help.
FINAL = "policy.safetensors"


class _ClipNote(TypedDict):
    name: str
    fps: float
    cyclic: bool
    names: list[str]
    parents: list[int]
    ends: list[list[Any]]
    source: dict[str, Any]


class _Earlier(TypedDict):
    samples: int
    seconds: float


class _BodyMeta(TypedDict):
    table: dict[str, Any]
    names: list[str]


class _Run(TypedDict):
    kind: Literal["run"]
    config: dict[str, Any]
    clips: list[_ClipNote]


class RunMeta(_Run, total=False):
    """The metadata of a run file.

    source: where the clips are from. character: the identity of the body. earlier: what the policy had
    cost from which the run went on, and table its body. body: that of the run, with the names of the
    clips that are learned; runs of earlier versions are without. rewards: names of those that a program
    gave.
    """

    recipe: str
    source: str
    rewards: list[str]
    character: str
    earlier: _Earlier
    table: dict[str, Any]
    body: _BodyMeta


class InbetweenMeta(TypedDict):
    """The metadata of the run file of an in-betweening network."""

    config: dict[str, Any]
    steps: int


@dataclass(frozen=True, eq=False)
class RunFile:
    """A run file that was read: its metadata, as `RunMeta` says, and its tensors."""

    path: Path
    meta: Mapping[str, Any]
    tensors: Mapping[str, Tensor]

    @property
    def recipe(self) -> str:
        """The recipe's name; runs of the first versions do not name it."""
        return self.meta.get("recipe", "residual-force")

    @property
    def earlier(self) -> Mapping[str, Any]:
        """What the policy had cost that the run went on from."""
        return self.meta.get("earlier", {"samples": 0, "seconds": 0.0})

    def library(self) -> ClipLibrary:
        """The clips that the run learns."""
        try:
            return ClipLibrary(tuple(unpack_clips(self.tensors, self.meta["clips"])))
        except PoiseError as problem:
            raise PoiseError(
                problem.what, problem.where or self.path, problem.hint, code=problem.code
            ) from None

    def table(self) -> BodyTable | None:
        """The body of the policy that the run went on from, None where it made its own."""
        return self._table(self.meta["table"]) if "table" in self.meta else None

    def body(self, skeleton: Skeleton) -> Humanoid | None:
        """The run's body on its clips' skeleton, None where the file does not hold it.

        Raises:
            PoiseError: it is not the body by which the run calls itself.
        """
        if "body" not in self.meta:
            return None
        made = make_humanoid(skeleton, self._table(self.meta["body"]["table"]))
        if made.identity != self.meta.get("character"):
            raise PoiseError(
                "its body is not that of its policy",
                self.path,
                "The file is damaged",
                code="file-damaged",
            )
        return made

    def _table(self, data: Any) -> BodyTable:
        try:
            return BodyTable.from_dict(data)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as problem:
            raise PoiseError(
                f"the body in it cannot be read ({problem})", self.path, code="file-damaged"
            ) from None


def run_folder(path: Path) -> Path:
    """The run folder that `path` names: itself, or the `run` or `learned` folder inside a result.

    Raises:
        PoiseError: there is no run in it.
    """
    for folder in (path, path / "run", path / "learned"):
        if (folder / RUN_FILE).exists():
            return folder
    if not path.exists():
        raise PoiseError(
            "there is no such folder", path, "Give the folder of a result or a run", code="file-missing"
        )
    if (path / "score.json").exists():
        hint = "Its score is score.json and its page report.html; or give the run of the policy"
        raise PoiseError(
            "is a result of poise track, which has no run of its own", path, hint, code="not-a-run"
        )
    what = f"is no run folder: there is no {RUN_FILE} in it"
    raise PoiseError(
        what, path, "Give the folder of a result, or the 'run' folder in it", code="not-a-run"
    )


def read_run(folder: Path) -> RunFile:
    """The run file of a run folder.

    Raises:
        PoiseError: there is none, or it is damaged or of another kind.
    """
    path = folder / RUN_FILE
    if not path.exists():
        path = run_folder(folder) / RUN_FILE
    tensors, meta = load_checkpoint(path, RunMeta)
    return RunFile(path, meta, tensors)


def held_run(
    folder: Path,
    recipe: str,
    config: Any,
    read: Callable[[Mapping[str, Any], Path], Any],
    library: ClipLibrary | None = None,
    source: str | None = None,
) -> RunFile:
    """The run file of the run in a folder, unless it is that of another run.

    Args:
        recipe, config: its name and its settings.
        read: makes the settings of what the file says, also of one of an earlier version.
        library: its clips, where they are at hand. source: where they are from, where that is known; a
            folder that was moved since is followed, see `same_library`.

    Raises:
        PoiseError: another recipe, other settings, another source, or other clips.
    """
    file = read_run(folder)
    if file.recipe != recipe:
        raise PoiseError(
            "the folder holds a run of another recipe",
            folder,
            "Choose another folder",
            code="recipe-differs",
        )
    # As this version reads it, so that a run of an older one is compared in what it knew, too.
    here, there = to_data(config), to_data(read(file.meta["config"], file.path))
    # How long the expert was cloned is over and done; a run keeps its own.
    names = sorted(k for k in here if k != "clone" and here[k] != there[k])
    if names:
        what = f"the folder holds a run with other settings ({', '.join(names)})"
        raise PoiseError(
            what, folder, "Resume it as it is or choose another folder", code="settings-differ"
        )
    clips = file.meta["clips"]
    was, names = file.meta.get("source", "").split(", "), [clip["name"] for clip in clips]
    if source is not None and not same_library(was, source.split(", "), names):
        what = f"the folder holds a run on the library {file.meta.get('source') or 'of a program'}"
        raise PoiseError(
            what, folder, "Give that library, or choose another folder", code="library-differs"
        )
    if library is not None and clips != _as_known(clips, library):
        more = f" and {len(clips) - 6} more" if len(clips) > 6 else ""
        what = f"the folder holds a run of other clips ({', '.join(c['name'] for c in clips[:6])}{more})"
        raise PoiseError(what, folder, "Give those clips, or choose another folder", code="clips-differ")
    return file


def _as_known(clips: Sequence[Mapping[str, Any]], library: ClipLibrary) -> list[dict[str, Any]]:
    """The library packed as `clips` are: a run of an older version knew fewer fields of a source, and a
    file may have been moved since."""
    here: list[dict[str, Any]] = json.loads(json.dumps(pack_clips(library.clips)[1]))
    for old, new in zip(clips, here, strict=False):
        new["source"] = {k: v for k, v in new["source"].items() if k in old["source"]}
        new["source"] |= {k: v for k, v in old["source"].items() if k == "path"}
    return here


def write_run(
    folder: Path,
    clips: ClipLibrary,
    meta: Mapping[str, Any],
    tensors: Mapping[str, Tensor] | None = None,
) -> None:
    """Writes the run file, whole or not at all.

    meta: that of `RunMeta` but for what is said of the clips. tensors: more than those of the clips.
    """
    folder.mkdir(parents=True, exist_ok=True)
    packed, notes = pack_clips(clips.clips)
    save_checkpoint(
        folder / RUN_FILE,
        tensors_of(packed) | dict(tensors or {}),
        {"kind": "run", **meta, "clips": notes},
    )


def body_facts(humanoid: Humanoid, names: tuple[str, ...]) -> dict[str, Any]:
    """What a run file says of its body, so that it need not be made from all clips again."""
    body = {"table": humanoid.table.to_dict(), "names": list(names)}
    return {"character": humanoid.identity, "body": body}


def latest_policy(folder: Path) -> Path:
    """The file of a run's policy: that of the finished run, else the last checkpoint.

    Raises:
        PoiseError: nothing was trained yet.
    """
    path = folder / FINAL if (folder / FINAL).exists() else folder / LATEST
    if not path.exists():
        raise PoiseError(
            "nothing has been trained in it yet",
            folder,
            "Train it with --resume first",
            code="nothing-trained",
        )
    return path


def learning_curve(folder: Path) -> dict[str, np.ndarray]:
    """Columns of the run's CSV by name; empty where nothing was trained."""
    path = next(iter(sorted(folder.glob("*.csv"))), None)
    if path is None:
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = rows[0].keys() if rows else ()
    return {name: np.array([float(r[name] or "nan") for r in rows]) for name in names}


def policy_for(folder: Path, humanoid: Humanoid, most: float) -> tuple[PolicyBundle, dict[str, Any]]:
    """`trained_policy` for a body. most: N, the highest limit of the help at any time."""
    path = latest_policy(folder)
    policy = load_policy(path, character=humanoid.identity)
    if path.name == FINAL:
        return policy, policy.meta | policy.meta.get("metadata", {}) | {"help_limit": 0.0}
    left = scale_in(load_checkpoint(path)[0]) * most
    if not math.isfinite(left):
        raise PoiseError("the help that is left in it is no number", path, code="file-damaged")
    return policy, {**policy.meta, "help_limit": left}
