"""`poise VERB ...`: finds the verb, runs it, and turns every failure into one sentence.

Exit codes: 0 done; 1 a fault of Poise or of the machine; 2 a mistake that the user can mend; 3 done, but
a motion was lost; 130 Ctrl-C.
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from poise import __version__
from poise.cli.console import INTERRUPTED, Answer, document, failure, inputs_of
from poise.errors import PoiseError, did_you_mean

#: Every verb and what it does; its module is imported only when it runs.
VERBS = {
    "demo": "try it: the walk that comes with Poise, imitated in under two minutes",
    "info": "what a motion file holds: joints, rate, unit, height, what was guessed",
    "convert": "write a motion file in another format or at another rate",
    "retarget": "move a clip onto another human skeleton",
    "body": "the physical body that is made for a clip: masses, hinges, gains",
    "imitate": "give one clip a body: train, simulate, score, report",
    "train": "train a recipe on one clip or a library, and no more",
    "inbetween": "fill the frames between keyframes of a clip with a trained network",
    "complete": "from keyframes to a body: fill the frames, and let a character do them",
    "track": "let a trained policy do any motion, without training",
    "push": "a motion with a push in it: the character gives way and comes back",
    "open": "a page for people who animate: see, mend, give it a body, push, export",
    "live": "streams of motion in, characters in a browser out: push them, they get up",
    "dream": "let a character go about, without task, clip or end",
    "fleet": "imitate every clip of a library, here or on a Ray cluster",
    "eval": "score a trained run over every start frame",
    "play": "simulate a trained run from one frame and write a page to watch",
    "doctor": "what is wrong with a motion, and mend it; without a clip: is this machine ready",
}
#: Verbs that only read, mend and write motions: they need neither torch nor MuJoCo.
_LIGHT = ("info", "convert", "retarget", "doctor")
_FIRST = (
    ("poise demo", "two minutes, no clip of yours; then open demo/report.html"),
    ("poise info walk.bvh", "what the clip holds"),
    ("poise imitate walk.bvh -o result", "ten minutes of training; then open result/report.html"),
    ("poise play result --open", "watch it"),
    ("poise eval result", "the score card"),
    ("poise doctor walk.bvh", "what is wrong with the motion"),
    ("poise doctor", "whether this machine is ready"),
)
#: `poise play compliant SCENE`.
COMPLIANT = "compliant"
_PIPE_CLOSED = 141


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command line (default: the process's own) and returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    answer, inputs, problems = Answer(), [], []

    def work() -> int:
        made = _run(given, inputs)
        vars(answer).update(vars(made))
        return made.exit_code

    if "--json" not in given or {"-h", "--help"} & {*given}:
        return guarded(work)
    with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):
        answer.exit_code = guarded(work, problems.append)
    from poise.cli.console import say_json

    return guarded(lambda: say_json(document(given[0], inputs, answer, *problems or [None]))) or (
        answer.exit_code
    )


def guarded(work: Callable[[], int | None], told: Callable[[PoiseError], Any] | None = None) -> int:
    """The exit code of `work`; every failure of it becomes one sentence on stderr, which `told` gets."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # A name that the terminal cannot show must not end the program.
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        code = work() or 0
        sys.stdout.flush()
        return code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except BrokenPipeError:
        # The reader of our output has closed it; what is still buffered goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _PIPE_CLOSED
    except (KeyboardInterrupt, Exception) as problem:
        from poise.cli.console import error

        code, sentence = failure(problem)
        if os.environ.get("POISE_DEBUG") and code != INTERRUPTED:
            traceback.print_exc()
        # A mistake of the user's is told by rank 0 for all processes; a fault may be one process's own.
        error(str(sentence), everywhere=code == 1)
        if told is not None:
            told(sentence)
        return code


def _run(argv: list[str], inputs: list[Path]) -> Answer:
    """Finds the verb and runs it; `inputs` is filled with what it reads before it does."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        welcome()
        return Answer()
    if argv[0] in ("--version", "-V"):
        sys.stdout.write(f"poise {__version__}\n")
        return Answer()
    verb, rest = argv[0], argv[1:]
    if verb not in VERBS:
        raise PoiseError(
            f"there is no command '{verb}'. {did_you_mean(verb, list(VERBS))}", code="unknown-verb"
        )
    from poise.cli.console import notes, say, tell
    from poise.cli.parse import options_of, parse
    from poise.cli.recipe_options import named_options

    name, prog, rest = parser_of(verb, rest)
    module = import_module(f"poise.cli.{name}")
    # A command that prints the settings alone need name no files.
    blank = module.blank() if "--print-config" in rest and hasattr(module, "blank") else None
    known = options_of(module)
    options = parse(known, rest, prog, blank)
    if blank is None:
        inputs += inputs_of(options)
        # What is imported now takes seconds.
        tell(_begins(verb, inputs), "dim")
    if verb not in (*_LIGHT, "open"):
        # The jobs of the page have processes of their own.
        share_cores()
    with named_options(known, rest):
        answer = module.run(**options) if isinstance(options, dict) else module.run(options, rest)
    notes([n for n in answer.notes if n not in answer.said])
    for path in answer.outputs.values():
        say(str(path))
    return answer


def parser_of(verb: str, rest: list[str]) -> tuple[str, str, list[str]]:
    """The module in `cli` that parses a command line, how its help calls it, and what it parses."""
    if verb == "play" and rest[:1] == [COMPLIANT] and not Path(COMPLIANT).exists():
        # A scene of the policy that comes with Poise, and no run.
        return "play_compliant", f"poise play {COMPLIANT}", rest[1:]
    return verb, f"poise {verb}", rest


def _begins(verb: str, inputs: Sequence[Path]) -> str:
    """What the verb begins with: "reading walk.bvh"."""
    if not inputs:
        return "looking at this machine" if verb == "doctor" else f"poise {verb}"
    more = f" and {len(inputs) - 3} more" if len(inputs) > 3 else ""
    doing = "opening" if verb in ("eval", "play") else "reading"
    return f"{doing} {', '.join(map(str, inputs[:3]))}{more}"


def share_cores() -> None:
    """One thread for torch, since the physics uses the cores; OMP_NUM_THREADS overrules it."""
    import mujoco
    import torch

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


if __name__ == "__main__":
    sys.exit(main())
