"""A run of the perpetual controller in a folder: begun, trained to its end, evaluated, opened again.

run/
    run.safetensors         the clips and the settings, all that the run needs to be rebuilt
    checkpoint.safetensors  the stage in progress with everything that decides what comes next
    primitive-K.safetensors each primitive as it was when its stage ended
    policy.safetensors      the policy of the finished run
    log.csv, success.csv    the learning curve; every evaluation of every clip
    result.json             what the finished run came to, without help
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from poise import __version__
from poise.body import BodyConfig
from poise.errors import PoiseError
from poise.learn import Until, load_checkpoint, save_checkpoint
from poise.learn.checkpoint import write_atomic
from poise.learn.run import interruptible
from poise.motion import ClipLibrary
from poise.motion.pack import pack_clips, unpack_clips
from poise.recipes.expert import Beginning
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import RECIPE, Perpetual, build
from poise.recipes.perpetual_data import LibraryConfig, library_of, split
from poise.recipes.perpetual_eval import FINAL_STAGE, ClipResults, evaluate_clips
from poise.recipes.perpetual_progress import Progress
from poise.recipes.perpetual_stages import Course
from poise.recipes.session import FINAL, RUN_FILE

RESULT = "result.json"


@dataclass(frozen=True, eq=False)
class PerpetualResult:
    """How a training ended.

    last: the last iteration, None where nothing was left to do. interrupted: by Ctrl-C; then there is no
    `results`, which are those of the finished policy on every clip, without help. solved: nothing
    failed any more before the time was over. primitives: how many were trained.
    """

    last: Progress | None
    interrupted: bool
    solved: bool
    primitives: int
    results: ClipResults | None


def clips_of(
    folder: Path,
    body: BodyConfig,
    hold_out: Sequence[str] = (),
    leave_out: Sequence[str] = (),
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[ClipLibrary, tuple[str, ...]]:
    """The clips of a folder on one skeleton, see `library_of`, and sentences on what became of them.

    hold_out: clips and performers that are not learned from, see `split`. leave_out: regular expressions
    of clips that are not even read.
    """
    config = LibraryConfig(leave_out=tuple(leave_out))
    library, report = library_of(folder, config=config, body=body, tell=tell)
    notes = tuple(report.sentences())
    if not hold_out:
        return library, notes
    parts = split(library, hold_out)
    return parts.train, (*notes, f"{len(parts.test)} clips are held out.")


def begin(
    folder: Path, library: ClipLibrary, config: Perpetual, source: str = "", device: str = "cpu"
) -> Imitation:
    """Builds the task and writes the run file; a folder that holds another run is refused.

    source: where the clips are from, by which `resume` knows them.

    Raises:
        PoiseError: a single clip, another run in the folder, or not enough memory.
    """
    if len(library) < 2:
        raise PoiseError(
            f"a library needs at least 2 clips, and there is only '{library.names[0]}'",
            hint="Use poise imitate for a single clip",
        )
    path, said = folder / RUN_FILE, to_json(config)
    tensors, notes = pack_clips(library.clips)
    notes = json.loads(json.dumps(notes))
    if path.exists():
        meta = _checked(folder, said, source)
        if meta["clips"] != notes:
            raise PoiseError(
                f"the folder holds a run of other clips ({len(meta['clips'])}, here {len(notes)})",
                folder,
                "Give the library it was begun with, or choose another folder",
            )
    imitation = build(library, config)
    imitation.check_room(config.num_envs, device)
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        meta = {"kind": "run", "recipe": RECIPE["name"], "config": said, "clips": notes}
        character = imitation.humanoid.identity
        save_checkpoint(path, tensors, {**meta, "source": source, "character": character})
    return imitation


def resume(folder: Path, config: Perpetual, source: str = "", device: str = "cpu") -> Imitation:
    """The task of the run in a folder, from that folder alone, if it has these settings.

    Raises:
        PoiseError: other settings, another source of clips, or another recipe.
    """
    _checked(folder, to_json(config), source)
    imitation = reopen(folder)
    imitation.check_room(config.num_envs, device)
    return imitation


def _checked(folder: Path, config: dict[str, Any], source: str) -> dict[str, Any]:
    """What the run file says, unless it is that of another run."""
    _, meta = load_checkpoint(folder / RUN_FILE)
    if meta.get("recipe") != RECIPE["name"]:
        raise PoiseError("the folder holds a run of another recipe", folder, "Choose another folder")
    found = meta["config"]
    names = sorted(k for k in {*config, *found} if config.get(k) != found.get(k))
    if names:
        raise PoiseError(
            f"the folder holds a run with other settings ({', '.join(names)})",
            folder,
            "Resume it as it is or choose another folder",
        )
    if meta["source"] != source:
        raise PoiseError(
            f"the folder holds a run on the library {meta['source'] or 'of a program'}",
            folder,
            "Give that library, or choose another folder",
        )
    return meta


def reopen(folder: Path) -> Imitation:
    """The task of an existing run, rebuilt from its folder alone."""
    tensors, meta = load_checkpoint(folder / RUN_FILE)
    library = ClipLibrary(tuple(unpack_clips(tensors, meta["clips"])))
    return build(library, from_json(meta["config"]))


def train(
    imitation: Imitation,
    folder: Path,
    until: Until,
    on_iteration: Callable[[Progress], bool | None] | None = None,
    threads: int = 0,
    tensorboard: bool = True,
    device: str = "cpu",
    beginning: Beginning | None = None,
    save_s: float = 30.0,
) -> PerpetualResult:
    """Trains all stages, or goes on with them, until nothing fails or a limit is reached.

    Args:
        until: limits of all stages together, over all resumed runs.
        on_iteration: called after each; returning False ends the call as Ctrl-C does.
        device: "cpu" or "cuda"; no part of the run.
        save_s: seconds between checkpoints, beside those at evaluations.

    Ctrl-C ends it after the present iteration with a checkpoint, a second one at once.
    """
    course = Course(imitation, folder, until, threads, device, tensorboard, beginning, save_s)
    last, asked = None, False
    try:
        if not (course.finished or course.share >= 1):
            # What is in it is no longer the policy of a finished run.
            for name in (FINAL, RESULT):
                (folder / name).unlink(missing_ok=True)
        with interruptible() as interrupt:
            while not (course.finished or course.share >= 1 or interrupt.is_set() or asked):
                last = course.iterate()
                try:
                    asked = on_iteration is not None and on_iteration(last) is False
                except KeyboardInterrupt:
                    interrupt.set()
            interrupted = asked or interrupt.is_set()
        if last is not None:
            course.save()
        stopped = interrupted and not course.finished and course.share < 1
        results = None if stopped else finish(course)
        return PerpetualResult(last, stopped, course.finished, course.primitives, results)
    finally:
        course.close()


def finish(course: Course) -> ClipResults:
    """The policy as a file, and what it does with every clip, without help, as `result.json`."""
    policy, t, imitation = course.policy(), course.trainer, course.imitation
    facts = {
        "method": imitation.config.method, "seed": imitation.config.seed, "stage": course.stage.name,
        "primitives": course.primitives, "solved": course.finished, "iterations": course.iteration,
    }  # fmt: skip
    cost = {"samples": t.samples, "seconds": round(t.seconds, 1)}
    results = evaluate_clips(imitation, policy, None, 0.0, course.threads, course.device)
    course.history.add(course.iteration, FINAL_STAGE, 0.0, results)
    policy.save(course.folder / FINAL, t.character, facts | cost)
    names, owner = imitation.library.names, course.ledger.owner.tolist()
    rows = [
        {
            "clip": names[c], "succeeded": bool(results.succeeded[k]), "frames": int(results.frames[k]),
            "tracked": int(results.tracked[k]), "mpjpe_mm": round(float(results.mpjpe_mm[k]), 3),
            "mpjpe_global_mm": round(float(results.global_mm[k]), 3), "primitive": owner[c] + 1,
        }
        for k, c in enumerate(results.clip.tolist())
    ]  # fmt: skip
    said = facts | cost | {
        "version": __version__, "help_n": 0.0, "succ": results.rate, "clips": len(rows),
        "mpjpe_global_mm": round(results.error_mm, 3),
        "hardest": [names[c] for c in results.hardest(20)], "per_clip": rows,
    }  # fmt: skip
    write_atomic(course.folder / RESULT, json.dumps(said, indent=2, allow_nan=False).encode())
    return results


def to_json(config: Perpetual) -> dict[str, Any]:
    """The settings as JSON data."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(data: Mapping[str, Any]) -> Perpetual:
    """Settings from JSON data.

    Raises:
        PoiseError: they are of another version.
    """
    try:
        return _filled(Perpetual(), data)
    except (TypeError, KeyError, AttributeError) as problem:
        raise PoiseError(
            f"the run was made by another version of Poise ({problem})", hint="Train it again"
        ) from None


def _filled(default: Any, data: Mapping[str, Any]) -> Any:
    """A dataclass of the default's type; its own dataclasses are filled likewise, lists are tuples."""
    values = {
        k: _filled(getattr(default, k), v) if isinstance(v, Mapping) else _tuples(v)
        for k, v in data.items()
    }
    return type(default)(**values)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
