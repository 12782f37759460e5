"""Damages sound files and reads them, until the time is over.

python -m tests.fuzz --minutes 30 --seed 1 --keep odd

A file is kept where something is wrong, and the first few of each new sentence or place. Reading happens
in a process of its own, under a limit of memory; a crash, a hang and a hunger are told as what they are.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from .corpus import Case, hash_of, pack
from .mutate import mutate
from .oracle import Verdict
from .seeds import FITTED, NATIVE, Seed, seeds
from .tally import Tally, record
from .worker import Worker

#: Kept files of one sentence.
SAME = 3
#: Every so many files are, where they were read, written and read again.
AGAIN = 5
#: Files that go to the reading process at once.
BATCH = 64


class Parents:
    """What is damaged next: the sound file, one that was read or one that was refused.

    A refused file is seldom refused elsewhere when it is damaged further, so not all are. Files grow,
    and large ones take time and tell no more: those above twice the sound one are left.
    """

    def __init__(self, sound: dict[str, bytes]) -> None:
        self.sound, self.read, self.refused = sound, list[dict[str, bytes]](), list[dict[str, bytes]]()

    def some(self, rng: random.Random) -> dict[str, bytes]:
        """One of them."""
        share = rng.random()
        if share < 0.45 and self.refused:
            return rng.choice(self.refused)
        return rng.choice(self.read) if share < 0.7 and self.read else self.sound

    def add(self, verdict: Verdict, files: dict[str, bytes]) -> None:
        """Another one, where it is sound and small."""
        most = 1000 + 2 * sum(map(len, self.sound.values()))
        if verdict.sound and sum(map(len, files.values())) < most:
            (self.read if verdict.kind == "read" else self.refused).append(files)


def fuzz(
    sound: list[Seed],
    minutes: float,
    seed: int,
    most: int | None = None,
    save: Callable[[Tally], None] = lambda tally: None,
    found: Callable[[Case], None] = lambda case: None,
) -> tuple[Tally, dict[str, list[Case]]]:
    """The tally, and the kept cases by outcome.

    save: is given the tally now and then. found: is given what is wrong in a new way, at once.

    What is read slowly is damaged less often: a sound file gets time by the inverse square root of what
    its children cost, one for a native library or of keypoints a fifth of that.
    """
    rng, worker, tally = random.Random(seed), Worker({s.format for s in sound}), Tally()
    kept, tried, end = dict[str, list[Case]](), 0, time.monotonic() + 60 * minutes
    parents = {s.name: Parents(s.files) for s in sound}
    share = {s.name: 0.2 if s.format in NATIVE or s.name in FITTED else 1.0 for s in sound}
    cost = {s.name: 0.05 if s.format in NATIVE else 0.005 for s in sound}
    spent, number = Counter(cost), Counter({s.name: 1 for s in sound})
    while time.monotonic() < end and (most is None or tried < most):
        odds = [share[s.name] * (number[s.name] / spent[s.name]) ** 1.5 for s in sound]
        batch: list[tuple[Seed, dict[str, bytes]]] = []
        for one in rng.choices(sound, odds, k=min(BATCH, most - tried if most else BATCH)):
            # What was found before is damaged further.
            files = dict(parents[one.name].some(rng))
            victim = rng.choice(list(files))
            files[victim] = mutate(files[victim], rng)
            batch.append((one, files))
        # Bodies (MJCF) are not written.
        cases = [
            (one.name, files, (tried + k) % AGAIN == 0 and one.format != "mjcf")
            for k, (one, files) in enumerate(batch)
        ]
        told = worker.judge(cases)
        for (one, files), (_, _, again), (verdict, seconds) in zip(batch, cases, told, strict=True):
            tried += 1
            key, new = tally.add(one.format, verdict, again)
            spent[one.name] += min(seconds, 1.0)
            number[one.name] += 1
            if new:
                print(f"{tried}: {key}\n    {verdict.text}", flush=True)
                found((one.format, one.name, files))
            same = kept.setdefault(key, [])
            if len(same) < (SAME if verdict.kind == "refused" else 40):
                same.append((one.format, one.name, files))
                parents[one.name].add(verdict, files)
        if tried // 5000 != (tried - len(batch)) // 5000:
            left = (end - time.monotonic()) / 60
            print(f"{tried:,} files, {len(kept)} outcomes, {left:.0f} minutes left", flush=True)
            save(tally)
    worker.close()
    save(tally)
    return tally, kept


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--formats", nargs="+", help="by default all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--files", type=int, help="at most so many")
    parser.add_argument("--json", type=Path, help="to which the counts are added, now and then")
    parser.add_argument("--keep", type=Path, help="folder for odd files, as an archive and one by one")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        every = seeds(Path(folder))
    known = sorted({s.format for s in every})
    if args.formats and (wrong := set(args.formats) - set(known)):
        parser.error(f"no such format: {', '.join(sorted(wrong))}; there are {', '.join(known)}")
    sound = [s for s in every if s.format in (args.formats or known)]
    save = record(args.json, sys.argv[1:]) if args.json is not None else lambda tally: None

    def found(case: Case) -> None:
        if args.keep is not None:
            pack([case], args.keep / f"odd_{hash_of(case[2])}.tar.xz")

    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
    tally, kept = fuzz(sound, args.minutes, args.seed, args.files, save, found)
    print(json.dumps(tally.told(), indent=1))
    if args.keep is not None:
        small = (c for some in kept.values() for c in some if sum(map(len, c[2].values())) < 50_000)
        cases = {hash_of(c[2]): c for c in small}
        count = pack(cases.values(), args.keep / f"kept_{args.seed}.tar.xz")
        print(f"{count} files are kept in {args.keep}")


if __name__ == "__main__":
    main()
