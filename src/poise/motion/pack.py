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
from poise.motion.skeleton import Channel, Skeleton, Source


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
    source = dict(note["source"])
    source["channels"] = tuple(Channel(**_tuples(c)) for c in source["channels"])
    skeleton = Skeleton(
        tuple(note["names"]),
        tuple(note["parents"]),
        tensors[f"{i}/offsets"].numpy(),
        tuple((int(j), (float(v[0]), float(v[1]), float(v[2]))) for j, v in note["ends"]),
        Source(**_tuples(source)),
    )
    root_pos, rot = tensors[f"{i}/root_pos"].numpy(), tensors[f"{i}/rot"].numpy()
    return Clip(skeleton, root_pos, rot, note["fps"], note["name"], note["cyclic"])


def _tuples(value: Any) -> Any:
    """Lists to tuples, all the way down, since JSON knows only lists."""
    if isinstance(value, dict):
        return {k: _tuples(v) for k, v in value.items()}
    return tuple(_tuples(v) for v in value) if isinstance(value, list | tuple) else value
