"""Clips as plain tensors and JSON, so that a run folder holds what it was made from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.own.record import fitted
from poise.motion.skeleton import Skeleton, Source


def pack_clips(clips: Sequence[Clip]) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """Tensors named `"<i>/root_pos"`, `"<i>/rot"`, `"<i>/offsets"`, and one JSON object per clip."""
    tensors: dict[str, Tensor] = {}
    notes: list[dict[str, Any]] = []
    for i, clip in enumerate(clips):
        tensors[f"{i}/root_pos"] = torch.tensor(clip.root_pos)
        tensors[f"{i}/rot"] = torch.tensor(clip.rot)
        tensors[f"{i}/offsets"] = torch.tensor(np.array(clip.skeleton.offsets))
        notes.append(
            {
                "name": clip.name,
                "fps": clip.fps,
                "cyclic": clip.cyclic,
                "names": list(clip.skeleton.names),
                "parents": list(clip.skeleton.parents),
                "ends": [[j, list(v)] for j, v in clip.skeleton.ends],
                "source": dataclasses.asdict(clip.skeleton.source),
            }
        )
    return tensors, notes


def unpack_clips(tensors: Mapping[str, Tensor], notes: Sequence[Mapping[str, Any]]) -> list[Clip]:
    """What `pack_clips` packed.

    Raises:
        PoiseError: a key is missing, or of another kind.
    """
    try:
        return [_clip(tensors, note, i) for i, note in enumerate(notes)]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as problem:
        raise PoiseError(f"the packed clips are incomplete: {problem}") from None


def _clip(tensors: Mapping[str, Tensor], note: Mapping[str, Any], i: int) -> Clip:
    def told(key: str, kind: Any) -> Any:
        return fitted(note[key], kind)

    skeleton = Skeleton(
        told("names", tuple[str, ...]),
        told("parents", tuple[int, ...]),
        tensors[f"{i}/offsets"].numpy(),
        told("ends", tuple[tuple[int, tuple[float, float, float]], ...]),
        told("source", Source),
    )
    root_pos, rot = tensors[f"{i}/root_pos"].numpy(), tensors[f"{i}/rot"].numpy()
    return Clip(skeleton, root_pos, rot, told("fps", float), told("name", str), told("cyclic", bool))
