"""How much a zip archive's directory takes, before any of it is read."""

from __future__ import annotations

import struct
from pathlib import Path

#: Bytes of the record that ends an archive, of what points to its 64-bit form, of that form, and of a
#: comment behind it at most.
_END, _POINTS, _END_64, _COMMENT = 22, 20, 56, (1 << 16) - 1


def directory_bytes(path: str | Path) -> int:
    """Bytes of the directory as the end of the file states them; 0 where no archive ends there.

    Python's own reader makes objects of all entries at once, which takes ten times their bytes.

    Raises:
        OSError: the file cannot be read.
    """
    with Path(path).open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - _END - _COMMENT - _POINTS - _END_64))
        tail = file.read()
    at = len(tail) - _END
    if not (tail.startswith(b"PK\x05\x06", at) and tail.endswith(b"\0\0")):
        at = tail.rfind(b"PK\x05\x06")
    if at < 0 or at + _END > len(tail):
        return 0
    (stated,) = struct.unpack_from("<L", tail, at + 12)
    if tail.startswith(b"PK\x06\x07", at - _POINTS) and at >= _POINTS + _END_64:
        (wide,) = struct.unpack_from("<Q", tail, at - _POINTS - _END_64 + 40)
        stated = wide if stated == 0xFFFFFFFF else max(stated, wide)
    return min(stated, size)
