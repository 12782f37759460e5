"""Damages sound files and reads them, until the time is over.

python -m tests.fuzz --minutes 30 --seed 1 --keep odd

A file is kept where something is wrong, and the first few of each new sentence or place. Reading happens
in a process of its own, under a limit of memory; a crash, a hang and a hunger are told as what they are.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from .corpus import Case, hash_of, pack
from .mutate import mutate
from .oracle import Verdict
from .seeds import NATIVE, Seed, seeds
from .worker import Worker

#: Kept files of one sentence.
SAME = 3
#: Every so many files are, where they were read, written and read again.
AGAIN = 5
#: Files that go to the reading process at once.
BATCH = 64


def key_of(kind: str, verdict: Verdict) -> str:
    """What tells one outcome from another: the sentence without its values."""
    text = re.sub(r"'[^']*'|[-+]?\d[\d.e+-]*|nan|inf", "#", verdict.text)
    return f"{kind} {verdict.kind} {text[:80]}"


def fuzz(
    sound: list[Seed],
    minutes: float,
    seed: int,
    most: int | None = None,
    save: Callable[[Counter[str], dict[str, str]], None] = lambda counts, odd: None,
) -> tuple[Counter[str], dict[str, list[Case]]]:
    """Counts by format and verdict, and the kept cases by outcome.

    save: is given the counts and what is wrong, now and then.

    Each sound file gets about the same time: what is read slowly is damaged less often.
    """
    rng, worker, counts, kept = random.Random(seed), Worker(), Counter[str](), dict[str, list[Case]]()
    end, tried = time.monotonic() + 60 * minutes, 0
    odd: dict[str, str] = {}
    parents: dict[str, list[dict[str, bytes]]] = {s.name: [s.files] for s in sound}
    spent, number = Counter({s.name: 0.005 for s in sound}), Counter({s.name: 1 for s in sound})
    while time.monotonic() < end and (most is None or tried < most):
        odds = [number[s.name] / spent[s.name] for s in sound]
        batch: list[tuple[Seed, dict[str, bytes]]] = []
        for one in rng.choices(sound, odds, k=min(BATCH, most - tried if most else BATCH)):
            # What was found before is damaged further.
            files = dict(rng.choice(parents[one.name]))
            victim = rng.choice(list(files))
            files[victim] = mutate(files[victim], rng)
            batch.append((one, files))
        cases = [(one.name, files, (tried + k) % AGAIN == 0) for k, (one, files) in enumerate(batch)]
        for (one, files), (verdict, seconds) in zip(batch, worker.judge(cases), strict=True):
            tried += 1
            counts[f"{one.format} {verdict.kind}"] += 1
            spent[one.name] += min(seconds, 1.0)
            number[one.name] += 1
            key = key_of(one.format, verdict)
            same = kept.setdefault(key, [])
            if not verdict.sound and key not in odd:
                odd[key] = verdict.text
                print(f"{tried}: {key}\n    {verdict.text}", flush=True)
            if len(same) < (SAME if verdict.kind == "refused" else 40):
                same.append((one.format, one.name, files))
                if verdict.sound and sum(map(len, files.values())) < 20_000:
                    parents[one.name].append(files)
        if tried // 5000 != (tried - len(batch)) // 5000:
            left = (end - time.monotonic()) / 60
            print(f"{tried:,} files, {len(kept)} outcomes, {left:.0f} minutes left", flush=True)
            save(counts, odd)
    worker.close()
    save(counts, odd)
    return counts, kept


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--formats", nargs="+", help="by default all but those read by native libraries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--files", type=int, help="at most so many")
    parser.add_argument("--json", type=Path, help="for the counts, written now and then")
    parser.add_argument("--keep", type=Path, help="folder for odd files, as an archive and one by one")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        every = seeds(Path(folder))
    known = sorted({s.format for s in every})
    if args.formats and (wrong := set(args.formats) - set(known)):
        parser.error(f"no such format: {', '.join(sorted(wrong))}; there are {', '.join(known)}")
    sound = [s for s in every if s.format in (args.formats or set(known) - set(NATIVE))]

    def save(counts: Counter[str], odd: dict[str, str]) -> None:
        if args.json is not None:
            told = {
                "command": "python -m tests.fuzz " + " ".join(sys.argv[1:]), "files": counts.total(),
                "outcomes": dict(sorted(counts.items())), "odd": odd,
            }  # fmt: skip
            args.json.write_text(json.dumps(told, indent=1) + "\n")

    counts, kept = fuzz(sound, args.minutes, args.seed, args.files, save)
    print(json.dumps({"files": counts.total(), "outcomes": dict(sorted(counts.items()))}, indent=1))
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
        small = (c for some in kept.values() for c in some if sum(map(len, c[2].values())) < 50_000)
        cases = {hash_of(c[2]): c for c in small}
        count = pack(cases.values(), args.keep / f"kept_{args.seed}.tar.xz")
        print(f"{count} files are kept in {args.keep}")


if __name__ == "__main__":
    main()
