"""Where a verb writes: what `-o` names, a folder of results or the file of the motion."""

from __future__ import annotations

from pathlib import Path


def places(out: Path) -> tuple[Path, Path | None]:
    """The folder of the results, and the file of the motion where `out` names one.

    `out` names a file where its suffix is one of a motion format or looks like a file's; run_v1.0 is a
    folder, and so is what is there as one.

    Raises:
        PoiseError: a format that cannot be written.
    """
    from poise.motion.io import check_writable, names_file

    if not names_file(out) or out.is_dir():
        return out, None
    check_writable(out)
    return out.with_suffix(""), out
