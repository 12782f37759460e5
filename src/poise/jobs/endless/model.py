"""A kinematic policy as one file: weights, sizes, pasts from which it begins, the body's hinges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.errors import PoiseError
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.state import load_module, prefixed, take
from poise.nets.cosine_cvae import CosineCVAE, make_cvae
from poise.nets.cvae import CVAE, CVAEConfig
from poise.settings import from_data
from poise.synth.codes import Codes
from poise.synth.generator import Kinematic
from poise.synth.place_free import ROOT

#: The file in a run's folder.
GENERATOR = "generator.safetensors"
#: The one that comes with Poise.
SHIPPED = Path(__file__).parents[2] / "data" / GENERATOR
#: How the names of the encoder's weights begin.
ENCODER = ("net/encoder", "net/posterior", "net/coming")
_CODES = ("keys", "mean", "log_var", "weights")


class _Needed(TypedDict):
    kind: str
    config: dict[str, Any]
    hinges: list[str]
    fps: float
    about: dict[str, Any]


class _Meta(_Needed, total=False):
    labels: list[str]


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
        codes: from which z is drawn; None draws it from N(0, I).
        labels: names of what is done in the library.
        kinds: `(S,)` which label each seed has, -1 for none; None where there are no labels.
    """

    net: CVAE | CosineCVAE
    seeds: Tensor
    bounds: Tensor
    hinges: tuple[str, ...]
    fps: float
    about: Mapping[str, Any] = field(default_factory=dict[str, Any])
    codes: Codes | None = None
    labels: tuple[str, ...] = ()
    kinds: Tensor | None = None

    def generator(
        self, humanoid: Humanoid, temperature: float = 1.0, style: str | None = None
    ) -> Kinematic:
        """What makes its motion for a body; with `style` only motion of that label.

        Raises:
            PoiseError: the body has other hinges, or there is no such label.
        """
        if tuple(humanoid.hinges) != self.hinges:
            raise PoiseError(
                "the generator is of another body",
                hint="Give the policy that it was trained with, or train a generator for this one",
            )
        seeds, codes = self.seeds, self.codes
        if style is not None:
            seeds, codes = self._styled(style)
        return Kinematic(self.net, seeds, self.fps, temperature, self.bounds, codes)

    def _styled(self, style: str) -> tuple[Tensor, Codes]:
        """Seeds and codes of one label."""
        has = [k for k in self.labels if self.codes is not None and self._count(k)]
        if style not in has or self.codes is None or self.kinds is None:
            known = f"it has {', '.join(has)}" if has else "its library has no labels"
            raise PoiseError(f"the generator knows no style '{style[:40]}'; {known}", "style")
        kind = self.labels.index(style)
        return self.seeds[self.kinds == kind], self.codes.only(kind)

    def _count(self, label: str) -> int:
        """Codes of a label, 0 where none of its pasts is a seed."""
        kind = self.labels.index(label)
        if self.codes is None or self.codes.kinds is None or self.kinds is None:
            return 0
        return int((self.codes.kinds == kind).sum()) * bool((self.kinds == kind).any())

    def save(self, path: Path, half: bool = False) -> None:
        """Writes it as one file; `half` keeps numbers in half precision, and leaves out the encoder,
        which only training needs."""
        weights = prefixed("net", self.net.state_dict())
        tensors = {**weights, "seeds": self.seeds.float(), "bounds": self.bounds.float()}
        if self.codes is not None:
            tensors |= {f"codes/{k}": getattr(self.codes, k) for k in _CODES}
            if self.codes.kinds is not None and self.kinds is not None:
                tensors |= {"codes/kinds": self.codes.kinds, "kinds": self.kinds}
        if half:
            tensors = {k: v.half() for k, v in tensors.items() if not k.startswith(ENCODER)}
        meta = {
            "kind": "kinematic policy", "config": asdict(self.net.config), "hinges": list(self.hinges),
            "fps": self.fps, "about": dict(self.about), "labels": list(self.labels),
        }  # fmt: skip
        save_checkpoint(path, tensors, meta)


def load_generator(path: str | Path | None = None) -> GeneratorModel:
    """A kinematic policy from its file or its run's folder; by default the one that comes with Poise.

    Raises:
        PoiseError: there is none, or the file is damaged or of another kind.
    """
    file = SHIPPED if path is None else Path(path)
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
    net = make_cvae(ROOT + len(hinges), config, torch.Generator().manual_seed(0))
    if not any(k.startswith(ENCODER) for k in tensors):
        # It was left out.
        own = prefixed("net", net.state_dict())
        tensors |= {k: v for k, v in own.items() if k.startswith(ENCODER)}
    load_module(net, tensors, "net")
    codes = None
    if any(k.startswith("codes/") for k in tensors):
        codes = Codes(*(take(tensors, f"codes/{k}") for k in _CODES))
    kinds = None
    if codes is not None and "codes/kinds" in tensors:
        kinds = take(tensors, "kinds").long()
        codes = replace(codes, kinds=take(tensors, "codes/kinds").long())
        if (
            len(kinds) != len(tensors["seeds"])
            or codes.kinds is None
            or len(codes.kinds) != len(codes.keys)
        ):
            raise PoiseError("the file's labels are damaged", file)
    return GeneratorModel(
        net.eval(), tensors["seeds"].double(), tensors["bounds"].double(), hinges, float(meta["fps"]),
        meta["about"], codes, tuple(meta.get("labels", ())), kinds,
    )  # fmt: skip
