"""A process of its own compiles an MJCF file with MuJoCo; a script, see `formats.limited`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np


def read(path: str, refuse: Callable[..., None]) -> dict[str, np.ndarray]:
    """The compiled model as bytes."""
    import mujoco

    with tempfile.TemporaryDirectory() as folder:
        # MuJoCo writes its log where it works.
        os.chdir(folder)
        try:
            model = mujoco.MjSpec.from_file(path).compile()
        except (ValueError, OSError) as problem:
            said = " ".join(str(problem).split()).removeprefix("Error: ")
            refuse(f"MuJoCo cannot read it: {said}", code="mjcf-unreadable")
            raise
        mujoco.mj_saveModel(model, "model.mjb")
        os.chdir("/")
        return {"model": np.frombuffer(Path(folder, "model.mjb").read_bytes(), dtype=np.uint8)}
