"""MuJoCo's compiled module declares no types that pyright can see, so every name is Any."""

from typing import Any

def __getattr__(name: str) -> Any: ...
