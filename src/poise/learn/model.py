"""A trained in-betweening network as one file: weights, sizes, skeleton, rate, how it was trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.checkpoint import ModelMeta, load_checkpoint, save_checkpoint
from poise.learn.state import State, load_module, prefixed, under
from poise.nets.between import Between, BetweenConfig
from poise.nets.rtn import RTN, RTNConfig
from poise.nets.transition import Layout
from poise.settings import check_data, from_data

#: The file in a model's folder.
MODEL = "model.safetensors"
KINDS = ("transformer", "rtn")


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
        example: tensors and JSON notes of a clip as `motion.pack` packs it, which shows how the
            skeleton stands; None where clips of other skeletons are not to be brought onto it.
    """

    kind: str
    net: Between | RTN
    names: tuple[str, ...]
    offsets: Tensor
    fps: float
    longest: int
    past: int = 10
    meta: Mapping[str, Any] = field(default_factory=dict[str, Any])
    example: tuple[State, list[Any]] | None = None

    @property
    def layout(self) -> Layout:
        """The skeleton as the network sees it."""
        return self.net.layout


def make_net(kind: str, layout: Layout, config: BetweenConfig | RTNConfig, seed: int) -> Between | RTN:
    """A fresh network with weights from the seed.

    Raises:
        PoiseError: another kind than transformer and rtn.
    """
    generator = torch.Generator().manual_seed(seed)
    if kind == "transformer" and isinstance(config, BetweenConfig):
        return Between(layout, config, generator=generator)
    if kind == "rtn" and isinstance(config, RTNConfig):
        return RTN(layout, config, generator=generator)
    raise PoiseError(f"there is no in-betweening network '{kind}' of such sizes", hint=f"Known: {KINDS}")


def save_model(path: Path, model: InbetweenModel, half: bool = False) -> None:
    """Writes a model atomically; `half` keeps weights in half precision (a few MB)."""
    tensors = {k: v.half() if half else v for k, v in model.net.state_dict().items()}
    meta = {
        "kind": "inbetween model", "net": model.kind,
        "config": dataclasses.asdict(model.net.config), "layout": dataclasses.asdict(model.layout),
        "names": list(model.names), "fps": model.fps, "longest": model.longest, "past": model.past,
        "meta": dict(model.meta),
    }  # fmt: skip
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
        raise PoiseError("there is no in-betweening model", path, hint)
    tensors, meta = load_checkpoint(path)
    if meta.get("kind") != "inbetween model":
        raise PoiseError("the file is not an in-betweening model", path)
    check_data(ModelMeta, meta, path)
    hint = "Train it again"
    if not (meta["fps"] > 0 and min(meta["longest"], meta["past"]) > 0):
        raise PoiseError("its rate and the lengths that it fills must be above 0", path, hint)
    try:
        said = meta["layout"]
        layout = Layout(tuple(said["parents"]), tuple(said["feet"]), tuple(said["facing"]))
        kind = BetweenConfig if meta["net"] == "transformer" else RTNConfig
        said = dict(meta["config"])
        if kind is BetweenConfig:
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
            meta["net"], net.eval(), tuple(meta["names"]), tensors["offsets"], meta["fps"],
            meta["longest"], meta["past"], meta["meta"], example,
        )  # fmt: skip
    except PoiseError as problem:
        raise PoiseError(problem.what, problem.where or path, problem.hint or hint) from None
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as problem:
        raise PoiseError(f"the model is of another version ({problem})", path, hint) from None


def _check_sizes(sizes: Any, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Refuses sizes that its weights cannot have, before a network of them is made."""
    held = sum(v.numel() for v in tensors.values())
    for name, value in dataclasses.asdict(sizes).items():
        numbers = cast("Sequence[Any]", value) if isinstance(value, list | tuple) else (value,)
        for number in numbers:
            if isinstance(number, int) and not 0 <= number <= held:
                raise PoiseError(f"its weights are not those of a network with {name} = {value}", path)
