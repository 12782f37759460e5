"""Motion without end: falls an hour, slide, jerk, repeats, points that are reached, and what is
predicted.

Nothing helps the character. The policy alone does all rollouts of a part side by side, in as many
worlds, each from a past that is drawn; where futures are tried, as `poise dream` does, the part says so,
and those that look ahead, one by one, try them, too. What is down in the
end has 15 s more to get up; without recovery a rollout counts until the character falls. The null does
nothing (action 0).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.clips import Places, library, moment
from benchmarks.common.rows import Figure, mean_of, of
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import Nothing
from benchmarks.suites.lookahead_search import SMALL
from poise.body import Humanoid
from poise.env import Acts, ImitationEnv
from poise.env.generator_goal import GeneratorGoal, Steering
from poise.env.recovery.recovering import FALLS, TRACKS, Recovering
from poise.jobs.endless.dreaming import dream, other_pasts, rehearsed
from poise.jobs.endless.dreamt import PIECE, Dream, Figures
from poise.jobs.endless.model import GeneratorModel, load_generator
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.kinematics.forward import Kinematics
from poise.motion.rotations import heading_quat, quat_conj, quat_rotate
from poise.score import simulate
from poise.sim.guard import UnstableError
from poise.synthesis.generator import Kinematic

#: s between the moments that are compared, and length of what is compared, s.
EVERY_S, LONG_S = 0.5, 2.0


#: Mean distance (m) of bodies below which two stretches are the same motion; s that lie between them.
SAME, APART_S = 0.08, 10.0


def local_places(humanoid: Humanoid, qpos: Tensor) -> Tensor:
    """Places of the bodies about the root, in its heading, `(T, B, 3)` m."""
    pos = Kinematics(humanoid.table)(qpos.double()).pos
    turn = quat_conj(heading_quat(qpos[:, 3:7].double()))[:, None].expand(-1, pos.shape[1], -1)
    return quat_rotate(turn, pos - pos[:, :1])


def repeats(humanoid: Humanoid, qpos: np.ndarray, fps: float) -> dict[str, Any]:
    """How much of a motion was there before: of its stretches of `LONG_S` the share that an earlier one,
    `APART_S` before, is like, and when that happens first."""
    local, step, long = local_places(humanoid, torch.tensor(qpos)), int(EVERY_S * fps), int(LONG_S * fps)
    starts = torch.arange(0, max(0, len(local) - long), step)
    if len(starts) < 2:
        return {"repeated_share": None, "first_repeat_s": None}
    bodies = local.shape[1]
    flat = torch.stack([local[s : s + long : 3].flatten() for s in starts])
    # Mean of distances by their root mean square, which is never smaller.
    apart = torch.cdist(flat, flat) / (flat.shape[1] / 3) ** 0.5
    assert flat.shape[1] % (3 * bodies) == 0
    early = starts[:, None] - starts[None] >= APART_S * fps
    least = torch.where(early, apart, torch.inf).amin(1)
    can = early.any(1)
    same = (least < SAME) & can
    first = same.nonzero()
    return {
        "repeated_share": round(float(same.sum() / can.sum().clamp_min(1)), 3),
        "first_repeat_s": round(float(starts[int(first[0])] / fps), 1) if len(first) else None,
    }


def visited(humanoid: Humanoid, seeds: Tensor, qpos: np.ndarray, fps: float) -> list[int]:
    """The nearest of `seeds (S, p, 7 + n)`, a second of the library each, evenly spread, to each half
    second of a motion."""
    p = seeds.shape[1]
    places = local_places(humanoid, seeds.flatten(0, 1)).unflatten(0, seeds.shape[:2])
    some = places[:, :: p // 5].flatten(1)
    local = local_places(humanoid, torch.tensor(qpos))
    own = [local[k : k + p : p // 5].flatten() for k in range(0, len(local) - p + 1, p // 2)]
    return torch.cdist(torch.stack(own), some).argmin(1).tolist() if own else []


# --- worlds side by side ---------------------------------------------------------------------------


#: s for which what is down in the end is waited for.
AFTER_S = 15.0


@dataclass
class Rollouts:
    """Motion of worlds.

    Attributes:
        done, asked: `(N, T, 7 + n)`, as it was simulated, and the goals; only `count` frames are there.
        lost, back, reached: (world, s); of those that get up after the end, too.
        bad: how often all worlds began anew since a simulation went bad.
    """

    done: np.ndarray
    asked: np.ndarray
    count: int
    lost: list[tuple[int, float]]
    back: list[tuple[int, float]]
    reached: list[tuple[int, float]]
    bad: int = 0

    def of(self, world: int) -> tuple[list[float], list[float], bool]:
        """s of a world's falls, s that each took until it was up again, and whether it stayed down, also
        `AFTER_S` after the end."""
        falls = [t for i, t in self.lost if i == world]
        ups = [t for i, t in self.back if i == world]
        away = [up - fall for fall, up in zip(falls, ups, strict=False)]
        return falls, away, len(ups) < len(falls)


class _Keeps:
    """Keeps every world's frames."""

    def __init__(self, goal: Recovering, out: Rollouts):
        self.goal, self.out = goal, out
        self._frames, self.over = out.done.shape[1], False

    def see(self, env: ImitationEnv, step: int) -> bool:
        """One more frame."""
        if step == 0:
            return False
        k = self.out.count
        if k == self._frames:
            # What is down gets up, or does not; frames are not kept any more.
            return bool((self.goal.doing == TRACKS).all())
        self.out.done[:, k] = env.backend.state.qpos
        self.out.asked[:, k] = self.goal.start(None)[0]
        self.out.count += 1
        # Without recovery there is no more to see once all have fallen.
        self.over = self.goal.get_up is None and bool((self.goal.doing == FALLS).all())
        return self.over


def told(out: Rollouts, goal: Recovering) -> None:
    """Takes the times from a goal; what happens after the end counts only if it is getting up."""
    for name, found in (("lost", goal.lost), ("back", goal.back), ("reached", goal.reached)):
        last = out.count if name != "back" else math.inf
        setattr(out, name, [(i, round(s / goal.rate_hz, 2)) for i, s in found if s <= last])


def rollouts(
    tracker: Tracker,
    made: Kinematic,
    count: int,
    seconds: float,
    acts: Acts | None = None,
    recover: bool = True,
    past: str = "own",
    targets: tuple[tuple[float, float], ...] = (),
    label_seconds: float = 10.0,
    tries: int = 1,
) -> Rollouts:
    """`count` rollouts; number k begins from a past drawn with seed k, all later draws are of seed 0."""
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all"))
    rate, steps = tracker.config.sim.control_hz, round(seconds * tracker.config.sim.control_hz)
    begins = [made.begin(1, torch.Generator().manual_seed(k)) for k in range(count)]
    pasts = torch.cat(begins)

    def following(worlds: int, plans: bool) -> Recovering:
        motion = GeneratorGoal(
            made.wishing(0.0 if targets else label_seconds, worlds),
            tracker.humanoid,
            rate,
            worlds,
            lead=max(*tracker.config.window, 1) + 1,
            plans=plans,
            pasts=pasts if plans else pasts[:1].expand(worlds, -1, -1),
            steering=Steering(targets),
            simulated=past == "simulated",
        )
        out = Recovering(motion, tracker.recovery_clips if recover else None, plans=plans)
        out.reset(torch.arange(worlds))
        return out

    goal = following(count, True)
    acts = tracker.policy if acts is None else acts
    tried = None
    if tries > 1:
        acts = tried = rehearsed(acts, tracker, task, following, tries, 1)
    width = tracker.humanoid.model.nq
    empty = np.zeros((2, count, steps, width), np.float32)
    out = Rollouts(empty[0], empty[1], 0, [], [], [])
    env = task.env(count, None, False, 1, help_scale=0.0)
    try:
        over = False
        while out.count < steps and not over:
            if tried is not None:
                tried.watch(env, goal)
            env.backend.write(None, *goal.start(None))
            env.age[:] = 0
            obs = env.set_goal(goal)
            if tried is not None and not out.count:
                obs = other_pasts(env, goal, tried, made, count)
            try:
                keeps = _Keeps(goal, out)
                after = round(AFTER_S * rate) if recover else 0
                simulate(env, acts, obs, steps - out.count + after, keeps)
                over = keeps.over
            except UnstableError:
                out.bad += 1
                env.action[:] = 0
    finally:
        env.close()
        if tried is not None:
            tried.trials.copies.close()
    told(out, goal)
    return out


# --- rollouts -------------------------------------------------------------------------------------

NAMES = ("foot_slide_mm_per_s", "penetration_mm", "jerk_m_per_s3", "speed_m_per_s")
#: Futures that `poise dream` tries.
TRIES = Dream.tries
#: m between points, and how many there are.
STEP_M, POINTS = 5.0, 20
#: Subjects, and their rollouts: settings, how many, s of each, hours of a core.
ROLLOUTS: dict[str, tuple[dict[str, Any], int, float, float]] = {
    "futures tried, ten minutes each": ({"tries": TRIES}, 20, 600.0, 1.0),
    "policy alone": ({}, 20, 60.0, 0.1),
    "policy alone, ten minutes each": ({}, 20, 600.0, 1.0),
    "policy alone, recovery off": ({"recover": False}, 20, 60.0, 0.05),
    "policy alone, from its own past": ({"past": "simulated"}, 20, 60.0, 0.1),
    "nothing (action 0)": ({"acts": False}, 20, 60.0, 0.1),
}


@cache
def loaded() -> tuple[Tracker, GeneratorModel, Kinematic]:
    """The policy, the generator, and the generator for its body."""
    tracker, model = open_run(None).tracker, load_generator(None)
    return tracker, model, model.generator(tracker.humanoid)


def figures_of(qpos: np.ndarray) -> dict[str, Any]:
    """Slide, sinking, jerk, speed, standing still of coordinates `(T, 7 + n)`."""
    tracker, _, made = loaded()
    sums = Figures(tracker.humanoid, made.fps)
    for k in range(0, len(qpos), PIECE):
        sums.add(qpos[k : k + PIECE])
    return sums.to_dict()


def went(made: Rollouts, world: int, seconds: float, recover: bool = True) -> dict[str, Any]:
    """Figures of one rollout."""
    tracker, model, generator = loaded()
    fps, humanoid = generator.fps, tracker.humanoid
    falls, away, down = made.of(world)
    until = falls[0] if falls and not recover else made.count / fps
    frames = min(made.count, max(4, round(until * fps)))
    done = made.done[world, :frames].astype(float)
    seen = visited(humanoid, model.seeds, done, fps)
    kinds = Counter[int]() if model.kinds is None else Counter(model.kinds[seen].tolist())
    found = figures_of(done)
    return {
        "counted_s": until,
        "falls": len(falls),
        "away_s": away,
        "stayed_down": int(down),
        **{k: found[k] for k in NAMES},
        "still": found["still_s"] / until,
        "most": kinds.most_common(1)[0][1] / len(seen) if kinds else None,
        **repeats(humanoid, done, fps),
        "visited": len(set(seen)),
        "labels": len(kinds),
    }


def together(places: Places, unit: str, name: str) -> Any:
    """All rollouts of a subject side by side."""
    how, count, seconds, _ = ROLLOUTS[name]
    count, seconds = (1, 2.0) if places.smoke else (count, seconds)
    tracker, _, generator = loaded()
    acts: Acts = tracker.policy if how.get("acts", True) else Nothing(tracker.policy.num_actions)
    made = rollouts(
        tracker, generator, count, seconds, acts=acts, **{k: v for k, v in how.items() if k != "acts"}
    )
    return [went(made, k, seconds, how.get("recover", True)) for k in range(count)] + [{"bad": made.bad}]


def ahead(places: Places, unit: str) -> Any:
    """A rollout that looks ahead."""
    seconds, how = (1.0, {"lookahead": SMALL}) if places.smoke else (600.0, {})
    tracker, model, _ = loaded()
    done = dream(seconds, model, tracker, seed=int(unit.removeprefix("seed ")), threads=1, **how)
    one = done.characters[0]
    made = Rollouts(
        one.done.read()[None],
        one.asked.read()[None],
        one.done.count,
        list(done.lost),
        list(done.back),
        [],
    )
    return [went(made, 0, seconds)]


def rollout_rows(places: Places, raws: Raws, name: str) -> Iterator[Figure]:
    """Sums over rollouts, and means of those that could be measured."""
    rows = [r for raw in raws.values() for r in raw if "bad" not in r]
    counted, away = sum(r["counted_s"] for r in rows), [t for r in rows for t in r["away_s"]]
    values = {
        "falls_per_hour": 3600 * sum(r["falls"] for r in rows) / counted,
        "stayed_down": sum(r["stayed_down"] for r in rows),
        "foot_slide_mm_per_s": mean_of(r["foot_slide_mm_per_s"] for r in rows),
        "sinks_mm": mean_of(r["penetration_mm"] for r in rows),
        "jerk_m_per_s3": mean_of(r["jerk_m_per_s3"] for r in rows),
        "speed_m_per_s": mean_of(r["speed_m_per_s"] for r in rows),
        "away_s": mean_of(away),
        "hours": counted / 3600,
        "repeated_share": mean_of(r["repeated_share"] for r in rows),
        "labels_a_rollout": mean_of(r["labels"] for r in rows),
        "most_of_a_label": mean_of(r["most"] for r in rows),
        "still_share": mean_of(r["still"] for r in rows),
        "without_a_fall": sum(not r["falls"] for r in rows) / len(rows),
        "visited_a_rollout": mean_of(r["visited"] for r in rows),
        "went_bad": sum(r["bad"] for raw in raws.values() for r in raw if "bad" in r),
    }
    yield from of(name, values, len(rows), seeds=len(rows))


# --- steering, the library, what is predicted ----------------------------------------------------


def points_of(seed: int, count: int = POINTS) -> tuple[tuple[float, float], ...]:
    """Points, each `STEP_M` from the one before it, to either side by up to a right angle."""
    rng, at, heading = np.random.default_rng(seed), np.zeros(2), 0.0
    out = list[tuple[float, float]]()
    for _ in range(count):
        heading += float(rng.uniform(-math.pi / 2, math.pi / 2))
        at = at + STEP_M * np.array([math.cos(heading), math.sin(heading)])
        out.append((float(at[0]), float(at[1])))
    return tuple(out)


def steered(places: Places, unit: str) -> Any:
    """Points reached in turn, and when, against a straight walk at the library's own pace."""
    tracker, _, generator = loaded()
    made = rollouts(
        tracker,
        generator,
        1,
        2.0 if places.smoke else 200.0,
        targets=points_of(int(unit[5:])),
        tries=TRIES,
    )
    times = [t for _, t in made.reached]
    assert tracker.recovery_clips is not None
    walk = tracker.recovery_clips.walks[0]
    pace = float(walk[-1, 0]) * generator.fps / (len(walk) - 1)
    slow = times[-1] * pace / (STEP_M * len(times)) if times else None
    return {"reached": len(times), "falls": len(made.of(0)[0]), "times_straight": slow}


def steered_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means over courses."""
    rows = list(raws.values())
    values = {
        "points_reached": sum(r["reached"] for r in rows) / (POINTS * len(rows)),
        "falls": sum(r["falls"] for r in rows),
        "times_straight": mean_of(r["times_straight"] for r in rows),
    }
    yield from of("from point to point, policy alone", values, POINTS * len(rows), seeds=len(rows))


def recorded(places: Places, unit: str) -> Any:
    """Every eighth recording that it learned."""
    tracker = loaded()[0]
    clips = [moment()] if places.smoke else list(library(places, "library").values())[::8]
    return [figures_of(place(c, tracker).qpos) for c in clips]


def recorded_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means."""
    rows = raws["library"]
    values = {n: mean_of(r[n] for r in rows) for n in NAMES}
    yield from of(
        "its library, as recorded",
        {"sinks_mm" if k == "penetration_mm" else k: v for k, v in values.items()},
        len(rows),
    )


def predicted(places: Places, unit: str) -> Any:
    """Two seconds after held-out pasts, by the generator that ships: mean and last distance of hinge
    angles, rad, of the mean and of the best of ten, beside standing still."""
    from benchmarks.suites.papers_prediction import FUTURE, SAMPLES, continued, held_out_windows, off

    tracker, _, made = loaded()
    windows = held_out_windows(places, tracker)
    pasts = torch.stack([w.past for w in windows])
    still = off(windows, pasts[:, -1:].expand(-1, FUTURE, -1), 1)
    far = off(windows, continued(made, pasts.repeat_interleave(SAMPLES, 0), FUTURE, 0), SAMPLES)
    out = {}
    for name, x in (("kinematic policy", far), ("standing still", still)):
        mean, last = x.mean(-1), x[..., -1]
        out[name] = [float(mean.mean()), float(last.mean())]
        if x.shape[1] > 1:
            out[f"{name}, best of ten"] = [float(mean.min(-1).mean()), float(last.min(-1).mean())]
    return {"windows": len(windows), "rows": out}


def predicted_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """By method."""
    raw = raws["prediction"]
    for name, (mae, fae) in raw["rows"].items():
        yield from of(
            f"two seconds after held-out pasts; {name}", {"mae_rad": mae, "fae_rad": fae}, raw["windows"]
        )


def _one(name: str) -> Callable[[Places], list[str]]:
    return lambda _: [name]


_SHIPS = ("tracker", "generator")
PARTS = {
    **{
        name: Part(
            f"{count} rollouts of {seconds:g} s",
            _one(name),
            partial(together, name=name),
            partial(rollout_rows, name=name),
            _SHIPS,
            hours=hours,
            needs=(),
        )
        for name, (_, count, seconds, hours) in ROLLOUTS.items()
    },
    "lookahead": Part(
        "rollouts of 600 s that look ahead",
        lambda p: [f"seed {k}" for k in range(1 if p.smoke else 6)],
        ahead,
        partial(rollout_rows, name="lookahead"),
        _SHIPS,
        hours=2.0,
        needs=(),
    ),
    "steering": Part(
        "points 5 m apart",
        lambda p: [f"seed {k}" for k in range(1 if p.smoke else 4)],
        steered,
        steered_rows,
        _SHIPS,
        hours=0.1,
        needs=(),
    ),
    "library": Part(
        "recordings as they are",
        _one("library"),
        recorded,
        recorded_rows,
        hours=0.05,
        needs=("library",),
    ),
    "prediction": Part(
        "two seconds after held-out pasts",
        _one("prediction"),
        predicted,
        predicted_rows,
        ("generator",),
        hours=0.02,
    ),
}
