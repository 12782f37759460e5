"""A kinematic policy as one file: weights, sizes, pasts from which it begins, labels."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.errors import PoiseError
from poise.learn.checkpoint import load_checkpoint, load_module, prefixed, save_checkpoint, take
from poise.learn.cvae import CVAE, CosineCVAE, CVAEConfig, PackedFrames, make_cvae
from poise.settings import from_data
from poise.synthesis.generator import ROOT, Codes, Kinematic

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


class _GeneratorMeta(_Needed, total=False):
    labels: list[str]


@dataclass(frozen=True, eq=False)
class GeneratorModel:
    """A kinematic policy ready to use.

    Attributes:
        net: see `learn.cvae.make_cvae`.
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
                code="bodies-differ",
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
            raise PoiseError(
                f"the generator knows no style '{style[:40]}'; {known}", "style", code="unknown-style"
            )
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
    tensors, meta = load_checkpoint(file, _GeneratorMeta)
    if meta["kind"] != "kinematic policy":
        raise PoiseError("the file holds no kinematic policy", file, code="wrong-file-kind")
    config = from_data(CVAEConfig, meta["config"], file)
    hinges = tuple(meta["hinges"])
    tensors = {k: v.float() for k, v in tensors.items()}
    wanted = {"seeds": (config.past, 7 + len(hinges)), "bounds": (len(hinges),)}
    for name, shape in wanted.items():
        value = tensors.get(name, torch.empty(0))
        if value.ndim != len(shape) + 1 or value.shape[1:] != shape or not bool(value.isfinite().all()):
            raise PoiseError(f"the file's '{name}' is missing or damaged", file, code="file-damaged")
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
            raise PoiseError("the file's labels are damaged", file, code="file-damaged")
    return GeneratorModel(
        net.eval(), tensors["seeds"].double(), tensors["bounds"].double(), hinges, float(meta["fps"]),
        meta["about"], codes, tuple(meta.get("labels", ())), kinds,
    )  # fmt: skip


#: The file in a library's folder, and how many labels it may have.
LABELS, MOST = "labels.txt", 1000


class Label(NamedTuple):
    """A name, and what names of its clips match."""

    name: str
    pattern: re.Pattern[str]


def read_labels(path: Path) -> tuple[Label, ...]:
    """The labels of a file; of a folder those of its `labels.txt`, none where there is none.

        # a label, and a regular expression that names of its clips match; the first that fits counts
        walk   walk|^07_
        dance  salsa

    Raises:
        PoiseError: a line says something else.
    """
    if path.is_dir():
        path = path / LABELS
        if not path.is_file():
            return ()
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        raise PoiseError(
            "the labels could not be read", path, "Give a text file", code="file-unreadable"
        ) from None
    out = list[Label]()
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split(None, 1)
        if not words:
            continue
        try:
            name, pattern = words[0], re.compile(words[1].strip())
        except IndexError:
            raise PoiseError(
                f"line {number} has a label alone", path, "Write LABEL REGEX", code="line-malformed"
            ) from None
        except re.error as problem:
            raise PoiseError(
                f"line {number} has no regular expression ({problem})", path, code="bad-regex"
            ) from None
        out.append(Label(name, pattern))
    if len(out) > MOST:
        raise PoiseError(f"there may be {MOST} labels at most, got {len(out)}", path, code="over-limit")
    return tuple(out)


def names_of(labels: Sequence[Label]) -> tuple[str, ...]:
    """The labels' names, each once, in order."""
    return tuple(dict.fromkeys(label.name for label in labels))


def kinds_of(clips: Sequence[str], labels: Sequence[Label]) -> Tensor:
    """Which label each clip has, its number among `names_of`, `(C,)`; -1 for none."""
    names = names_of(labels)
    found = [next((k for k in labels if k.pattern.search(c)), None) for c in clips]
    return torch.tensor([-1 if k is None else names.index(k.name) for k in found])


def clips_of_seeds(motions: Motions, past: int) -> Tensor:
    """The clip of each of `motions.seeds`, `(S,)`; as `endless_training.motions_of` picks them."""
    sizes = torch.diff(motions.frames.first).tolist()
    clips = [c for c, n in enumerate(sizes) for _ in range(0, n - past, past)]
    return torch.tensor(clips)[spread(len(clips), len(motions.seeds))]


def spread(count: int, most: int) -> Tensor:
    """At most so many of `count` numbers from 0 on, evenly spread."""
    return torch.tensor(np.linspace(0, count - 1, min(most, count)).round().astype(int))


#: Share of the mean weight that every number has.
LEAST = 0.3


@dataclass(frozen=True, eq=False)
class Motions:
    """A library as a kinematic policy learns it.

    Attributes:
        frames: windows of frames that know no place, see `synthesis.generator`.
        seeds: `(S, p, 7 + n)` pasts of the library, evenly spread.
        bounds: `(2, n)` rad, least and most of each hinge.
        reach: `(10 + n)` m, how far a deviation of each number moves the body, see `reach_of`.
        hinges: names.
        fps: frames a second.
        clips: names.
    """

    frames: PackedFrames
    seeds: Tensor
    bounds: Tensor
    reach: Tensor
    hinges: tuple[str, ...]
    fps: float
    clips: tuple[str, ...]

    @property
    def weights(self) -> Tensor:
        """Of the squares of a frame's numbers: all hinges are not worth the same."""
        share = self.reach.square() / self.reach.square().mean()
        return (share + LEAST) / (1 + LEAST)
