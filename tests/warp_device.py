"""Whether the tests on mujoco-warp run here, and on which device.

They run where mujoco-warp is installed, on a CUDA GPU when there is one and else on Warp's CPU device.
POISE_WARP=0 leaves them out, POISE_WARP=1 makes a missing package a failure. Warp keeps its compiled
kernels in the user's cache (WARP_CACHE_PATH moves it), so that only the first run takes minutes.
"""

from __future__ import annotations

import importlib.util
import os

import pytest
import torch

WARP_DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"

_asked = os.environ.get("POISE_WARP", "")
_installed = importlib.util.find_spec("mujoco_warp") is not None
needs_warp = pytest.mark.skipif(
    _asked == "0" or (_asked != "1" and not _installed),
    reason="POISE_WARP=0" if _asked == "0" else "mujoco-warp is not installed",
)
