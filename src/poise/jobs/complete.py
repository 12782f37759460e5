"""From keyframes to a body: what `poise complete` does.

done = complete("dance.bvh", (0, 30, 60, 90))
done.clip, done.card, done.stages, done.save("out")
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats import home_suffix, write_clip
from poise.jobs.deliver import key_errors, stage_of
from poise.jobs.inbetween.fill import inbetween
from poise.jobs.open import open_run
from poise.jobs.result import Merit, Result, clip_of, story
from poise.jobs.track import TrackConfig, track
from poise.jobs.track.direction import Weight
from poise.jobs.track.in_place import with_travel
from poise.jobs.tracker import Tracker
from poise.kinematics import without_noise
from poise.kinematics.rate import judge_rate
from poise.learn.inbetween_model import InbetweenModel
from poise.motion import Clip
from poise.plan import LookaheadConfig
from poise.settings import changed
from poise.synthesis.filler import check_keyframes
from poise.synthesis.keyframes import Partial, Retiming, moved_to, retimed, timed

#: How much more a keyframe counts than the frames between.
KEY_WEIGHT = 20.0
#: Simulated control steps for each that is made, where lookahead is not set otherwise, and its slack:
#: keyframes are to be met, so little is given up for a smoother motion.
BUDGET, SLACK = 768.0, 0.3
#: Rounds of retiming; a gap is made longer by so much in each in which it is not done; m by which a
#: keyframe may be missed, on average over the joints, and still be met.
ROUNDS, LONGER, MET_M = 6, 1.3, 0.1

#: Is told what is done, and how much of how much.
Show = Callable[[str, int, int], None]


def met(result: Result) -> str:
    """How a body met its keyframes, in a sentence."""
    off, became = result.met_mm, story(result, hint=False)
    if became.failed:
        return became.sentence
    worst = int(np.argmax(off))
    told = (
        f"Without help; keyframes met to {np.mean(off):.0f} mm on average, frame "
        f"{result.keyframes[worst]} worst with {off[worst]:.0f} mm"
    )
    if off[worst] <= 1000 * MET_M:
        return f"{told}."
    return f"{told}, which is missed: more keyframes, --retime or --controller search may help."


def write_filled(result: Result, out: Path, _motion: Path, _hold: bool) -> dict[str, Path]:
    """Writes the motion that was given a body as `filled.bvh`, or in the format of the source."""
    path = out / f"filled{home_suffix(result.came)}"
    write_clip(result.came, path)
    return {"filled": path}


def complete(
    clip: Clip | str | Path,
    keyframes: Sequence[int],
    policy: Tracker | str | Path | None = None,
    config: TrackConfig | None = None,
    *,
    model: InbetweenModel | str | Path | None = None,
    adapt: int | None = None,
    retime: bool = False,
    times: Sequence[float] | None = None,
    partial: Sequence[Partial] = (),
    progress: Show | None = None,
    warn: Callable[[str], None] | None = None,
    **settings: Any,
) -> Result:
    """Makes a motion of keyframes, and gives it a body: in-betweening, then a simulated character.

    The motion between the keyframes is made by a network (`inbetween`); the policy with lookahead does
    it, without help, minding the keyframes more than what is between; and it comes back on the
    skeleton that came in. Frames outside of the keyframes are part of the motion as they are.

    Args:
        keyframes: frames that stay, counted from 0, in rising order.
        policy, config, settings: see `track`.
        model, adapt: see `inbetween`.
        retime: gaps that no body does in their time get more of it, see `Retiming`.
        times: s, at which each keyframe is to be, from the first on; by default where it is.
        partial: further frames of which only hands, feet or the pelvis stay.
        progress: is told what is done. warn: see `track`; of the clip that came in, and of what is
            filled.

    Raises:
        PoiseError: keyframes that make no sense, or a skeleton that is no human's.
    """
    config = changed(config or TrackConfig(), settings)
    if config.count > 1 or config.recover or config.noise:
        raise PoiseError(
            "keyframes are completed for a single character, without noise or recovery",
            code="settings-conflict",
        )
    if config.lookahead == LookaheadConfig():
        config = replace(config, lookahead=replace(LookaheadConfig().with_budget(BUDGET), slack=SLACK))
    if retime and config.retake is not None:
        raise PoiseError(
            "a range has the times of the earlier result",
            hint="Leave --retime out",
            code="settings-conflict",
        )
    source, said = _calm(clip_of(clip))
    # What is filled or retimed keeps the clip's time only where neither is asked for.
    timed_anew = retime or times is not None
    travel = with_travel(source, config.in_place, repeats=False, returns=not timed_anew)
    source = source if travel is None else travel.clip
    config = replace(config, in_place="keep")
    if travel is not None:
        config = replace(config, direction=travel.moved(config.direction))
    doubt = judge_rate(source).sentence()
    if doubt is not None and warn is not None:
        warn(doubt)
    keys = tuple(check_keyframes(keyframes, source.frames, source.name))
    for sparse in partial:
        if not keys[0] < sparse.frame < keys[-1]:
            what = f"a keyframe of parts must lie between keyframes, got frame {sparse.frame}"
            raise PoiseError(what, source.name, code="keyframe-misplaced")
    given, asked = source, keys
    tracker = policy if isinstance(policy, Tracker) else open_run(policy).tracker
    config.direction.check(given, tracker.humanoid.table)
    led = tuple(touch for p in partial for touch in p.touches(given))
    if times is not None:
        source, keys = timed(source, keys, times)
    more: dict[str, Any] = {} if adapt is None else {"adapt": adapt}
    factors = np.ones(len(keys) - 1)
    best: tuple[Merit, Result] | None = None
    for round_ in range(ROUNDS if retime else 1):
        stretched, at = retimed(source, keys, factors)
        told = None if progress is None else _telling(progress, "filling")
        filled = inbetween(stretched, at, model, on_gap=told, **more)
        weights = tuple(Weight("all", KEY_WEIGHT, k, k) for k in at)
        asked_for = replace(config.direction, touches=(*config.direction.touches, *led))
        # Its frames are those of the clip that came in.
        direction = asked_for.moved(lambda frame, at=at: moved_to(frame, asked, at))
        direction = replace(direction, weights=(*direction.weights, *weights))
        # A retimed motion is searched at last, when its times are settled.
        how = config if round_ + 1 == ROUNDS or not retime else replace(config, controller="lookahead")
        tracked = track(
            filled.clip, tracker, replace(how, direction=direction), progress=progress, warn=warn
        )
        made = {
            "filled": filled.clip,
            "simulated": tracked.delivered(hold=False),
            "delivered": tracked.clip,
        }
        off = {name: key_errors(clip, source, keys, at) for name, clip in made.items()}
        told_times = None
        if not (factors == 1.0).all():
            told_times = Retiming(keys, at, source.fps, tuple(factors.tolist()), called=asked)
        before = (*filled.notes, *(() if told_times is None else (told_times.sentence(),)))
        first = (*said, *(() if doubt is None or doubt in tracked.notes else (doubt,)))
        done = replace(
            tracked,
            notes=(*before, *first, *tracked.notes),
            filled=filled.filled,
            came=filled.clip,
            keyframes=asked,
            at=at,
            met_mm=off["simulated"],
            stages=tuple(stage_of(name, clip, off[name]) for name, clip in made.items()),
            retiming=told_times,
        )
        # As attempts are compared everywhere, but that keyframes are to be met and not all frames alike.
        merit = tracked.merit._replace(error=-float(np.mean(done.met_mm)))
        if best is None or merit > best[0]:
            best = merit, done
        slow = _too_fast(done)
        if not retime or not slow.any():
            break
        factors = np.where(slow, LONGER * factors, factors)
    assert best is not None
    done = best[1]
    if travel is not None:
        # What came of a clip in place is written as it came.
        notes = (travel.sentence(), *done.notes)
        done = replace(done, travel=travel, notes=notes, came=travel.written(done.came))
    report = (met(done), *(s.sentence() for s in done.stages))
    return replace(done, said=report, beside=(*done.beside, write_filled))


def _calm(clip: Clip) -> tuple[Clip, tuple[str, ...]]:
    """The clip without a tremble, keyframes too, and that in words.

    Where it does not tremble it stays as it is: frames between keyframes that are held, or anything, are
    no noise. Otherwise its noise has been judged, and what is filled in is not judged again.
    """
    calm, cleaned = without_noise(clip)
    if not any(f.kind == "tremble" for f in cleaned.noise):
        return clip, ()
    return calm.replaced(skeleton=calm.skeleton.with_source(raw=True)), tuple(cleaned.noise_sentences())


def _too_fast(done: Result) -> np.ndarray:
    """`(gaps,)` bool, those that the body did not do in their time."""
    over = np.array(done.filled.over) > 1.0
    missed = np.array(done.met_mm) > 1000 * MET_M
    late = missed[1:] | (missed[:-1] & (np.arange(len(missed) - 1) > 0))
    out = over | late
    for _, seconds in done.failures:
        frame = seconds * done.came.fps
        gap = int(np.clip(np.searchsorted(done.at, frame) - 1, 0, len(out) - 1))
        out[gap] = True
    return out


def _telling(show: Show, what: str) -> Callable[[int, int], None]:
    return lambda made, of: show(what, made, of)
