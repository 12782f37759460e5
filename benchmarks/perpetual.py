"""What runs of `poise train perpetual` have come to, as the field reports it.

    python benchmarks/perpetual.py --runs NAME=RUN ... --clips FOLDER --hold-out "cmu 02" [--parts ...]

RUN is the run's folder, FOLDER the library that it was trained on, of which the clips that were held out
are read again. Nothing helps. Parts (all by default; what a part lacks, such as FOLDER, leaves it out):

    table     success and errors on held-out clips and on the library, by source too, beside those of
              doing nothing and the paper's rows
    search    the same where what the policy loses is searched, by --characters at once
    recovery  1,000 trials each fallen, far and both, against a body that stands at ease
    owners    the composer against every primitive, clip by clip
    noise     success over the strength of a video estimator's noise
    noisy     the files of real estimators in the folders --noisy
    speed     ms a control step of one character; 16 characters in one world on 2 threads
    curves    success, help and error over samples

Writes `perpetual.json`, `perpetual.md` and the curves next to -o (here by default). Results of parts and
runs that are not asked for stay, so that the measurement can be made in pieces; recovery goes on after
the kind that was finished last. A run with a changed policy is measured anew.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from field.model_card import model_card
from perpetual_curves import draw, draw_runs, read_curve
from perpetual_live import noise, noisy, speed
from perpetual_measure import (
    Run,
    by_body,
    held_out,
    library_task,
    owners,
    recorded,
    recovery,
    recovery_kinds,
    subjects,
    table,
)
from perpetual_search import searched
from perpetual_text import report
from speed import machine

from poise.env import Acts
from poise.errors import PoiseError
from poise.learn.checkpoint import write_atomic
from poise.motion import ClipLibrary
from poise.plan import SamplingConfig
from poise.score import Nothing

PARTS = ("table", "search", "recovery", "owners", "noise", "noisy", "speed", "curves")
Save = Callable[[], None]


class Measurement:
    """The measurement of one run, of which finished parts stay."""

    def __init__(self, run: Run, a: argparse.Namespace, out: Path, parts: dict[str, Any], save: Save):
        self.run, self.a, self.out, self.parts, self.save = run, a, out, parts, save
        self._held: tuple[ClipLibrary, list[str]] | None = None

    def measure(self, part: str) -> None:
        """One part, which replaces what there was of it."""
        found = getattr(self, f"_{part}")()
        if found is not None:
            self.parts[part] = found
        self.save()

    def held(self) -> tuple[ClipLibrary, list[str]]:
        """The clips that were held out, read once, and sentences on them."""
        if self._held is None:
            a = self.a
            self._held = held_out(self.run, a.clips, a.hold_out, a.never, a.cache, say)
        return self._held

    def _table(self) -> dict[str, Any]:
        run, threads = self.run, self.a.threads
        out: dict[str, Any] = {"machine": machine()}
        if self.a.clips is not None:
            clips, out["notes"] = self.held()
            out["held_out_subjects"] = subjects(clips.names)
            task = library_task(run, clips)
            for key, policy, method in self._methods("held_out"):
                out[key] = table(task, policy, "held-out clips", method, threads).to_dict()
        own, made = recorded(run.imitation.library.names)
        for key, policy, method in self._methods("library"):
            of = table(run.imitation, policy, "training library", method, threads, own)
            out[key] = of.to_dict()
            if method == run.name and not made and (bodies := by_body(run.imitation, of)):
                out["bodies"] = bodies
        if made:
            said = "the same mirrored and backwards"
            whole = table(run.imitation, run.policy, said, run.name, threads, made)
            out["library_made"] = whole.to_dict()
        return out

    def _methods(self, key: str) -> tuple[tuple[str, Acts, str], ...]:
        """The run's policy and the null that it must beat, with their keys and names."""
        nothing = Nothing(self.run.policy.num_actions)
        return (key, self.run.policy, self.run.name), (f"{key}_nothing", nothing, "nothing")

    def _search(self) -> dict[str, Any]:
        run, a, out = self.run, self.a, {}
        config, own = SamplingConfig(a.characters), recorded(run.imitation.library.names)[0]
        if a.clips is not None:
            task = library_task(run, self.held()[0])
            every = range(len(task.reference.length))
            out["held_out"] = searched(run, task, "held-out clips", every, config, a.threads, say)
        if not a.unseen:
            said = "training library"
            out["library"] = searched(run, run.imitation, said, own, config, a.threads, say)
        return out | {"machine": machine()}

    def _recovery(self) -> None:
        done = self.parts.setdefault("recovery", {"kinds": {}, "reference": "standing at ease"})
        for kind in recovery_kinds():
            if done["kinds"].get(kind, {}).get("trials") == self.a.trials and not self.a.again:
                continue
            card = recovery(self.run, kind, self.a.trials, self.a.threads)
            row = card.pop("rows")[0]
            done["kinds"][kind] = row | {k: card[k] for k in ("near", "held", "seed", "learned")}
            say(f"{kind}: {100 * row['within'][-1]:.1f} % back")
            self.save()

    def _owners(self) -> dict[str, Any]:
        return owners(self.run, self.a.threads)

    def _noise(self) -> dict[str, Any]:
        clips = self.run.imitation.library if self.a.clips is None else self.held()[0]
        return noise(self.run, clips, self.a.noise_clips, self.a.strengths, self.a.each, say)

    def _noisy(self) -> dict[str, Any] | None:
        return noisy(self.run, self.a.noisy, say) if self.a.noisy else None

    def _speed(self) -> dict[str, Any]:
        return speed(self.run, self.a.steps, self.a.count)

    def _curves(self) -> dict[str, Any]:
        curve = read_curve(self.run.folder)
        image = f"{self.out.stem}_{self.run.name}.svg".replace(" ", "_")
        draw(self.run.name, curve, self.out.with_name(image))
        return curve | {"image": image}


def main(argv: list[str] | None = None) -> None:
    a = arguments().parse_args(argv)
    torch.set_num_threads(1)
    path: Path = a.out
    result = json.loads(path.read_text()) if path.exists() else {"runs": {}}
    words = sys.argv[1:] if argv is None else argv
    result = {"command": f"python benchmarks/perpetual.py {_plain(words)}", "machine": machine()} | {
        "runs": result["runs"]
    }

    def save() -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(shortened(result), indent=1, allow_nan=False)
        write_atomic(path, f"{text}\n".encode())
        write_atomic(path.with_suffix(".md"), report(result).encode())

    for text in a.runs:
        name, equals, folder = text.partition("=")
        run = Run.open(name if equals else Path(text).name, Path(folder if equals else text), a.policy)
        parts = result["runs"].setdefault(run.name, {})
        hardware = a.hardware or parts.get("about", {}).get("hardware", "")
        about = run.about(hardware)
        if parts.get("about", {}).get("policy", about["policy"]) != about["policy"]:
            parts.clear()
        parts["about"] = about
        measurement = Measurement(run, a, path, parts, save)
        for part in a.parts:
            say(f"{run.name}: {part}")
            measurement.measure(part)
    curves = {n: p["curves"] for n, p in result["runs"].items() if "curves" in p}
    if len(curves) > 1:
        draw_runs(curves, path.with_name(f"{path.stem}_runs.svg"))
    save()
    if a.card is not None:
        write_card(result["runs"], a)
    say(str(path.with_suffix(".md")))


def shortened(value: Any) -> Any:
    """The same with numbers of six digits."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: shortened(x) for key, x in value.items()}
    return [shortened(x) for x in value] if isinstance(value, list | tuple) else value


def write_card(runs: Mapping[str, Any], a: argparse.Namespace) -> None:
    """The model card of one run, with its learning curves beside it."""
    name = a.card_of or next(iter(runs))
    if name not in runs:
        raise PoiseError(
            f"there is no run '{name}'", hint=f"Measured are {', '.join(runs)}", code="unknown-choice"
        )
    image = a.card.with_suffix(".svg")
    a.card.parent.mkdir(parents=True, exist_ok=True)
    drawn = "curves" in runs[name]
    if drawn:
        draw(name, runs[name]["curves"], image)
    card = model_card(runs[name], _licences(a.licence), image.name if drawn else "", title=a.title)
    write_atomic(a.card, card.encode())
    say(str(a.card))


def arguments() -> argparse.ArgumentParser:
    """The options."""
    p = argparse.ArgumentParser(description="What runs of poise train perpetual have come to")
    p.add_argument("--runs", nargs="+", required=True, metavar="NAME=RUN")
    p.add_argument("--policy", type=Path, help="measure this in place of the run's")
    p.add_argument("--clips", type=Path, metavar="FOLDER", help="where the held-out clips lie")
    p.add_argument("--hold-out", nargs="*", default=[], metavar="PATTERN", help="subjects, expressions")
    p.add_argument("--never", nargs="*", default=[], metavar="PATTERN", help="clips that are not read")
    p.add_argument("--cache", type=Path, help="a folder for the library that is read")
    p.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    p.add_argument("--characters", type=int, default=512, help="that search at once")
    p.add_argument("--unseen", action="store_true", help="search held-out clips alone")
    p.add_argument("--trials", type=int, default=1000)
    p.add_argument("--again", action="store_true", help="make finished kinds of recovery again")
    p.add_argument("--noise-clips", type=int, default=20)
    p.add_argument("--strengths", type=float, nargs="+", default=[0.0, 0.25, 0.5, 1.0, 2.0, 4.0])
    p.add_argument("--each", action="store_true", help="each kind of noise alone, too")
    p.add_argument("--noisy", type=Path, nargs="*", default=[], metavar="FOLDER")
    p.add_argument("--steps", type=int, default=600, help="control steps that are timed")
    p.add_argument("--count", type=int, default=16, help="characters in one world")
    p.add_argument("--threads", type=int, default=1)
    p.add_argument("--hardware", default="", help="what the runs were trained on")
    p.add_argument("-o", "--out", type=Path, default=Path(__file__).with_name("perpetual.json"))
    p.add_argument("--card", type=Path, metavar="FILE", help="write a model card, too")
    p.add_argument("--card-of", default="", metavar="NAME", help="of this run; the first by default")
    p.add_argument("--title", default="Tracker", help="of the model card")
    p.add_argument("--licence", nargs="*", default=[], metavar="DATA=TEXT", help="for the model card")
    return p


def _licences(texts: list[str]) -> Mapping[str, str]:
    parts = [t.partition("=") for t in texts]
    if bad := [t for t, (_, equals, said) in zip(texts, parts, strict=True) if not (equals and said)]:
        raise PoiseError(f"--licence needs DATA=TEXT, got '{bad[0]}'", code="option-malformed")
    return {data.strip(): said.strip() for data, _, said in parts}


def _plain(words: list[str]) -> str:
    """The command without what is this machine's alone: folders by their last name."""
    parts = (w.rpartition("=") for w in words)
    return shlex.join(name + equals + _last(value) for name, equals, value in parts)


def _last(word: str) -> str:
    return Path(word).name if word.startswith(("/", "~")) else word


def say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    try:
        main()
    except PoiseError as problem:
        sys.exit(str(problem))
