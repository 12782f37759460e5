"""A store of small odd files: one compressed archive, `FORMAT/HASH/FILE` within."""

from __future__ import annotations

import hashlib
import io
import sys
import tarfile
from collections.abc import Iterable
from pathlib import Path

ARCHIVE = Path(__file__).with_name("corpus.tar.xz")
Case = tuple[str, str, dict[str, bytes]]


def hash_of(files: dict[str, bytes]) -> str:
    """A short name of a case."""
    return hashlib.sha256(
        b"\0".join(k.encode() + b"\0" + v for k, v in sorted(files.items()))
    ).hexdigest()[:12]


def pack(cases: Iterable[Case], path: Path = ARCHIVE) -> int:
    """Writes cases (format, name of what is read, files); the same cases give the same bytes."""
    count = 0
    with tarfile.open(path, "w:xz", preset=9, format=tarfile.PAX_FORMAT) as archive:
        for kind, name, files in sorted(cases, key=lambda c: (c[0], c[1], hash_of(c[2]))):
            count += 1
            for other, data in sorted(files.items(), key=lambda f: f[0] != name):
                info = tarfile.TarInfo(f"{kind}/{hash_of(files)}/{other}")
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))
    return count


def unpack(path: Path = ARCHIVE) -> list[Case]:
    """All cases of an archive; of each the first file is the one that is read."""
    found: dict[tuple[str, str], dict[str, bytes]] = {}
    with tarfile.open(path, "r:xz") as archive:
        for info in archive:
            kind, digest, name = info.name.split("/")
            file = archive.extractfile(info)
            found.setdefault((kind, digest), {})[name] = b"" if file is None else file.read()
    return [(kind, next(iter(files)), files) for (kind, _), files in found.items()]


if __name__ == "__main__":
    known = (
        {hash_of(files): (kind, name, files) for kind, name, files in unpack()}
        if ARCHIVE.exists()
        else {}
    )
    for given in sys.argv[1:]:
        known |= {hash_of(c[2]): c for c in unpack(Path(given))}
    print(f"{pack(known.values())} files, {ARCHIVE.stat().st_size} bytes")
