"""Files of torch.save: tensors come out as arrays, and nothing else does."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from poise.formats.torch_files import load_torch
from refusals import refused


def saved(folder: Path, value: Any, **options: Any) -> Path:
    path = folder / "a.pt"
    torch.save(value, path, **options)
    return path


@pytest.mark.parametrize("dtype", ["float32", "float64", "float16", "int64", "int32", "uint8", "bool"])
def test_tensors_of_any_type_and_their_views(tmp_path: Path, dtype: str) -> None:
    whole = torch.arange(24).reshape(4, 6).to(getattr(torch, dtype))
    views = {
        "whole": whole,
        "turned": whole.T,
        "part": whole[1:, ::2],
        "spread": whole[:1].expand(5, 6),
        "one": whole[2, 3],
        "none": whole[:0],
    }
    held = load_torch(saved(tmp_path, {"a": [views, "b", 1.5, None]}))["a"]
    assert held[1:] == ["b", 1.5, None]
    for name, tensor in views.items():
        assert held[0][name].dtype == tensor.numpy().dtype
        np.testing.assert_array_equal(held[0][name], tensor.numpy())


class Evil:
    def __reduce__(self) -> Any:
        return os.system, ("touch hacked",)


def test_what_is_no_data_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with refused("pickle-refused", says=("system",)):
        load_torch(saved(tmp_path, {"a": Evil()}))
    assert not (tmp_path / "hacked").exists()
    with refused("pickle-refused"):
        load_torch(saved(tmp_path, torch.nn.Linear(2, 2)))


def test_damage_is_one_sentence(tmp_path: Path) -> None:
    path = saved(tmp_path, {"a": torch.ones(100)})
    data = path.read_bytes()
    for cut in (10, 200, len(data) // 2, len(data) - 10):
        path.write_bytes(data[:cut])
        with refused("file-damaged"):
            load_torch(path)
    # Without its numbers, with too few of them, and without a pickle.
    for change in ("gone", "short", "no pickle"):
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
            for name in old.namelist():
                held = old.read(name)
                if (name.endswith("data/0") and change == "gone") or (
                    name.endswith("data.pkl") and change == "no pickle"
                ):
                    continue
                new.writestr(name, held[:40] if name.endswith("data/0") and change == "short" else held)
        path.write_bytes(out.getvalue())
        with refused("file-damaged"):
            load_torch(path)


def test_a_small_file_makes_no_large_array(tmp_path: Path) -> None:
    with refused("over-limit"):
        load_torch(saved(tmp_path, {"a": torch.zeros(1).expand(1 << 20, 1 << 20)}))
