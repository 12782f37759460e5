"""What a GPU gives: whether its physics is the CPU's, how fast it is, how fast the tracker learns on it.

python benchmarks/gpu.py --json benchmarks/gpu.json
python benchmarks/gpu.py training --json benchmarks/gpu.json
python benchmarks/gpu.py --tiny --json FILE

Pieces: `conformance` (MuJoCo Warp beside MuJoCo), `stepping` (the environment beside raw stepping),
`labels` (of the teacher that looks ahead), `training` (samples/s of the tracker), `figure` (seconds of
its training until 90 % of 64 start frames are tracked). None takes more than 9 minutes: what the clock
stops is told, and goes on with the next call. Where mujoco-warp is not installed, MuJoCo steps on the
cores and networks are on the GPU.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from tyro.conf import Positional, arg

from poise.cli.console import say, table, tell
from poise.cli.main import guarded
from poise.cli.parse import parse
from poise.errors import PoiseError
from poise.learn.checkpoint import write_atomic

if TYPE_CHECKING:
    from speed.pieces import Part

PROG = "benchmarks/gpu.py"
PIECES = ("conformance", "stepping", "labels", "training", "figure")
Piece = Literal["conformance", "stepping", "labels", "training", "figure"]
#: Seconds after which a piece begins nothing new; what runs then has a minute until the ninth ends.
LIMIT_S = 480.0
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Measure what an NVIDIA GPU gives, piece by piece, none longer than 9 minutes."""

    json: Annotated[Path, arg(metavar="FILE")]
    """The results; what is there for the same machine and settings is not measured again."""
    pieces: Annotated[Positional[tuple[Piece, ...]], arg(metavar="PIECE")] = ()
    """conformance, stepping, labels, training, figure; all of them by default."""
    again: bool = False
    """Measure again what is there."""
    tiny: bool = False
    """A few worlds for a moment, without a GPU if there is none: to try the script."""
    library: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Clips for training and figure, as tracker.py takes them; by default the walk of Poise."""
    onto: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A motion file whose skeleton the library's clips get."""


def run(options: Options) -> int:
    """Measures what is not there yet; a part that is measured is written at once."""
    if (options.library is None) != (options.onto is None):
        raise PoiseError(
            "--library and --onto go together",
            hint="Give both, or neither of them",
            code="option-needs-option",
        )
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu" and not options.tiny:
        raise PoiseError(
            "PyTorch finds no CUDA GPU",
            hint="Try the script without one by --tiny",
            code="device-missing",
        )
    rows, here = _earlier(options.json), machine(device)
    from speed.pieces import TINY, Pieces, Sizes

    checkpoint = options.json.with_suffix(".safetensors")
    if options.again:
        checkpoint.unlink(missing_ok=True)
    sizes = TINY if options.tiny else Sizes()
    pieces = Pieces(sizes, device, options.library, options.onto, checkpoint)
    left: list[str] = []
    for piece in options.pieces or PIECES:
        until = time.monotonic() + LIMIT_S
        for part in pieces.parts(piece):
            key = {"piece": piece, "part": part.name, "settings": part.settings}
            known = [r for r in rows if _is(r, key, here)]
            if known and known[0]["finished"] and not options.again:
                tell(f"{piece}, {part.name}: is there", "dim")
                continue
            if time.monotonic() > until:
                left.append(f"{piece}, {part.name}")
                continue
            tell(f"{piece}, {part.name}", "dim")
            row = key | _measured(part, until) | {"machine": here}
            rows = [r for r in rows if not _is(r, key, here)] + [row]
            _write(options.json, rows)
            _show(row)
            if not row["finished"]:
                left.append(f"{piece}, {part.name}")
    if left:
        say(f"Stopped by the clock: {'; '.join(left)}. The same command goes on.")
    say(str(options.json))
    return 0


def machine(device: str) -> Row:
    """The machine and the versions, with those of the GPU."""
    from speed import machine as cpu

    gpu = torch.cuda.get_device_name() if device == "cuda" else None
    try:
        warp = metadata.version("mujoco-warp")
    except metadata.PackageNotFoundError:
        warp = None
    return {**cpu(), "gpu": gpu, "cuda": torch.version.cuda, "mujoco_warp": warp}


def _measured(part: Part, until: float) -> Row:
    start = time.monotonic()
    result = part.work(until)
    seconds = round(time.monotonic() - start, 1)
    return {"seconds": seconds, "finished": result.pop("finished", True), "result": result}


def _is(row: Row, key: Row, here: Row) -> bool:
    """Whether a row is of this part with these settings on this machine."""
    loaded = {"load_before": None}
    same = all(row.get(name) == value for name, value in json.loads(json.dumps(key)).items())
    return same and row.get("machine", {}) | loaded == here | loaded


def _earlier(path: Path) -> list[Row]:
    """What earlier calls have measured."""
    if not path.exists():
        return []
    try:
        return list(json.loads(path.read_text(encoding="utf-8"))["rows"])
    except (OSError, ValueError, KeyError, TypeError):
        raise PoiseError(
            "holds no figures of this benchmark", path, "Give another file", code="wrong-file-kind"
        ) from None


def _write(path: Path, rows: list[Row]) -> None:
    data = {"command": f"python {PROG} --json {path.name}", "rows": rows}
    write_atomic(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


def _show(row: Row) -> None:
    plain = {k: v for k, v in row["result"].items() if not isinstance(v, list | dict)}
    shown = [(k, f"{v:,g}" if isinstance(v, float) else str(v)) for k, v in plain.items()]
    table(f"{row['piece']}, {row['part']}", ("", ""), shown)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark and returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    return guarded(lambda: run(parse(Options, given, PROG)))


if __name__ == "__main__":
    sys.exit(main())
