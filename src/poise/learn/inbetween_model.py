"""Trains, stores and adapts a network of kinematic motion."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import copy
import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, TypeVar, cast

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.adam import Adam, Optimizer
from poise.learn.checkpoint import (
    LATEST,
    ModelMeta,
    State,
    alone,
    load_checkpoint,
    load_module,
    load_optimizer_state,
    make_generator,
    optimizer_state,
    prefixed,
    remove_partial,
    save_checkpoint,
    set_generator,
    take,
    under,
)
from poise.learn.rollout import TrainingError
from poise.learn.run import Log, interruptible
from poise.learn.transition import FilledGap, Known, SkeletonLayout, TransitionNet, joint_positions
from poise.settings import Checked, Count, NotNegative, Positive, Range, check_data, from_data, imported

#: Times that saving takes, which pass until the next checkpoint at least.
_SAVING = 20.0


class Objective(Protocol):
    """How a network learns from windows; the trainer only repeats it and keeps its state."""

    optimizers: dict[str, Optimizer]

    def modules(self) -> Mapping[str, nn.Module]:
        """Everything with weights, by name; "net" is the network itself."""
        ...

    def step(self, sampler: Any, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        """One update of step number `step`, and its figures, among them "loss"."""
        ...


@dataclass(frozen=True)
class BlockStats:
    """What one block of steps did; all but the times are the same for the same seed."""

    step: int
    """Steps so far."""
    steps: int
    """Steps of the whole training."""
    samples: int
    """Windows learned from so far."""
    parts: Mapping[str, float]
    """Means of the figures over the block."""
    seconds: float
    """Training time over all resumed runs."""
    samples_per_s: float

    @property
    def left(self) -> float:
        """Seconds to the end, as fast as so far."""
        return self.seconds * (self.steps - self.step) / max(1, self.step)


class InbetweenTrainer:
    """Repeats an objective's step; the averaged weights (EMA) are what is used afterwards.

    Args:
        objective: made for `steps` steps.
        sampler: what the objective draws its windows from.
        seed: of the windows that are drawn.
        steps: of the whole training.
        block: steps between two reports.
        ema: how much of the averaged weights stays at each step; early steps count less.
        metadata: JSON data that every checkpoint carries.
    """

    def __init__(
        self,
        objective: Objective,
        sampler: Any,
        seed: int = 0,
        steps: int = 20_000,
        batch: int = 64,
        block: int = 50,
        ema: float = 0.999,
        metadata: Mapping[str, Any] | None = None,
    ):
        if min(steps, batch, block) < 1 or not 0 <= ema < 1:
            raise PoiseError(
                f"steps, batch and block must be at least 1 and ema in [0, 1), got {ema}",
                code="out-of-range",
            )
        self.objective, self.sampler = objective, sampler
        self.steps, self.batch, self.block, self.ema = steps, batch, block, ema
        self.metadata, self.seed = dict(metadata or {}), seed
        self.generator = make_generator(seed, "in-between windows")
        self.averaged = copy.deepcopy(objective.modules()["net"]).requires_grad_(False)
        self.step = 0
        self.seconds: float = 0.0

    @property
    def done(self) -> bool:
        """Whether all steps are made."""
        return self.step >= self.steps

    def iterate(self) -> BlockStats:
        """One block of steps.

        Raises:
            TrainingError: the loss is not finite.
        """
        begun = time.perf_counter()
        sums: dict[str, Tensor] = {}
        counts: dict[str, int] = {}
        count = min(self.block, self.steps - self.step)
        for _ in range(count):
            for name, value in self.objective.step(self.sampler, self.step, self.generator).items():
                sums[name] = sums.get(name, torch.zeros(())) + value
                counts[name] = counts.get(name, 0) + 1
            self._average()
            self.step += 1
        parts = {k: float(v) / counts[k] for k, v in sums.items()}
        if not math.isfinite(parts.get("loss", 0.0)):
            raise TrainingError(
                f"the loss at step {self.step} is not finite",
                hint="Lower the lr",
                code="training-diverged",
            )
        seconds = time.perf_counter() - begun
        self.seconds += seconds
        rate = count * self.batch / max(seconds, 1e-9)
        return BlockStats(self.step, self.steps, self.step * self.batch, parts, self.seconds, rate)

    @torch.no_grad()
    def _average(self) -> None:
        # The first steps would otherwise weigh as much as a thousand later ones.
        keep = min(self.ema, (1 + self.step) / (10 + self.step))
        own = self.objective.modules()["net"]
        for a, b in zip(self.averaged.parameters(), own.parameters(), strict=True):
            a.lerp_(b, 1 - keep)
        for a, b in zip(self.averaged.buffers(), own.buffers(), strict=True):
            a.copy_(b)

    def state(self) -> State:
        """Copies of everything that training goes on from."""
        out = prefixed("averaged", self.averaged.state_dict())
        for name, module in self.objective.modules().items():
            out |= prefixed(f"module/{name}", module.state_dict())
        for name, optimizer in self.objective.optimizers.items():
            out |= prefixed(f"optimizer/{name}", optimizer_state(optimizer))
        out["generator/windows"] = self.generator.get_state().clone()
        out["counters"] = torch.tensor([self.step, self.seconds], dtype=torch.float64)
        return out

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned, with networks of the same sizes."""
        load_module(self.averaged, state, "averaged")
        for name, module in self.objective.modules().items():
            load_module(module, state, f"module/{name}")
        for name, optimizer in self.objective.optimizers.items():
            load_optimizer_state(optimizer, under(f"optimizer/{name}", state))
        set_generator(self.generator, take(state, "generator/windows"))
        step, self.seconds = take(state, "counters").tolist()
        self.step = int(step)

    def save(self, path: Path) -> None:
        """Writes the whole state; `load` goes on from it."""
        meta = {"kind": "inbetween trainer", "seed": self.seed, "steps": self.steps, "step": self.step,
                "metadata": self.metadata}  # fmt: skip
        save_checkpoint(path, self.state(), meta)

    def load(self, path: Path) -> dict[str, Any]:
        """Goes on from a checkpoint and returns its metadata.

        Raises:
            PoiseError: it is of another kind, or was made with other settings or data.
        """
        tensors, meta = load_checkpoint(path)
        if meta.get("kind") != "inbetween trainer":
            raise PoiseError(
                "the checkpoint is of another kind of training", path, code="wrong-file-kind"
            )
        same = (meta["steps"], meta["seed"]) == (self.steps, self.seed)
        if not same or meta["metadata"] != self.metadata:
            raise PoiseError(
                "the checkpoint was made with other settings or another training set", path,
                "Resume it as it is or choose another folder", code="settings-differ",
            )  # fmt: skip
        self.load_state(tensors)
        return meta


@alone
def train_inbetween(
    trainer: InbetweenTrainer,
    folder: Path,
    minutes: float | None = None,
    on_block: Callable[[BlockStats], bool | None] | None = None,
    validate: Callable[[nn.Module], Mapping[str, float]] | None = None,
    validate_every: int = 1000,
    save_every: float = 60.0,
    tensorboard: bool = True,
) -> tuple[BlockStats | None, bool]:
    """Trains to the last step, for `minutes` of this call, or until Ctrl-C; the state is saved.

    Args:
        folder: holds `checkpoint.safetensors` and the log; what is there is gone on with.
        validate: figures of the averaged network, logged every `validate_every` steps.
        save_every: seconds between checkpoints at most; every block is saved where that costs little.

    Returns:
        The last block (None where nothing was left to do) and whether it was interrupted.
    """
    path, begun, stats = folder / LATEST, time.monotonic(), None
    folder.mkdir(parents=True, exist_ok=True)
    if path.exists():
        trainer.load(path)
    remove_partial(folder)
    # A kill loses what was learned since; saving may take a twentieth of the time.
    log, saved, due = Log(folder, trainer.step, tensorboard), time.monotonic(), 0.0
    try:
        with interruptible() as interrupt:
            stop = trainer.done
            while not stop and not interrupt.is_set():
                before = trainer.step
                stats = trainer.iterate()
                late = minutes is not None and time.monotonic() - begun >= 60 * minutes
                stop = trainer.done or late
                row = {"iteration": stats.step, "samples": stats.samples, **stats.parts}
                crossed = before // validate_every != trainer.step // validate_every
                if validate is not None and (crossed or stop):
                    row |= {f"validation/{k}": v for k, v in validate(trainer.averaged).items()}
                    stats = dataclasses.replace(stats, parts={k: float(v) for k, v in row.items()})
                row |= {"time/seconds": stats.seconds, "time/samples_per_s": stats.samples_per_s}
                log.write(row)
                if stop or interrupt.is_set() or time.monotonic() - saved >= due:
                    start = time.monotonic()
                    log.flush()
                    trainer.save(path)
                    saved = time.monotonic()
                    due = min(save_every, _SAVING * (saved - start))
                if on_block is not None and on_block(stats) is False:
                    stop = True
            interrupted = interrupt.is_set()
            trainer.save(path)
    finally:
        log.close()
    return stats, interrupted


#: The file in a model's folder.
MODEL = "model.safetensors"
#: The networks by name: the places of its class and of its sizes.
NETWORKS = {
    "transformer": ("poise.learn.between:Between", "poise.learn.between:BetweenConfig"),
    "rtn": ("poise.papers.skeleton2humanoid.rtn:RTN", "poise.papers.skeleton2humanoid.rtn:RTNConfig"),
}


class GapNetwork(TransitionNet, Protocol):
    """A network that a file keeps."""

    config: Any

    def calibrate(self, root: Tensor, rot: Tensor, offsets: Tensor) -> None:
        """Takes the scales of its inputs from windows."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        ...


@dataclass(frozen=True, eq=False)
class InbetweenModel:
    """A network ready to use.

    Attributes:
        names: joints, in order.
        offsets: `(J, 3)` m, bones of the training set (the mean over its clips).
        fps: frames per second.
        longest: frames of the longest gap it was trained for.
        past: frames before the gap that it was trained with at most.
        meta: data set, seed, steps, how it was made.
        example: tensors and JSON notes of a clip as `formats.own` packs it, which shows how the
            skeleton stands; None where clips of other skeletons are not to be brought onto it.
    """

    kind: str
    net: GapNetwork
    names: tuple[str, ...]
    offsets: Tensor
    fps: float
    longest: int
    past: int = 10
    meta: Mapping[str, Any] = field(default_factory=dict[str, Any])
    example: tuple[State, list[Any]] | None = None

    @property
    def layout(self) -> SkeletonLayout:
        """The skeleton as the network sees it."""
        return self.net.layout


def make_net(kind: str, layout: SkeletonLayout, config: Any, seed: int) -> Any:
    """A fresh network with weights from the seed.

    Raises:
        PoiseError: another kind than those of `NETWORKS`.
    """
    net, sizes = map(imported, NETWORKS.get(kind, NETWORKS["transformer"]))
    if kind not in NETWORKS or not isinstance(config, sizes):
        raise PoiseError(
            f"there is no in-betweening network '{kind}' of such sizes",
            hint=f"Known: {', '.join(NETWORKS)}",
            code="unknown-choice",
        )
    return net(layout, config, generator=torch.Generator().manual_seed(seed))


def save_model(path: Path, model: InbetweenModel, half: bool = False) -> None:
    """Writes a model atomically; `half` keeps weights in half precision (a few MB)."""
    tensors = {k: v.half() if half else v for k, v in model.net.state_dict().items()}
    meta = {
        "kind": "inbetween model",
        "net": model.kind,
        "config": dataclasses.asdict(model.net.config),
        "layout": dataclasses.asdict(model.layout),
        "names": list(model.names),
        "fps": model.fps,
        "longest": model.longest,
        "past": model.past,
        "meta": dict(model.meta),
    }
    tensors = prefixed("net", tensors) | {"offsets": model.offsets}
    if model.example is not None:
        tensors |= prefixed("example", model.example[0])
        meta["example"] = model.example[1]
    save_checkpoint(path, tensors, meta)


def load_model(path: Path) -> InbetweenModel:
    """The model in a file, or in a folder that holds `model.safetensors`; float32.

    Raises:
        PoiseError: there is none, it is damaged, or of another version.
    """
    path = path / MODEL if path.is_dir() else path
    if not path.exists():
        hint = "Train one with poise train inbetween"
        raise PoiseError("there is no in-betweening model", path, hint, code="file-missing")
    tensors, meta = load_checkpoint(path)
    if meta.get("kind") != "inbetween model":
        raise PoiseError("the file is not an in-betweening model", path, code="wrong-file-kind")
    check_data(ModelMeta, meta, path)
    hint = "Train it again"
    if not (meta["fps"] > 0 and min(meta["longest"], meta["past"]) > 0):
        raise PoiseError(
            "its rate and the lengths that it fills must be above 0", path, hint, code="file-damaged"
        )
    try:
        said = meta["layout"]
        layout = SkeletonLayout(tuple(said["parents"]), tuple(said["feet"]), tuple(said["facing"]))
        kind = imported(NETWORKS[meta["net"]][1])
        said = dict(meta["config"])
        if meta["net"] == "transformer":
            # Networks of earlier versions see no speeds and do not say so.
            said.setdefault("speeds", False)
        sizes = from_data(kind, said, path)
        _check_sizes(sizes, tensors, path)
        net = make_net(meta["net"], layout, sizes, 0)
        load_module(net, {k: v.float() for k, v in tensors.items()}, "net")
        example = None
        if "example" in meta:
            example = under("example", tensors), meta["example"]
        return InbetweenModel(
            meta["net"],
            net.eval(),
            tuple(meta["names"]),
            tensors["offsets"],
            meta["fps"],
            meta["longest"],
            meta["past"],
            meta["meta"],
            example,
        )
    except PoiseError as problem:
        raise PoiseError(
            problem.what, problem.where or path, problem.hint or hint, code=problem.code
        ) from None
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as problem:
        raise PoiseError(
            f"the model is of another version ({problem})", path, hint, code="version-differs"
        ) from None


def _check_sizes(sizes: Any, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Refuses sizes that its weights cannot have, before a network of them is made."""
    held = sum(v.numel() for v in tensors.values())
    for name, value in dataclasses.asdict(sizes).items():
        numbers = cast("Sequence[Any]", value) if isinstance(value, list | tuple) else (value,)
        for number in numbers:
            if isinstance(number, int) and not 0 <= number <= held:
                raise PoiseError(
                    f"its weights are not those of a network with {name} = {value}",
                    path,
                    code="weights-unfit",
                )


N = TypeVar("N", bound=TransitionNet)


@dataclass(frozen=True)
class Adaptation(Checked):
    """How a network is adapted to what it is asked, see `test_loss`.

    The paper gives neither beta, nor the optimiser, nor which weights move. Here all weights move.
    """

    iterations: Annotated[int, Range(0)] = 5
    """Passes over the test set, or over one sequence; choose them on validation."""
    steps: Literal["whole", "minibatch"] = "whole"
    """whole: one step of each pass, down the mean loss of all sequences. minibatch: a step after each
    `batch` of them, as the paper's "several epochs on the whole test data" reads."""
    lr: Positive = 1e-5
    beta: NotNegative = 0.01
    """Weight of the root's path."""
    contacts: Literal["detached", "paper"] = "detached"
    """detached: predicted contacts only weigh. paper: gradients flow through them as Eq. 1 is written,
    so that predicting no contact at all also lowers the loss."""
    optimizer: Literal["sgd", "adam"] = "adam"
    batch: Count = 128
    """Sequences of which gradients are computed at once; with `steps="whole"` it changes memory and time
    alone."""


def contact_loss(feet: Tensor, contact: Tensor) -> Tensor:
    """Eq. 1 `(N)` of foot joints `(N, T, F, 3)` m, frame 0 the last one seen, and their predicted
    contacts `(N, T - 1, F)` in frames 1 .. T - 1."""
    step = torch.diff(feet, dim=1).square().sum(-1)
    # The root of zero has no slope, and a foot that stands still has none to give.
    moved = torch.where(step > 0, step, torch.ones_like(step)).sqrt() * (step > 0)
    return (moved * contact).sum((1, 2))


def smoothness_loss(root: Tensor) -> Tensor:
    """Eq. 2 `(N)` of root paths `(N, T, 3)` m, frame 0 the last one seen: the length of the path."""
    step = torch.diff(root, dim=1).square().sum(-1)
    return (torch.where(step > 0, step, torch.ones_like(step)).sqrt() * (step > 0)).sum(1)


def test_loss(net: TransitionNet, known: Known, filled: FilledGap, config: Adaptation) -> Tensor:
    """L_test `(N)` of transitions that a network gave (Skeleton2Humanoid, section 3.2).

        L_contact = sum_t sum_f |p_f(t+1) - p_f(t)| contact_f(t+1)      (1)
        L_smooth  = sum_t ||r(t+1) - r(t)||_2                           (2)
        L_test    = L_contact + beta L_smooth                           (4)

    t goes from 0 to T-2, f over ankles and toes. Frame 0 is the last one that was seen, frames 1 .. T-1
    are the transition. The loss uses what the network itself says, never the truth: where the network
    predicts that a foot stands, the foot should not move, and the root should take the shorter way.
    """
    feet = list(net.layout.feet)
    seen = joint_positions(net.layout, known.offsets, known.past_root[:, -1:], known.past_rot[:, -1:])
    path = torch.cat((seen, filled.pos), 1)[:, :, feet]
    contact = filled.contact if config.contacts == "paper" else filled.contact.detach()
    root = torch.cat((known.past_root[:, -1:], filled.root), 1)
    return contact_loss(path, contact) + config.beta * smoothness_loss(root)


def adapt(
    net: N,
    known: Known,
    length: int,
    config: Adaptation | None = None,
    on_iteration: Callable[[int, N, float], None] | None = None,
) -> N:
    """A copy of the network adapted to a whole test set of one length; the given one stays as it is.

    With `steps="whole"` an iteration is one step down the mean loss of all sequences, so that as many
    iterations do as much to a large set as to the small one that they were chosen on.

    Args:
        known: all sequences; the gradients of `config.batch` at a time are computed, in order.
        on_iteration: called with its number (from 1), the network so far and the mean loss before it.

    Raises:
        TrainingError: the loss became infinite or not a number.
    """
    config = config or Adaptation()
    own = copy.deepcopy(net)
    params = [p for p in own.parameters() if p.requires_grad_(True) is p]
    adam = config.optimizer == "adam"
    optimizer = Adam(params, config.lr, fused=False) if adam else torch.optim.SGD(params, config.lr)
    count, often = len(known.target_root), config.steps == "minibatch"
    for iteration in range(1, config.iterations + 1):
        total = 0.0
        optimizer.zero_grad(set_to_none=True)
        for low in range(0, count, config.batch):
            part = Known(*(x[low : low + config.batch] for x in known))
            own_count = len(part.target_root)
            with torch.enable_grad():
                losses = test_loss(own, part, own.fill(part, length), config)
                (losses.sum() / (own_count if often else count)).backward()
            total += float(losses.detach().sum()) / count
            if often:
                _stepped(optimizer, total)
                optimizer.zero_grad(set_to_none=True)
        if not often:
            _stepped(optimizer, total)
        if on_iteration is not None:
            on_iteration(iteration, own, total)
    for p in params:
        p.requires_grad_(False)
    return own


def _stepped(optimizer: Optimizer, loss: float) -> None:
    if not loss < float("inf"):
        raise TrainingError(
            "the loss of the adaptation is not finite", hint="Lower its lr", code="training-diverged"
        )
    optimizer.step()
