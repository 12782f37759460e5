"""`poise VERB ...`: finds the verb, runs it, and turns every failure into one sentence.

Exit codes: 0 done; 1 a fault of Poise or of the machine; 2 a mistake the user can mend; 130 Ctrl-C.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module

from poise import __version__
from poise.errors import PoiseError, did_you_mean

#: Every verb and what it does; its module is imported only when it runs.
VERBS = {
    "info": "what a motion file holds: joints, rate, unit, height, what was guessed",
    "convert": "write a motion file in another format or at another rate",
    "retarget": "move a clip onto another human skeleton",
    "body": "the physical body that is made for a clip: masses, hinges, gains",
    "imitate": "give one clip a body: train, simulate, score, report",
    "train": "train a recipe on one clip or a library, and no more",
    "inbetween": "fill the frames between keyframes of a clip with a trained network",
    "track": "let a trained policy do any motion, without training",
    "fleet": "imitate every clip of a library, here or on a Ray cluster",
    "eval": "score a trained run over every start frame",
    "play": "simulate a trained run from one frame and write a page to watch",
    "doctor": "what is wrong with a motion, and mend it; without a clip: is this machine ready",
}
_FIRST = (
    ("poise info walk.bvh", "what the clip holds"),
    ("poise imitate walk.bvh -o result", "ten minutes of training; then open result/report.html"),
    ("poise play result --open", "watch it"),
    ("poise eval result", "the score card"),
    ("poise doctor walk.bvh", "what is wrong with the motion"),
    ("poise doctor", "whether this machine is ready"),
)
_INTERRUPTED = 130
_PIPE_CLOSED = 141
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command line (default: the process's own) and returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    return guarded(lambda: _run(given))


def guarded(work: Callable[[], int]) -> int:
    """The exit code of `work`; every failure of it becomes one sentence."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # A name that the terminal cannot show must not end the program.
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        code = work()
        sys.stdout.flush()
        return code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except BrokenPipeError:
        # Whoever read our output has seen enough; what is still buffered goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _PIPE_CLOSED
    except KeyboardInterrupt:
        return _fail("interrupted", _INTERRUPTED)
    except PoiseError as problem:
        return _fail(str(problem), 2)
    except OSError as problem:
        if problem.filename is None and problem.errno not in _DISK:
            return _unexpected(problem)
        return _fail(str(of_path(problem)), 2)
    except MemoryError:
        return _fail("there is not enough memory; use fewer --envs or a shorter clip", 1)
    except Exception as problem:
        return _unexpected(problem)


def of_path(problem: OSError) -> PoiseError:
    """A failed access to a path of the user's, in one sentence."""
    reason = (problem.strerror or str(problem)).lower()
    hint = "Free some space" if problem.errno in _DISK[:2] else "Choose a path that can be used"
    return PoiseError(f"cannot be read or written ({reason})", problem.filename or "the disk", hint)


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        welcome()
        return 0
    if argv[0] in ("--version", "-V"):
        sys.stdout.write(f"poise {__version__}\n")
        return 0
    verb, rest = argv[0], argv[1:]
    if verb not in VERBS:
        raise PoiseError(f"there is no command '{verb}'. {did_you_mean(verb, list(VERBS))}")
    from poise.cli.parse import parse

    module = import_module(f"poise.cli.{verb}")
    options = parse(module.Options, rest, f"poise {verb}")
    _share_cores()
    return module.run(options, rest)


def _share_cores() -> None:
    """One thread for torch, since the physics uses the cores; OMP_NUM_THREADS overrules it."""
    try:
        import mujoco
        import torch
    except ImportError:
        # Only `doctor` runs without them, and it says what to do.
        return
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    # The guard reports instabilities; MuJoCo's own log would litter the user's folder.
    mujoco.set_mju_user_warning(lambda _: None)


def welcome() -> None:
    """The short help of `poise` alone."""
    lines = ["Poise gives any human motion a body: a clip in, the same motion simulated out.", ""]
    wide = max(len(line) for line, _ in _FIRST)
    lines += [f"  {line:<{wide}}  {why}" for line, why in _FIRST]
    lines += ["", "All commands:"]
    lines += [f"  {verb:<9} {what}" for verb, what in VERBS.items()]
    lines += ["", "poise COMMAND --help tells its options; poise --version the version."]
    sys.stdout.write("\n".join(lines) + "\n")


def _fail(sentence: str, code: int) -> int:
    from poise.cli.console import error

    if os.environ.get("POISE_DEBUG") and code != _INTERRUPTED:
        traceback.print_exc()
    # A mistake of the user's is told by rank 0 for all processes; a fault may be one process's own.
    error(sentence, everywhere=code == 1)
    return code


def _unexpected(problem: Exception) -> int:
    said = f": {problem}" if str(problem) else ""
    return _fail(
        f"unexpected {type(problem).__name__}{said}. This is a fault of Poise; set POISE_DEBUG=1 "
        "and run again for the traceback",
        1,
    )


if __name__ == "__main__":
    sys.exit(main())
