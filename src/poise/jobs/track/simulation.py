"""A simulation, kept beside a result so that a part of it can be simulated anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env import ImitationEnv
from poise.errors import PoiseError
from poise.learn.checkpoint import load_checkpoint, save_checkpoint

#: The file in the folder of a result.
FILE = "simulation.safetensors"


class _SimulationMeta(TypedDict):
    kind: str
    rate_hz: float
    bodies: list[str]
    hinges: list[str]
    lost: int | None


@dataclass(frozen=True, eq=False)
class Simulation:
    """The states of one character from its first frame to its last; world frame, Z up.

    Attributes:
        qpos: `(T, 7 + n)` m, wxyz and rad.
        qvel: `(T, 6 + n)` m/s and rad/s, see `kinematics.coords.qpos_velocity`.
        action: `(T - 1, A)` as they acted from each frame to the next.
        rate_hz: control rate.
        bodies, hinges: names of the humanoid's.
        lost: the frame at which the motion was lost; None where it was not.
    """

    qpos: Tensor
    qvel: Tensor
    action: Tensor
    rate_hz: float
    bodies: tuple[str, ...]
    hinges: tuple[str, ...]
    lost: int | None = None

    @property
    def frames(self) -> int:
        """T."""
        return len(self.qpos)

    def check(self, humanoid: Humanoid, frames: int, rate_hz: float) -> None:
        """Refuses a motion of another length or body.

        Raises:
            PoiseError: it is not of these.
        """
        if (self.bodies, self.hinges) != (tuple(humanoid.bodies), tuple(humanoid.hinges)):
            raise PoiseError(
                "the earlier result is of another body",
                hint="Track the whole motion",
                code="bodies-differ",
            )
        if (self.frames, self.rate_hz) != (frames, rate_hz):
            raise PoiseError(
                f"the earlier result lasts {(self.frames - 1) / self.rate_hz:.2f} s and the motion "
                f"{(frames - 1) / rate_hz:.2f} s",
                hint="A range needs a motion as long as the earlier one; or track the whole motion",
                code="length-differs",
            )

    def save(self, path: Path) -> None:
        """Writes it as one file."""
        tensors = {k: getattr(self, k) for k in ("qpos", "qvel", "action")}
        meta = {"kind": "simulation", "rate_hz": self.rate_hz, "bodies": list(self.bodies),
                "hinges": list(self.hinges), "lost": self.lost}  # fmt: skip
        save_checkpoint(path, tensors, meta)


@dataclass(frozen=True, eq=False)
class Retake:
    """A part of a motion that is simulated anew; the rest stays as it was simulated.

    Attributes:
        of: what was simulated: `Result.simulation`, or the folder of a result.
        first_s, last_s: the part, s.
    """

    of: Simulation | str | Path
    first_s: float
    last_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.first_s < self.last_s:
            raise PoiseError(
                f"a range must rise from 0 s, got {self.first_s:g}-{self.last_s:g}",
                hint="Write --range 2.0-3.5",
                code="not-rising",
            )

    def opened(self) -> Simulation:
        """What was simulated, read where it is a file.

        Raises:
            PoiseError: there is none, or it cannot be read.
        """
        return self.of if isinstance(self.of, Simulation) else read_simulation(Path(self.of))


def retake_of(span: str | None, of: Path | None) -> Retake | None:
    """What words ask for: "2.0-3.5" of a result's folder; None where nothing is asked.

    Raises:
        PoiseError: words that make no sense, or one without the other.
    """
    if span is None and of is None:
        return None
    if span is None or of is None:
        what = "--from needs a --range" if span is None else "--range needs an earlier result"
        raise PoiseError(what, hint="Write --range 2.0-3.5 --from RESULT", code="option-needs-option")
    try:
        first, last = (float(v) for v in span.split("-"))
    except ValueError:
        hint = "Write 2.0-3.5, two times in s"
        raise PoiseError(
            f"--range '{span}' makes no sense", hint=hint, code="option-malformed"
        ) from None
    return Retake(of, first, last)


def read_simulation(path: Path) -> Simulation:
    """What a result's folder, or the file in it, holds.

    Raises:
        PoiseError: nothing was kept there, or the file is damaged.
    """
    file = path / FILE if path.is_dir() else path
    if not file.exists():
        raise PoiseError(
            "there is no simulation to go on from", file,
            "Give the folder that poise track or complete wrote for a single clip",
            code="simulation-missing",
        )  # fmt: skip
    tensors, meta = load_checkpoint(file, _SimulationMeta)
    if meta["kind"] != "simulation":
        raise PoiseError("the file holds no simulation", file, code="wrong-file-kind")
    return _checked(tensors, meta, file)


def _checked(tensors: Mapping[str, Tensor], meta: Mapping[str, Any], file: Path) -> Simulation:
    """The parts of a file, of which none may be missing, of another shape or not finite."""
    hinges = len(meta["hinges"])
    widths = {"qpos": 7 + hinges, "qvel": 6 + hinges, "action": None}
    frames = len(tensors["qpos"]) if "qpos" in tensors else 0
    for name, width in widths.items():
        value = tensors.get(name, torch.empty(0))
        rows = frames - (name == "action")
        fits = (
            value.ndim == 2 and len(value) == rows >= 1 and value.shape[1] == (width or value.shape[1])
        )
        if not fits or not bool(value.isfinite().all()):
            raise PoiseError(
                f"the file's '{name}' is missing or damaged",
                file,
                "Track the motion anew",
                code="file-damaged",
            )
    if not meta["rate_hz"] > 0:
        raise PoiseError(f"the file states a rate of {meta['rate_hz']:g} Hz", file, code="file-damaged")
    return Simulation(
        tensors["qpos"].double(), tensors["qvel"].double(), tensors["action"].float(),
        float(meta["rate_hz"]), tuple(meta["bodies"]), tuple(meta["hinges"]), meta["lost"],
    )  # fmt: skip


class States:
    """Observes the first character's states and actions."""

    def __init__(self) -> None:
        self.qpos, self.qvel, self.action = list[Tensor](), list[Tensor](), list[Tensor]()

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps control step `step`; it never needs more of them."""
        state = env.backend.state
        self.qpos.append(state.qpos[0].detach().to("cpu", torch.float64, copy=True))
        self.qvel.append(state.qvel[0].detach().to("cpu", torch.float64, copy=True))
        if step:
            self.action.append(env.action[0].detach().to("cpu", copy=True))
        return True

    def simulation(self, humanoid: Humanoid, rate_hz: float, lost: int | None) -> Simulation:
        """All of it; the frame at which the motion was lost is told."""
        qpos, qvel, action = (torch.stack(x) for x in (self.qpos, self.qvel, self.action))
        names = tuple(humanoid.bodies), tuple(humanoid.hinges)
        return Simulation(qpos, qvel, action, rate_hz, *names, lost)
