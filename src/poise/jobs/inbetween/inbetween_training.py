"""In-betweening networks from a folder of clips: Harvey et al. 2020, and a transformer.

| paper | here |
|---|---|
| Harvey et al., section 3: the recurrent transition network | `papers.skeleton2humanoid.rtn` |
| its windows, split by actor, L2Q, L2P, NPSS | `synthesis.windows`, `metrics.gap_errors`, `score.gaps` |
| Skeleton2Humanoid, Eqs. 1 to 4: test-time adaptation | `learn.inbetween_model.adapt` |
| delta to interpolation (Oreshkin et al.), relative times (Qin et al.) | `learn.between` |

A run folder holds `frames.safetensors` (the packed library), `run.safetensors` (settings),
`checkpoint.safetensors`, the log, and at the end `model.safetensors`.
"""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

import copy
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch

from poise.errors import PoiseError
from poise.formats.own import pack_clips
from poise.formats.table import READERS
from poise.jobs.inbetween.inbetween_settings import Contacts, Inbetween
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.folder import library_of
from poise.kinematics.feet import standing_labels
from poise.kinematics.rate import read_clip
from poise.learn.between import Between, BetweenObjective
from poise.learn.checkpoint import (
    load_checkpoint,
    load_module,
    make_generator,
    prefixed,
    save_checkpoint,
    tensors_of,
)
from poise.learn.inbetween_model import (
    MODEL,
    BlockStats,
    GapNetwork,
    InbetweenModel,
    InbetweenTrainer,
    Objective,
    make_net,
    save_model,
    train_inbetween,
)
from poise.learn.transition import SkeletonLayout
from poise.learn.window_sampler import FrameData, Sampler
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize
from poise.score.gaps import TestSet, deviation, evaluate, test_set
from poise.settings import from_data, imported, to_data
from poise.synthesis.windows import (
    LAFAN1_FACING,
    FrameBank,
    joined,
    mirrored,
    pack_frames,
    step_contacts,
    without_still_root,
)


def library_bank(
    library: Path,
    cache: Path,
    fps: float = 30.0,
    tell: Callable[[str], None] = lambda _: None,
    onto: str | None = None,
    reading: LibraryConfig | None = None,
) -> tuple[FrameBank, tuple[str, ...]]:
    """All motion files under a folder (or one file) that share the most common skeleton.

    Files that cannot be read and clips of other skeletons are left out, each with a sentence in the
    notes. With `onto`, a motion file, or with `reading`, all clips are brought onto one skeleton, see
    `library_of`. The bank is written to `cache` and taken from there while the files stay as they are.

    Raises:
        PoiseError: no file could be used.
    """
    files = motion_files(library)
    how = None
    if onto is not None or reading is not None:
        # Nothing is simulated: feet are learned as they are.
        reading = replace(reading or LibraryConfig(), level=False)
        how = json.loads(json.dumps([onto, asdict(reading)]))
    key = [[str(f.relative_to(library.parent)), f.stat().st_size, f.stat().st_mtime_ns] for f in files]
    if cache.exists():
        tensors, meta = load_checkpoint(cache)
        if (meta.get("key"), meta.get("fps"), meta.get("how")) == (key, fps, how):
            return _bank(tensors, meta), tuple(meta["notes"])
    if how is None:
        common, notes = of_one_skeleton(*read_all(files, tell))
    else:
        made, report = library_of(library, onto, fps, config=reading, tell=tell)
        common, notes = list(made.clips), tuple(report.sentences())
    bank = pack_frames(common, fps, LAFAN1_FACING if _is_lafan1(common[0]) else None)
    tensors, meta = _packed(bank)
    save_checkpoint(cache, tensors, {**meta, "key": key, "notes": list(notes), "fps": fps, "how": how})
    return bank, notes


def motion_files(library: Path) -> list[Path]:
    """Files under a folder with a suffix that a reader knows, in order.

    Raises:
        PoiseError: there is no such folder, or nothing in it.
    """
    if library.is_file():
        return [library]
    suffixes = {s for reader in READERS for s in reader.suffixes} - {".asf", ".json", ".txt"}
    files = sorted(f for f in library.rglob("*") if f.suffix.lower() in suffixes and f.is_file())
    if not files:
        what = "there is no motion file in it" if library.is_dir() else "there is no such folder"
        raise PoiseError(
            what,
            library,
            "Give a folder with BVH or AMC files",
            code="no-motion-files" if library.is_dir() else "file-missing",
        )
    return files


def read_all(files: list[Path], tell: Callable[[str], None]) -> tuple[list[Clip], tuple[str, ...]]:
    """The clips of all files that can be read, and a sentence for each of the others."""
    clips, notes = list[Clip](), list[str]()
    for k, file in enumerate(files, 1):
        try:
            clips.append(read_clip(file))
        except PoiseError as problem:
            notes.append(f"Left out: {problem}")
        if k % 200 == 0:
            tell(f"{k} of {len(files)} files read")
    if not clips:
        raise PoiseError(
            f"none of the {len(files)} files could be read", hint=notes[0], code="no-usable-files"
        )
    return clips, tuple(notes)


def of_one_skeleton(clips: list[Clip], notes: tuple[str, ...]) -> tuple[list[Clip], tuple[str, ...]]:
    """The clips of the most common hierarchy, and a sentence about the others."""

    def kind(clip: Clip) -> tuple[Any, ...]:
        skeleton = without_still_root(clip).skeleton
        return skeleton.names, skeleton.parents

    kinds = [kind(clip) for clip in clips]
    best, count = Counter(kinds).most_common(1)[0]
    if count < len(clips):
        others = [clip.name for clip, k in zip(clips, kinds, strict=True) if k != best]
        notes = (*notes, f"Left out: {len(others)} clips of other skeletons, such as '{others[0]}'")
    return [clip for clip, k in zip(clips, kinds, strict=True) if k == best], notes


def _is_lafan1(clip: Clip) -> bool:
    names = clip.skeleton.names
    return len(names) == 22 and names[0] == "Hips" and "Spine2" in names and "LeftToe" in names


def _packed(bank: FrameBank) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    tensors = {k: getattr(bank, k) for k in ("root", "rot", "offsets", "first")}
    meta = {k: list(getattr(bank, k)) for k in ("names", "parents", "clips", "feet", "facing")}
    return tensors, {**meta, "bank_fps": bank.fps, "ends": [[j, list(tip)] for j, tip in bank.ends]}


def _bank(tensors: dict[str, torch.Tensor], meta: dict[str, Any]) -> FrameBank:
    x, y, z = meta["facing"]
    ends = tuple((j, (a, b, c)) for j, (a, b, c) in meta.get("ends", ()))
    return FrameBank(
        tuple(meta["names"]),
        tuple(meta["parents"]),
        meta["bank_fps"],
        tensors["root"],
        tensors["rot"],
        tensors["offsets"],
        tensors["first"],
        tuple(meta["clips"]),
        tuple(meta["feet"]),
        (x, y, z),
        ends,
    )


RUN_FILE = "run.safetensors"
FRAMES = "frames.safetensors"


@dataclass(frozen=True, eq=False)
class Task:
    """A library ready to learn from: training frames, the bank of all clips, the validation windows
    (None where no clip is held out), and L2P's deviation."""

    config: Inbetween
    bank: FrameBank
    data: FrameData
    validation: TestSet | None
    notes: tuple[str, ...] = ()


def prepare(bank: FrameBank, config: Inbetween, notes: tuple[str, ...] = ()) -> Task:
    """The split of a library, its statistics and labels."""
    protocol = config.protocol
    train = protocol.split(bank, "train")
    # What never moves in a library has no deviation to divide by.
    std = deviation(train, protocol).clamp_min(1e-3)
    layout = SkeletonLayout(bank.parents, bank.feet, bank.facing)
    if config.mirror:
        train = joined(train, mirrored(train))
    data = frame_data(train, layout, std, config.contacts)
    held = None
    if config.validation is not None:
        held = test_set(protocol.split(bank, "validation"), std, protocol)
    return Task(config, bank, data, held, notes)


def frame_data(bank: FrameBank, layout: SkeletonLayout, std: torch.Tensor, rule: Contacts) -> FrameData:
    """A bank as float32 tensors with contact labels per clip."""
    points = bank.positions()[:, list(bank.feet)]
    parts = cast("tuple[torch.Tensor, ...]", points.split(torch.diff(bank.first).tolist()))
    if rule == "floor":
        labels = [torch.from_numpy(x) for x in standing_labels([p.numpy() for p in parts], bank.fps)]
    else:
        labels = [step_contacts(part, rule) for part in parts]
    return FrameData(
        layout, bank.root.float(), bank.rot.float(), torch.cat(labels).float(), bank.offsets.float(),
        bank.first, std.float(),
    )  # fmt: skip


def objective(task: Task, steps: int) -> Objective:
    """A fresh network, calibrated to the data, with how it learns."""
    c = task.config
    net = make_net(c.net, task.data.layout, c.between if c.net == "transformer" else c.rtn, c.seed)
    sampler = Sampler(task.data)
    drawn = sampler.draw(512, min(40, c.longest + 5), make_generator(c.seed, "calibration"))
    net.calibrate(drawn.root, drawn.rot, drawn.offsets)
    if isinstance(net, Between):
        return BetweenObjective(net, c.between_training, task.data.std, steps)
    critics = make_generator(c.seed, "critics")
    recurrent = imported("poise.papers.skeleton2humanoid.rtn:RTNObjective")
    return recurrent(net, c.rtn_training, task.data.std, steps, critics)


def steps_in(task: Task, minutes: float, trials: int = 6) -> int:
    """How many steps this machine makes in `minutes`, measured on a network that is thrown away."""
    own = objective(task, 1000)
    sampler, generator = Sampler(task.data), torch.Generator().manual_seed(0)
    # A late step is a dear one where transitions grow longer.
    own.step(sampler, 600, generator)
    begun = time.perf_counter()
    for k in range(trials):
        own.step(sampler, 600 + k, generator)
    return max(20, int(60 * minutes / ((time.perf_counter() - begun) / trials)))


def begin(
    folder: Path, library: Path, config: Inbetween, minutes: float, steps: int | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Task, int]:  # fmt: skip
    """Reads the library (once; then its packed frames) and fixes the number of steps.

    Returns:
        The task, and the steps of the whole training: those of the run that is in the folder, else
        `steps`, else as many as fit into `minutes` here.

    Raises:
        PoiseError: the folder holds a run with other settings, or no clip can be used.
    """
    run = folder / RUN_FILE
    said = to_data(config)
    if run.exists():
        _, meta = load_checkpoint(run)
        if from_data(Inbetween, meta.get("config", {}), run) != from_data(Inbetween, said):
            hint = "Resume it as it is or choose another folder"
            raise PoiseError(
                "the folder holds a run with other settings", folder, hint, code="settings-differ"
            )
        steps = int(meta["steps"])
    how = (config.onto, config.reading)
    bank, notes = library_bank(library, folder / FRAMES, config.fps, tell, *how)
    task = prepare(bank, config, notes)
    steps = steps or steps_in(task, minutes)
    if not run.exists():
        save_checkpoint(run, {}, {"kind": "inbetween run", "config": said, "steps": steps})
    return task, steps


def train(
    task: Task, folder: Path, steps: int, minutes: float | None = None,
    on_block: Callable[[BlockStats], bool | None] | None = None, tensorboard: bool = True,
    validate_every: int = 1000, first: InbetweenModel | None = None,
) -> tuple[InbetweenModel, BlockStats | None, bool]:  # fmt: skip
    """Trains, or goes on training, in `folder`; the averaged network is written as a model.

    minutes: of this call; the schedule still is that of all `steps`. first: the weights that a new
    training begins from; by default drawn ones.
    """
    c = task.config
    meta = {"config": to_data(c), "clips": len(task.bank.clips)}
    learned = objective(task, steps)
    if first is not None:
        net = learned.modules()["net"]
        load_module(net, prefixed("net", first.net.state_dict()), "net")
    trainer = InbetweenTrainer(
        learned,
        Sampler(task.data, c.stretch),
        c.seed,
        steps,
        c.batch,
        ema=c.ema,
        metadata=meta,
    )
    check = None if task.validation is None else validation(task)
    stats, stopped = train_inbetween(
        trainer, folder, minutes, on_block, check, validate_every, tensorboard=tensorboard
    )
    model = as_model(task, trainer)
    save_model(folder / MODEL, model)
    return model, stats, stopped


def as_model(task: Task, trainer: InbetweenTrainer) -> InbetweenModel:
    """The averaged network with what is needed to use it."""
    net, c = cast("GapNetwork", copy.deepcopy(trainer.averaged).eval()), task.config
    meta: dict[str, Any] = {
        "name": c.name, "seed": c.seed, "step": trainer.step, "steps": trainer.steps,
        "seconds": round(trainer.seconds, 1), "clips": len(task.bank.clips),
    }  # fmt: skip
    bones = task.data.offsets.mean(0)
    arrays, notes = pack_clips([example_of(task.bank)])
    shown = tensors_of(arrays), notes
    return InbetweenModel(c.net, net, task.bank.names, bones, c.fps, c.longest, 10, meta, shown)


def example_of(bank: FrameBank, frames: int = 90) -> Clip:
    """Poses of the longest clip, evenly spread, on its own bones: they show how the skeleton stands."""
    sizes = torch.diff(bank.first)
    c = int(sizes.argmax())
    rows = bank.first[c] + torch.linspace(0, int(sizes[c]) - 1, min(frames, int(sizes[c]))).long()
    skeleton = Skeleton(bank.names, bank.parents, bank.offsets[c].double().numpy(), bank.ends)
    root, rot = bank.root[rows].double().numpy(), normalize(bank.rot[rows].double()).numpy()
    return Clip(skeleton, root, rot, bank.fps, "example")


def validation(task: Task, lengths: tuple[int, ...] = (5, 15, 30)) -> Callable[..., Mapping[str, float]]:
    """Figures of a network on the validation windows."""
    held = task.validation
    if held is None:
        raise PoiseError("no clip is held out for validation", code="none-held-out")

    def check(net: Any) -> dict[str, float]:
        rows = evaluate(net, held, lengths)
        out = {f"l2p_{r.length}": r.l2p for r in rows} | {f"l2q_{r.length}": r.l2q for r in rows}
        return {k: v for k, v in out.items() if math.isfinite(v)}

    return check


#: Expected figures: see `results/inbetween-complete.csv`.
RECIPE: dict[str, Any] = {"name": "inbetween", "config": Inbetween, "build": prepare, "expected": {}}
