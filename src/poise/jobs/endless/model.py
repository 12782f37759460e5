"""A kinematic policy as one file: weights, sizes, pasts from which it begins, the body's hinges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.errors import PoiseError
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.state import load_module, prefixed
from poise.nets.cvae import CVAE, CVAEConfig
from poise.settings import from_data
from poise.synth.generator import Kinematic
from poise.synth.place_free import ROOT

#: The file in a run's folder.
GENERATOR = "generator.safetensors"


class _Meta(TypedDict):
    kind: str
    config: dict[str, Any]
    hinges: list[str]
    fps: float
    about: dict[str, Any]


@dataclass(frozen=True, eq=False)
class GeneratorModel:
    """A kinematic policy ready to use.

    Attributes:
        net: see `nets.cvae`.
        seeds: `(S, p, 7 + n)` pasts from which motions begin.
        bounds: `(2, n)` rad, least and most of each hinge in the library.
        hinges: names of the body's hinges, in order.
        fps: frames a second.
        about: clips, steps, seconds, seed of the training.
    """

    net: CVAE
    seeds: Tensor
    bounds: Tensor
    hinges: tuple[str, ...]
    fps: float
    about: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def generator(self, humanoid: Humanoid, temperature: float = 1.0) -> Kinematic:
        """What makes its motion for a body.

        Raises:
            PoiseError: the body has other hinges.
        """
        if tuple(humanoid.hinges) != self.hinges:
            raise PoiseError(
                "the generator is of another body",
                hint="Give the policy that it was trained with, or train a generator for this one",
            )
        return Kinematic(self.net, self.seeds, self.fps, temperature, self.bounds)

    def save(self, path: Path, half: bool = False) -> None:
        """Writes it as one file; `half` keeps weights in half precision."""
        weights = prefixed("net", self.net.state_dict())
        tensors = {**weights, "seeds": self.seeds.float(), "bounds": self.bounds.float()}
        if half:
            tensors = {k: v.half() for k, v in tensors.items()}
        meta = {
            "kind": "kinematic policy", "config": asdict(self.net.config), "hinges": list(self.hinges),
            "fps": self.fps, "about": dict(self.about),
        }  # fmt: skip
        save_checkpoint(path, tensors, meta)


def load_generator(path: str | Path) -> GeneratorModel:
    """A kinematic policy from its file or its run's folder.

    Raises:
        PoiseError: there is none, or the file is damaged or of another kind.
    """
    file = Path(path)
    file = file / GENERATOR if file.is_dir() else file
    tensors, meta = load_checkpoint(file, _Meta)
    if meta["kind"] != "kinematic policy":
        raise PoiseError("the file holds no kinematic policy", file)
    config = from_data(CVAEConfig, meta["config"], file)
    hinges = tuple(meta["hinges"])
    tensors = {k: v.float() for k, v in tensors.items()}
    wanted = {"seeds": (config.past, 7 + len(hinges)), "bounds": (len(hinges),)}
    for name, shape in wanted.items():
        value = tensors.get(name, torch.empty(0))
        if value.ndim != len(shape) + 1 or value.shape[1:] != shape or not bool(value.isfinite().all()):
            raise PoiseError(f"the file's '{name}' is missing or damaged", file)
    net = CVAE(ROOT + len(hinges), config, generator=torch.Generator().manual_seed(0))
    load_module(net, tensors, "net")
    return GeneratorModel(
        net.eval(), tensors["seeds"].double(), tensors["bounds"].double(), hinges, float(meta["fps"]),
        meta["about"],
    )  # fmt: skip
