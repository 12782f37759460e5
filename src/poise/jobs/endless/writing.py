"""A motion file that is written while the motion is made."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.motion import Clip
from poise.motion.io import check_writable, write_clip

#: Room for the number of frames in a file's header.
_DIGITS = 9
#: Bytes of a number in a BVH file, with its space.
NUMBER = 11


class MotionWriter:
    """Writes pieces of one motion into one file: BVH as they come, so that memory stays flat; any other
    format at the end. The file appears when it is closed.

    Args:
        path: the file. example: a clip on the skeleton, for its size. frames: how many are to come,
            in all files that are written beside each other.

    Raises:
        PoiseError: the format cannot be written, or there is no room for it on the disk.
    """

    def __init__(self, path: Path, example: Clip, frames: int):
        check_writable(path)
        self.path, self.frames = path, 0
        self._streams = path.suffix.lower() == ".bvh"
        need = NUMBER * (3 * len(example.skeleton) + 3) * frames
        free = shutil.disk_usage(path.parent).free
        if need > free:
            raise PoiseError(
                f"the motion takes about {need / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free", path,
                "Make a shorter one, or choose another disk",
            )  # fmt: skip
        self._beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
        self._pieces = list[Clip]()
        self._turns: np.ndarray | None = None
        self._last: np.ndarray | None = None
        self._at = 0

    def add(self, clip: Clip) -> None:
        """The next frames."""
        self.frames += clip.frames
        if not self._streams:
            self._pieces.append(clip)
            return
        with tempfile.TemporaryDirectory(prefix="poise-") as folder:
            piece = Path(folder) / "piece.bvh"
            write_clip(clip, piece)
            head, _, rest = piece.read_text(encoding="utf-8").partition("MOTION\n")
        count, step, body = rest.split("\n", 2)
        assert count.startswith("Frames:")
        rows = np.array([line.split() for line in body.strip().split("\n")], float)
        if self._turns is None:
            words = [w for line in head.split("\n") if "CHANNELS" in line for w in line.split()[2:]]
            self._turns = np.array([w.endswith("rotation") for w in words])
            lines = f"{head}MOTION\nFrames: "
            self._at = len(lines.encode())
            self._beside.write_text(f"{lines}{0:<{_DIGITS}}\n{step}\n", encoding="utf-8")
        if self._last is not None:
            # Angles go on from those of the last piece.
            jump = np.round((rows[0] - self._last) / 360.0) * 360.0
            rows -= np.where(self._turns, jump, 0.0)
        self._last = rows[-1]
        form = " ".join(["%.6f"] * rows.shape[1]) + "\n"
        with self._beside.open("a", encoding="utf-8") as file:
            file.writelines(form % tuple(row) for row in rows)

    def close(self) -> Path | None:
        """Puts the file into its place; None where no frame came."""
        if not self.frames:
            return None
        if not self._streams:
            root = np.concatenate([p.root_pos for p in self._pieces])
            rot = np.concatenate([p.rot for p in self._pieces])
            write_clip(self._pieces[0].replaced(root_pos=root, rot=rot), self.path)
            return self.path
        with self._beside.open("r+", encoding="utf-8") as file:
            file.seek(self._at)
            file.write(f"{self.frames:<{_DIGITS}}")
            file.flush()
            os.fsync(file.fileno())
        self._beside.replace(self.path)
        return self.path

    def discard(self) -> None:
        """Leaves nothing behind."""
        self._beside.unlink(missing_ok=True)
