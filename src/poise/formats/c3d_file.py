"""A process of its own reads a C3D file with ezc3d; a script, see `formats.limited`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def read(path: str, refuse: Callable[..., None]) -> dict[str, np.ndarray]:
    """Points, residuals, rate, and the text parameters of the group POINT."""
    import ezc3d

    file: Any = ezc3d.c3d(path)
    point = file["parameters"]["POINT"]
    texts = {k: v["value"] for k, v in point.items() if v.get("type") == -1}
    out = {k: np.array([str(x) for x in v], dtype=str) for k, v in texts.items()}
    out["points"] = np.asarray(file["data"]["points"], dtype=float)
    out["residuals"] = np.asarray(file["data"]["meta_points"]["residuals"], dtype=float)
    out["rate"] = np.array(file["header"]["points"]["frame_rate"], dtype=float)
    return out
