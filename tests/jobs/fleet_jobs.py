"""Jobs that take no time: small programs that succeed, fail, or kill a process the first time."""

from __future__ import annotations

from pathlib import Path

from poise.jobs.fleet import FleetJob

# Arguments: result file, mode, and `--threads K` from the fleet.
PROGRAM = """
import json, os, signal, sys, time
from pathlib import Path
result, mode = Path(sys.argv[1]), sys.argv[2]
assert sys.argv[3] == "--threads" and "RANK" not in os.environ
result.parent.mkdir(parents=True, exist_ok=True)
tries = result.with_name("tries")
n = len(tries.read_text()) if tries.exists() else 0
tries.write_text("x" * (n + 1))
if mode == "die" and n == 0:
    os.kill(os.getpid(), signal.SIGKILL)
if mode == "orphan" and n == 0:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)
if mode == "refuse":
    sys.exit("error: walk.bvh: the clip is too short. Give a longer one")
if mode == "crash":
    raise RuntimeError("no luck")
if mode == "hang" and n == 0:
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        result.with_name("saved").touch()
        sys.exit(130)
if mode != "forget":
    score = {"succ": 0.5, "mpjpe_mm": 40.0, "help": {"force_mean_n": 3.0}, "per_clip": []}
    result.write_text(json.dumps(score))
"""


def job(folder: Path, name: str, mode: str = "work") -> FleetJob:
    """A job of this mode in `folder/name`."""
    result = folder / name / "score.json"
    return FleetJob(name, ("-c", PROGRAM, str(result), mode), result, {"clip": name, "seed": 0})


def tries(folder: Path, name: str) -> int:
    """How often a job was started."""
    path = folder / name / "tries"
    return len(path.read_text()) if path.exists() else 0
