"""Files of `torch.save` without torch, and without running anything of theirs: tensors as arrays."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import MAX_ARRAY_BYTES
from poise.formats.pickles import Array, RestrictedMachine, checked, plain_value
from poise.formats.text import CUT_OFF, shown

#: Element types of tensors by the class of their storage.
_KINDS = {
    "Float": "<f4",
    "Double": "<f8",
    "Half": "<f2",
    "Long": "<i8",
    "Int": "<i4",
    "Short": "<i2",
    "Char": "<i1",
    "Byte": "<u1",
    "Bool": "<?",
}
_STORAGES = {f"torch.{kind}Storage": np.dtype(code) for kind, code in _KINDS.items()}
_TENSOR = "torch._utils._rebuild_tensor_v2"


def load_torch(path: Path) -> Any:
    """The content of a file of `torch.save` since torch 1.6: plain values, and arrays in
    place of tensors.

    Such a file is a zip with a pickle, `data.pkl`, that names the bytes of tensors beside it.

    Raises:
        PoiseError: the file names anything but plain data and tensors of numbers, or is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = {n.partition("/")[2]: n for n in archive.namelist()}
            if "data.pkl" not in names:
                raise PoiseError("the zip holds no data.pkl of torch", path, code="file-damaged")
            if "byteorder" in names and archive.read(names["byteorder"]).strip() != b"little":
                raise PoiseError("its numbers are written big end first", path, code="format-not-read")

            def read(name: str, most: int) -> bytes:
                info = archive.getinfo(names[name])
                if info.file_size > most:
                    raise PoiseError("it holds more data than the limit", path, code="over-limit")
                return archive.read(info)

            machine = _TorchMachine(read("data.pkl", MAX_ARRAY_BYTES), path)
            machine.storage = lambda key: read(f"data/{key}", MAX_ARRAY_BYTES)
            return plain_value(machine, path)
    except (zipfile.BadZipFile, KeyError, EOFError, RuntimeError) as error:
        what = f"the file of torch is damaged ({shown(error)})"
        raise PoiseError(what, path, CUT_OFF, code="file-damaged") from None


@dataclass(eq=False)
class _Storage:
    """The numbers of tensors, in one row."""

    numbers: np.ndarray


class _TorchMachine(RestrictedMachine):
    """The restricted machine, which also knows tensors: views of rows of numbers."""

    extra = frozenset(("BINPERSID",))
    types = frozenset((*_STORAGES, _TENSOR))
    storage: Callable[[str], bytes]

    def persistent_load(self, pid: Any) -> Any:
        """The numbers that a tensor is a view of: ("storage", their type, key, device, count)."""
        tag, kind, key, _, count = checked(tuple, pid)
        if tag != "storage" or not isinstance(key, str) or not isinstance(count, int):
            raise ValueError("a tensor's numbers are named in an unknown way")
        numbers = np.frombuffer(self.storage(key), _STORAGES[self.name_of(kind)])
        if len(numbers) != count:
            raise ValueError(f"a tensor has {len(numbers)} numbers in place of {count}")
        return _Storage(self.counted(numbers))

    def made(self, name: str, args: tuple[Any, ...]) -> Any:
        """A tensor of (numbers, first, shape, strides, ...) as an array."""
        if name != _TENSOR:
            return super().made(name, args)
        held, first, shape, strides = args[:4]
        row = checked(_Storage, held).numbers
        for whole in (first, *checked(tuple, shape), *checked(tuple, strides)):
            if not isinstance(whole, int) or whole < 0:
                raise ValueError("a tensor has a negative length")
        if len(shape) != len(strides):
            raise ValueError("a tensor's shape and strides differ")
        count = 0 if 0 in shape else 1 + sum((n - 1) * s for n, s in zip(shape, strides, strict=True))
        if first + count > len(row):
            raise ValueError("a tensor goes beyond its numbers")
        size = row.dtype.itemsize
        steps = tuple(s * size for s in strides)
        # A view of few numbers may state any shape: its size is counted before it is made.
        if int(np.prod([int(n) for n in shape], dtype=float)) * size > MAX_ARRAY_BYTES:
            raise PoiseError("a tensor is larger than the limit", self.where, code="over-limit")
        view = np.lib.stride_tricks.as_strided(row[first:], shape, steps, writeable=False)
        return Array(self.counted(view.copy()))


def is_gvhmr(value: Any) -> bool:
    """True for the content of GVHMR's `hmr4d_results.pt`."""
    return isinstance(value, Mapping) and isinstance(value.get("smpl_params_global"), Mapping)
