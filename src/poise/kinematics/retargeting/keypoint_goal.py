"""Keypoints of one performer as the goal of a keypoint policy, frame by frame, from a file or live."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.formats.landmarks import complete
from poise.formats.markers import NEEDED, find_places
from poise.formats.point_fit import FitConfig, bones_of, fit_clip
from poise.formats.point_skeleton import Rest, Solver, hold_lengths, measure, spine_shares, trunk_tracks
from poise.kinematics.ground import fit_heights
from poise.kinematics.retargeting.passage import Retargeter
from poise.kinematics.retargeting.standing import ClipWorld
from poise.kinematics.stream_noise import of_points
from poise.motion import Clip, Skeleton
from poise.motion.keypoints import Keypoints
from poise.motion.rotations import forward_kinematics
from poise.settings import Checked, Positive, Range

#: Rounds in which bones get their length; the error halves about every third.
LENGTH_ROUNDS = 12
#: A rate at which the twist of a limb is not carried over from the frames around.
_NO_MEMORY_FPS = 1e-3


@dataclass(frozen=True, eq=False)
class PointBody:
    """A measured performer and the humanoid that it moves, each frame by itself.

    `calibrate` measures the performer once. After that a frame needs no other frame: the measured
    skeleton is posed in closed form, its bones' directions pass to the humanoid's skeleton, and the path
    is scaled. Contacts are not held, since that needs to know what comes.

    names: labels of the keypoints. onto, table: the humanoid's skeleton and bodies. rest, share, bones:
    the measured skeleton. passage: from it to the humanoid. lift: m, how far the humanoid is
    lifted so that its soles stand on z = 0. notes: what was assumed.
    """

    names: tuple[str, ...]
    onto: Skeleton
    table: BodyTable
    places: dict[str, tuple[int, ...]]
    rest: Rest
    share: dict[str, float]
    bones: list[tuple[str, str, float]]
    passage: Retargeter
    lift: float
    notes: tuple[str, ...]

    @classmethod
    def calibrate(cls, points: Keypoints, onto: Skeleton | Clip, table: BodyTable) -> PointBody:
        """Measures the performer on some seconds in which all that is needed is seen.

        Args:
            points: a part of the recording, or all of it.
            onto: the humanoid's skeleton, or a clip on it that shows how it stands. table: its bodies.

        Raises:
            PoiseError: labels that name no body (marker sets are fitted offline), or see `fit_clip`.
        """
        found = find_places(points.names)
        lost = [p.replace("_", " ") for p in NEEDED if p not in found]
        if lost:
            raise PoiseError(
                f"no keypoint is named {lost[0]}, so the points cannot be followed one frame at a time",
                points.source.path or points.name,
                "Convert the file to a clip first, which also works for marker sets",
                code="keypoint-missing",
            )
        config = FitConfig()
        marks = complete(points, config.max_gap_s, config.drop_spikes, config.smooth_hz)
        seen = {p: t for p, t in marks.tracks.items() if p in found}
        tracks, spine = trunk_tracks(seen, [])
        share = spine_shares({**seen, "neck": tracks["neck"], "pelvis": tracks["pelvis"]})
        rest = measure(tracks, spine, [])
        clip = fit_clip(points, config)
        skeleton = onto if isinstance(onto, Skeleton) else onto.skeleton
        body = cls(
            points.names,
            skeleton,
            table,
            {p: found[p] for p in seen},
            rest,
            share,
            bones_of(rest),
            Retargeter.between(clip, onto),
            0.0,
            clip.skeleton.source.notes,
        )
        places = np.stack([_mean(points.positions, k) for k in body.places.values()], 1)
        pos, quat = body.pose(places)
        whole = ~np.isnan(pos).any((1, 2))
        fit = fit_heights(table, pos[whole], quat[whole], points.fps)
        return replace(body, lift=fit.lift_m)

    def solve(self, positions: np.ndarray) -> np.ndarray:
        """Positions `(T, B, 3)` m of the humanoid's bodies for keypoints `(T, K, 3)` m without gaps."""
        tracks = np.stack([_mean(positions, k) for k in self.places.values()], 1)
        pos = self.pose(tracks)[0]
        return pos + np.array([0.0, 0.0, self.lift])

    def pose(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World positions `(T, B, 3)` m and rotations `(T, B, 4)` of the bodies, not yet lifted.

        places: `(T, P, 3)` m, the tracks of `self.places` in order.
        """
        return self._onto(self._world(*self._solved(places)))

    def _onto(self, performer: ClipWorld) -> tuple[np.ndarray, np.ndarray]:
        rot, root = self.passage.transfer(performer)
        pos, quat = self.onto.forward(root, rot)
        rows = [r.joint for r in self.table.rows]
        return pos[:, rows], quat[:, rows]

    def follow(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The humanoid's bodies `(T, B, 3)` m as `solve` gives them, and what `performer` gives."""
        root, rot = self.performer(positions)
        pos = self._onto(self._world(root, rot))[0] + np.array([0.0, 0.0, self.lift])
        return pos, root, rot

    def performer(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Root `(T, 3)` m and local rotations `(T, J, 4)` of the measured skeleton, its joints in the
        order of `rest`, for keypoints `(T, K, 3)` m without gaps."""
        return self._solved(np.stack([_mean(positions, k) for k in self.places.values()], 1))

    def _solved(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = {p: places[:, k] for k, p in enumerate(self.places)}
        tracks, _ = trunk_tracks(seen, [], self.share)
        tracks = hold_lengths(tracks, self.bones, LENGTH_ROUNDS)
        return Solver(self.rest, tracks, _NO_MEMORY_FPS).run()

    def _world(self, root: np.ndarray, rot: np.ndarray) -> ClipWorld:
        """The measured skeleton in every frame."""
        names = list(self.rest.parents)
        parents = tuple(-1 if up is None else names.index(up) for up in self.rest.parents.values())
        offsets = np.stack([self.rest.offsets[n] for n in names])
        return ClipWorld(*forward_kinematics(parents, offsets, root, rot))


def _mean(positions: np.ndarray, columns: tuple[int, ...]) -> np.ndarray:
    """`(T, 3)`, the middle of some keypoints."""
    return positions[:, list(columns)].mean(1)


#: Control steps of a recording that are solved at once.
BLOCK = 64


@dataclass(frozen=True)
class StreamConfig(Checked):
    """How a stream of keypoints is filtered.

    smooth_hz: cut-off of the filter on the keypoints; None smooths them as much as they tremble
        (`FadingFilter`). lookahead: 1 takes velocities from the frames before and after, one step
        late; 0 from the last two.
    max_speed: m/s, a keypoint that jumps faster is taken as missing (sprinters' feet reach 20).
    """

    smooth_hz: Positive | None = None
    lookahead: Annotated[int, Range(0, 1, unit="control steps")] = 1
    max_speed: Annotated[float, Range(0, above=True, infinite=True)] = 25.0


@dataclass(frozen=True, eq=False)
class GoalFrame:
    """The goal at one control step.

    time_s: when it was. pos: `(B, 3)` m of the humanoid's bodies. linvel: `(B, 3)` m/s. stale_s: for how
    long the keypoint that is longest missing has been so and has travelled along with the others.
    """

    time_s: float
    pos: np.ndarray
    linvel: np.ndarray
    stale_s: float


class _Step(NamedTuple):
    """A control step: its time, positions of keypoints or bodies in m, and the oldest gap in s."""

    time_s: float
    pos: np.ndarray
    stale_s: float


class KeypointStream:
    """Keypoints one frame after another; goals at every control step that they reach.

        body = PointBody.calibrate(first_seconds, humanoid_skeleton, humanoid.table)
        stream = KeypointStream(body, rate_hz=30.0)
        for frame in stream.follow(points):     # or: stream.push(positions, time_s) for every frame
            frame.pos, frame.linvel             # (B, 3) m and m/s

    latency_s: how long after a control step its goal is given: until the next frame of the input is
    there, and `lookahead` steps more. The filter adds none at constant velocity.
    """

    def __init__(self, body: PointBody, rate_hz: float = 30.0, config: StreamConfig | None = None):
        if not (np.isfinite(rate_hz) and rate_hz > 0):
            raise PoiseError(f"the control rate must be above 0, got {rate_hz}", code="out-of-range")
        self.body, self.rate_hz, self.config = body, rate_hz, config or StreamConfig()
        self.latency_s = self.config.lookahead / rate_hz
        self._gaps = Gaps(len(body.names), self.config.max_speed)
        self._filter = of_points(len(body.names), self.config.smooth_hz)
        self._time: float | None = None
        self._last: _Step | None = None
        self._begin, self._count = 0.0, 0
        self._held: list[_Step] = []

    def push(self, positions: np.ndarray, time_s: float) -> list[GoalFrame]:
        """The goals that keypoints `(K, 3)` m seen at `time_s` make known; NaN where one is missing.

        Nothing is given before every needed keypoint was seen once. A frame costs some 300 small tensor
        operations; a recording goes faster through `follow`.

        Raises:
            PoiseError: another number of keypoints, or a time that is not later than the one before.
        """
        return self._goals(self._steps_at(positions, time_s))

    def finish(self) -> list[GoalFrame]:
        """The goal that still waits for a step after it, once no more keypoints will come."""
        if self.config.lookahead == 0 or not self._held:
            return []
        last, back = self._held[-1], self._held[-2] if len(self._held) > 1 else self._held[-1]
        self._held = []
        return [GoalFrame(last.time_s, last.pos, (last.pos - back.pos) * self.rate_hz, last.stale_s)]

    def follow(self, points: Keypoints) -> Iterator[GoalFrame]:
        """The goals of a whole recording, one after another: the same as `push` gives, sooner.

        Raises:
            PoiseError: other keypoints than the calibration's.
        """
        if points.names != self.body.names:
            raise PoiseError(
                "its keypoints are not those of the calibration",
                points.source.path or points.name,
                code="keypoints-differ",
            )
        waiting: list[_Step] = []
        for t, positions in enumerate(points.positions):
            waiting += self._steps_at(positions, t / points.fps)
            if len(waiting) >= BLOCK:
                yield from self._goals(waiting)
                waiting = []
        yield from self._goals(waiting)
        yield from self.finish()

    def _steps_at(self, positions: np.ndarray, time_s: float) -> list[_Step]:
        """The keypoints without gaps at the control steps up to `time_s`."""
        if positions.shape != (len(self.body.names), 3):
            raise PoiseError(
                f"a frame of this stream has shape ({len(self.body.names)}, 3), got {positions.shape}",
                code="wrong-shape",
            )
        if self._time is not None and not time_s > self._time:
            raise PoiseError(
                f"the frame at {time_s:g} s is not later than the one at {self._time:g} s",
                code="times-not-rising",
            )
        dt = 0.0 if self._time is None else time_s - self._time
        self._time = time_s
        whole, stale = self._gaps(positions, dt)
        if whole is None:
            return []
        now = self._filter(whole.ravel(), dt).reshape(whole.shape)
        if self._last is None:
            self._begin, self._last, self._count = time_s, _Step(time_s, now, stale), 1
            return [self._last]
        before, out = self._last, []
        # A millionth of a step of slack, since times are sums of rounded steps.
        while (at := self._begin + self._count / self.rate_hz) <= time_s + 1e-6 / self.rate_hz:
            share = min(max((at - before.time_s) / dt, 0.0), 1.0)
            out.append(_Step(at, before.pos + share * (now - before.pos), stale))
            self._count += 1
        self._last = _Step(time_s, now, stale)
        return out

    def _goals(self, steps: Sequence[_Step]) -> list[GoalFrame]:
        """What these control steps make known."""
        if not steps:
            return []
        solved = self.body.solve(np.stack([s.pos for s in steps]))
        return [g for s, pos in zip(steps, solved, strict=True) for g in self._goal(s._replace(pos=pos))]

    def _goal(self, step: _Step) -> list[GoalFrame]:
        """The goal of this step, or with a look ahead that of the one before; `pos` is the bodies'."""
        self._held = [*self._held[-2:], step]
        back = self._held[-2] if len(self._held) > 1 else step
        if self.config.lookahead == 0:
            return [GoalFrame(step.time_s, step.pos, (step.pos - back.pos) * self.rate_hz, step.stale_s)]
        if len(self._held) == 1:
            return []
        first = self._held[0]
        speed = (step.pos - first.pos) * self.rate_hz / (len(self._held) - 1)
        return [GoalFrame(back.time_s, back.pos, speed, back.stale_s)]


class Gaps:
    """Missing keypoints travel along with those that are seen."""

    def __init__(self, count: int, max_speed: float):
        self.last = np.full((count, 3), np.nan)
        self.since = np.zeros(count)
        self.max_speed = max_speed

    def __call__(self, positions: np.ndarray, dt: float) -> tuple[np.ndarray | None, float]:
        """The frame without gaps, None before each keypoint was seen once; the longest gap in s."""
        now = np.array(positions, dtype=float)
        known = np.asarray(~np.isnan(self.last).any(-1))
        self.since += dt
        far = np.linalg.norm(now - self.last, axis=-1) > self.max_speed * np.maximum(self.since, dt)
        now[known & far] = np.nan
        seen = np.asarray(~np.isnan(now).any(-1))
        both = seen & known
        shift = np.median(now[both] - self.last[both], axis=0) if both.any() else np.zeros(3)
        out = np.where(seen[:, None], now, self.last + shift)
        self.since[seen] = 0.0
        self.last = out
        if np.isnan(out).any():
            return None, float("inf")
        return out, float(self.since.max())
