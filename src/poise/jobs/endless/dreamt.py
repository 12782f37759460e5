"""How characters go about without end, and what they did: motion, figures, files written meanwhile."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import json
import os
import secrets
import shutil
import tempfile
import weakref
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch

from poise.body import BodyTable, Humanoid
from poise.env.generator_goal import REACHED, Steering
from poise.env.recovery.seats import Visit
from poise.env.walk_path import WalkPath
from poise.errors import PoiseError
from poise.formats import check_writable, write_clip
from poise.formats.text import write_whole
from poise.jobs.deliver import Delivery
from poise.jobs.endless.dream_world import DreamPush
from poise.jobs.result import ABSENT, Result
from poise.kinematics import hold_feet, lowest_height, qpos_to_clip
from poise.kinematics.forward import Kinematics, shapes_of
from poise.kinematics.loops import cut_loop
from poise.kinematics.supports import Support
from poise.metrics import foot_points, foot_slide, jerk, lowest_points, penetration
from poise.motion import Clip
from poise.plan import LookaheadConfig
from poise.score.card import NO_HELP, Help
from poise.score.report import Report, Shape, Track, write_report
from poise.settings import Range, validate
from poise.version import __version__

#: The most characters in a world.
MOST = 16


@dataclass(frozen=True)
class Dream:
    """How characters go about.

    Attributes:
        temperature: deviation of what the kinematic policy draws; below 1 motion is more usual.
        count: characters in one world, which keep away from each other.
        targets: x and y, in m, of points that each character is to reach one after another; it begins at
            the origin.
        path: that each character follows, in place of targets; None for none.
        supports: boxes that stand in the world; characters walk round them, and sit down on seats now
            and then, when they have no target left and are on no path.
        pushes: on each character.
        help_limit: N, and N m, that a hand which leads the roots may give at most, by inverse dynamics
            and a spring; 0 for none. No real person has such help.
        seed: of all draws.
        controller: the policy looks ahead before it acts, or acts at once.
        lookahead: how it looks ahead; its seed is `seed`.
        tries: futures of the kinematic policy that copies of a character try before it goes on with one,
            see `plan.rehearsal`; 1 tries none.
        recover: a character that has fallen gets up and goes on.
        past: what the kinematic policy goes on from: its own frames, as the paper has it, or what the
            character did.
        style: label of the motion of the library that is done, where that has labels; None does all.
        label_seconds: s for which, on average, a character keeps to motion of one label of the library
            before it turns to another one; 0 leaves that to chance, as targets and a style do.
        hold_feet: standing feet are held in place in what is written.
        threads: cores of lookahead, 0 is all of them.
    """

    temperature: Annotated[float, Range(0, 10)] = 1.0
    count: Annotated[int, Range(1, MOST, unit="characters")] = 1
    targets: tuple[tuple[float, float], ...] = ()
    path: WalkPath | None = None
    supports: tuple[Support, ...] = ()
    pushes: tuple[DreamPush, ...] = ()
    help_limit: Annotated[float, Range(0, unit="N")] = 0.0
    seed: int = 0
    controller: Literal["lookahead", "policy"] = "lookahead"
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    tries: Annotated[int, Range(1, 256, unit="futures")] = 8
    recover: bool = True
    past: Literal["own", "simulated"] = "own"
    style: str | None = None
    label_seconds: Annotated[float, Range(0, 3600, unit="s")] = 10.0
    hold_feet: bool = True
    threads: int = 0

    def __post_init__(self) -> None:
        validate(self)
        Steering(self.targets)
        if self.targets and self.path is not None:
            raise PoiseError(
                "a character goes to points or along a path",
                hint="Leave one of them out",
                code="option-conflict",
            )


#: Mean speed (m/s) of the bodies over a second below which a character stands still.
STILL = 0.1


class Figures:
    """Sums over pieces of coordinates, by the character's own soles and shapes."""

    def __init__(self, humanoid: Humanoid, fps: float):
        self.humanoid, self.fps = humanoid, fps
        self._kinematics, self._shapes = Kinematics(humanoid.table), shapes_of(humanoid.table)
        self._sums, self._frames = np.zeros(4), np.zeros(4)
        self._still, self._longest = 0.0, 0.0
        self._quiet = 0

    def add(self, qpos: np.ndarray) -> None:
        """A piece `(T, 7 + n)` of at least 4 frames; shorter ones are left out."""
        if len(qpos) < 4:
            return
        state = self._kinematics(torch.tensor(qpos))
        soles = foot_points(state.pos, state.quat, self._shapes, self.humanoid.feet)
        deep = penetration(lowest_points(state.pos, state.quat, self._shapes)).mean_mm
        speed = torch.diff(state.pos, dim=0).norm(dim=-1).mean(-1) * self.fps
        values = (
            float(foot_slide(soles, self.fps)),
            float(deep),
            float(jerk(state.pos, self.fps).mean()),
            float(speed.mean()),
        )
        for k, value in enumerate(values):
            if np.isfinite(value):
                self._sums[k] += value * len(qpos)
                self._frames[k] += len(qpos)
        second = max(1, round(self.fps))
        for part in speed.split(second):
            seconds = len(part) / self.fps
            still = float(part.mean()) < STILL
            self._quiet += len(part) if still else -self._quiet
            self._still += seconds * still
            self._longest = max(self._longest, self._quiet / self.fps)

    def to_dict(self) -> dict[str, float | None]:
        """Means over all frames; None where nothing was to be measured."""
        names = ("foot_slide_mm_per_s", "penetration_mm", "jerk_m_per_s3", "speed_m_per_s")
        means = {
            name: round(float(s / f), 3) if f else None
            for name, s, f in zip(names, self._sums, self._frames, strict=True)
        }
        return {**means, "still_s": round(self._still, 1), "longest_still_s": round(self._longest, 1)}


#: Frames of a piece, and how many of them two pieces share.
PIECE, SHARED = 300, 30


class FrameStore:
    """Rows of coordinates `(7 + n)`, appended one by one to an unnamed temporary file as float32."""

    def __init__(self, width: int):
        self.width, self.count = width, 0
        self._file = tempfile.TemporaryFile(prefix="poise-")  # noqa: SIM115 - it lives as long as this.
        weakref.finalize(self, self._file.close)

    def append(self, row: np.ndarray) -> None:
        """One more row `(7 + n)`."""
        self._file.seek(0, 2)
        self._file.write(np.asarray(row, np.float32).tobytes())
        self.count += 1

    def read(self, first: int = 0, last: int | None = None) -> np.ndarray:
        """Rows `first` to before `last` (by default all), `(T, 7 + n)` float64."""
        last = self.count if last is None else min(last, self.count)
        first = min(first, last)
        self._file.seek(4 * self.width * first)
        data = self._file.read(4 * self.width * (last - first))
        return np.frombuffer(data, np.float32).reshape(-1, self.width).astype(np.float64)


class ClipMaker:
    """Turns coordinates into clips on a body's skeleton; joints without hinges stay as in `example`."""

    def __init__(self, table: BodyTable, example: Clip, fps: float):
        self.table, self.example, self.fps = table, example, fps

    def clip(self, qpos: np.ndarray, name: str) -> Clip:
        """The clip of coordinates `(T, 7 + n)`."""
        rot = self.example.rot[:1].repeat(len(qpos), 0)
        like = self.example.replaced(
            root_pos=qpos[:, :3].copy(), rot=rot, fps=self.fps, name=name, cyclic=False
        )
        return qpos_to_clip(qpos, self.table, self.example.skeleton, self.fps, like, name)


class Pieces:
    """Gives motion on in clips of about ten seconds, its standing feet held in place.

    Feet are held in windows of `PIECE + SHARED` frames; where two of them meet, the one passes into the
    other over `SHARED` frames, so that nothing jumps.

    Args:
        store: the frames that are there so far.
        give: gets each clip once, in order.
        hold: whether standing feet are held at all.
    """

    def __init__(
        self,
        store: FrameStore,
        body: ClipMaker,
        give: Callable[[Clip], None],
        name: str,
        hold: bool = True,
    ):
        self.store, self.body, self.give, self.name, self.hold = store, body, give, name, hold
        self._given = 0
        self._before: Clip | None = None

    def more(self) -> None:
        """Gives on what is whole; to be called after each frame."""
        while self.store.count >= self._given + PIECE + SHARED:
            self._give(self._given + PIECE + SHARED, PIECE)

    def finish(self) -> None:
        """Gives on what is left."""
        left = self.store.count - self._given
        if left > 0:
            self._give(self.store.count, left)

    def _give(self, last: int, count: int) -> None:
        clip = self.body.clip(self.store.read(self._given, last), self.name)
        if self.hold:
            clip = hold_feet(clip, self.body.table)[0]
        if self._before is not None:
            clip = faded(self._before, clip)
        self._before = _part(clip, count, clip.frames) if clip.frames > count else None
        self.give(_part(clip, 0, count))
        self._given += count


def faded(before: Clip, after: Clip) -> Clip:
    """`after`, with its first frames passing over from `before`, which are the same moments."""
    n = min(before.frames, after.frames)
    t = (np.arange(n) + 0.5) / n
    share = (t * t * (3 - 2 * t))[:, None, None]
    old, new = before.rot[:n], after.rot[:n]
    sign = np.where((old * new).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    mixed = (1 - share) * sign * old + share * new
    rot = after.rot.copy()
    rot[:n] = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return after.replaced(rot=rot)


def _part(clip: Clip, first: int, last: int) -> Clip:
    return clip.replaced(root_pos=clip.root_pos[first:last], rot=clip.rot[first:last])


#: s on a seat from which on a character sat there.
SAT_S = 2.0
#: s before a fall and after getting up that no loop holds.
FELL_S = 1.0
#: s of the motion that a report shows.
SHOWN_S = 60.0


class DreamtCharacter(NamedTuple):
    """One character's frames: as it was simulated, and what the kinematic policy asked for."""

    done: FrameStore
    asked: FrameStore


@dataclass(frozen=True, eq=False, repr=False)
class Dreamt(Result):
    """What characters did.

    Attributes:
        tracker: the control policy. body: makes clips of coordinates.
        characters: the frames of each.
        lost, back, reached: (character, s) of every time one lost its motion, was up again, or reached a
            target.
        config: how they went about. notes: sentences.
        visits: times on seats that are over.
        strayed: of each character that came to its path: s on it, the share of them more than half a
            metre from it, the mean and the greatest distance from it, m.
        help: what a hand gave.
        paths: motion files that were written on the way.
    """

    body: ClipMaker = ABSENT
    characters: tuple[DreamtCharacter, ...] = ()
    lost: tuple[tuple[int, float], ...] = ()
    back: tuple[tuple[int, float], ...] = ()
    reached: tuple[tuple[int, float], ...] = ()
    config: Dream = ABSENT
    visits: tuple[Visit, ...] = ()
    strayed: tuple[tuple[float, float, float, float], ...] = ()
    help: Help = NO_HELP
    paths: tuple[Path, ...] = ()

    @property
    def seconds(self) -> float:
        """How long the motion is."""
        return self.characters[0].done.count / self.body.fps

    def motion(self, character: int = 0) -> Clip:
        """A character's motion as it was simulated, on the body's skeleton."""
        return self.body.clip(self.characters[character].done.read(), "dream")

    def loop(self, seconds: float) -> tuple[Clip, str]:
        """A part of the first character's motion that can be repeated, standing feet held, and a
        sentence on it; see `kinematics.loops.cut_loop`. Falls and getting up are not in it.

        Raises:
            PoiseError: the motion holds no such part.
        """
        clip = self.as_written(True).clips["simulated"].replaced(name="loop")
        lost = sorted(t for i, t in self.lost if i == 0)
        back = sorted(t for i, t in self.back if i == 0)
        spans = [(t - FELL_S, next((b for b in back if b > t), self.seconds) + FELL_S) for t in lost]
        found, apart = cut_loop(clip, seconds, spans)
        lasts = (found.frames - 1) / found.fps
        return found, f"The loop lasts {lasts:.2f} s; its ends were {apart * 1000:.0f} mm apart."

    @property
    def source(self) -> Clip:
        """The kinematic policy's motion for the first character, in the same frames."""
        return self.body.clip(self.characters[0].asked.read(), "asked")

    def as_written(self, hold: bool) -> Delivery:
        """The first character's motion, and what the kinematic policy asked for."""
        motion = self.motion()
        held = hold_feet(motion, self.body.table)[0] if hold and self.config.hold_feet else motion
        clips = {"simulated": held, "asked": self.source}
        return Delivery(clips, clips, ABSENT, ())

    @property
    def falls(self) -> tuple[float, ...]:
        """s of every time that a character lost its motion."""
        return tuple(t for _, t in self.lost)

    @property
    def stayed_down(self) -> int:
        """How many characters had not got up at the end."""
        ends = [
            sum(i == k for i, _ in self.lost) - sum(i == k for i, _ in self.back)
            for k in range(len(self.characters))
        ]
        return sum(n > 0 for n in ends)

    @property
    def falls_per_hour(self) -> float:
        """How often a character lost its motion. One that never gets up counts until it fell."""
        first = {i: t for i, t in reversed(self.lost)}
        stays = not self.config.recover or self.tracker.recovery_clips is None
        up = [first.get(k, self.seconds) if stays else self.seconds for k in range(len(self.characters))]
        return 3600.0 * len(self.lost) / max(sum(up), 1e-9)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Slide, penetration, jerk and so on of the simulation and of what was asked for."""
        out: dict[str, Any] = {}
        for name in ("done", "asked"):
            sums = Figures(self.tracker.humanoid, self.body.fps)
            for character in self.characters:
                store: FrameStore = getattr(character, name)
                for first in range(0, store.count, PIECE):
                    sums.add(store.read(first, first + PIECE))
            out["simulated" if name == "done" else "asked"] = sums.to_dict()
        return out

    @property
    def sentence(self) -> str:
        """What became of it."""
        n = len(self.characters)
        helped = f"with up to {self.help.limit_n:g} N of help" if self.help.limit_n else "without help"
        said = f"{self.seconds:.1f} s {helped}" + (f", {n} characters" if n > 1 else "")
        if self.config.targets:
            said += f", {len(self.reached)} of {n * len(self.config.targets)} targets reached"
        if self.strayed:
            off = float(np.mean([share for _, share, _, _ in self.strayed]))
            said += f", {100 * (1 - off):.0f} % of the time within {REACHED:g} m of the path"
        if self.visits:
            sat = sum(v.sat_s >= SAT_S and v.back for v in self.visits)
            said += f", on a seat for {SAT_S:g} s and up again {sat} of {len(self.visits)} times"
        if not self.lost:
            return f"{said}, without a fall."
        times = "once" if len(self.lost) == 1 else f"{len(self.lost)} times"
        rest = f"and {self.stayed_down} did not get up" if self.stayed_down else "and always got up"
        return f"{said}; the motion was lost {times}, first at {self.lost[0][1]:.1f} s, {rest}."

    def to_dict(self) -> dict[str, Any]:
        """The content of score.json."""

        def times(found: tuple[tuple[int, float], ...]) -> list[dict[str, float]]:
            return [{"character": i, "seconds": round(t, 3)} for i, t in found]

        # A figure has the name that it has in every score card.
        figures = {
            kind: {"jerk" if k == "jerk_m_per_s3" else k: v for k, v in found.items()}
            for kind, found in self.figures.items()
        }
        return {
            "kind": "dream", "version": __version__, "seconds": self.seconds,
            "characters": len(self.characters), "sentence": self.sentence,
            "seed": self.config.seed, "temperature": self.config.temperature,
            "controller": self.config.controller, "recover": self.config.recover,
            "past": self.config.past, "style": self.config.style, "help": asdict(self.help),
            "falls": times(self.lost), "back": times(self.back), "reached": times(self.reached),
            "falls_per_hour": round(self.falls_per_hour, 2), "stayed_down": self.stayed_down,
            "visits": [
                {"character": v.world, "seconds": round(v.step / self.body.fps, 3), "seat": v.seat,
                 "sat_s": round(v.sat_s, 3), "back": v.back}
                for v in self.visits
            ],
            "path": [
                {"seconds": round(s, 1), "off_share": round(off, 4), "mean_m": round(mean, 4),
                 "most_m": round(most, 4)}
                for s, off, mean, most in self.strayed
            ],
            **figures,
        }  # fmt: skip

    def write(self, out: Path, motion: Path | None = None, hold: bool = True) -> Delivery:
        """Writes both motions, score.json and report.html into a folder."""
        done = super().write(out, motion, hold)
        return replace(done, paths={**done.paths, **self.write_score(out)})

    def write_score(self, folder: Path) -> dict[str, Path]:
        """Writes score.json and report.html into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = {"score": folder / "score.json", "report": folder / "report.html"}
        write_whole(paths["score"], json.dumps(self.to_dict(), indent=2) + "\n")
        write_report(self.report(), paths["report"])
        return paths

    def report(self, done: Delivery | None = None) -> Report:
        """A page that shows the first minute of the first character, and of the others with it."""
        humanoid, fps = self.tracker.humanoid, self.body.fps
        kinematics, frames = Kinematics(humanoid.table), round(SHOWN_S * fps)

        def track(store: FrameStore, name: str) -> Track:
            state = kinematics(torch.tensor(store.read(0, frames)))
            return Track(name, state.pos.float().numpy(), state.quat.float().numpy())

        first, *others = self.characters
        sim, ref = track(first.done, "simulation"), track(first.asked, "kinematic policy")
        apart = (sim.pos - sim.pos[:, :1]) - (ref.pos - ref.pos[:, :1])
        low = lowest_height(
            humanoid.table, torch.tensor(sim.pos).double(), torch.tensor(sim.quat).double()
        )
        figures, error_mm = self.figures["simulated"], np.linalg.norm(apart, axis=-1).mean(-1) * 1000
        fell = {character for character, _ in self.lost}
        score = {
            "kind": "dream",
            "succ": 1.0 - len(fell) / len(self.characters),
            "succ_rule": "characters that never fell",
            "mpjpe_mm": float(error_mm.mean()),
            "help": self.to_dict()["help"],
            "foot_slide_mm_per_s": figures["foot_slide_mm_per_s"],
            "reference": {"foot_slide_mm_per_s": self.figures["asked"]["foot_slide_mm_per_s"]},
        }
        facts = {
            "length": f"{self.seconds:.1f} s, of which {len(sim.pos) / fps:.0f} s are shown",
            "falls": f"{len(self.lost)}, {self.falls_per_hour:.1f} an hour",
            "foot slide": f"{figures['foot_slide_mm_per_s']} mm/s",
            "jerk": f"{figures['jerk_m_per_s3']} m/s^3",
            "stood still": f"{figures['still_s']} s, {figures['longest_still_s']} s at most",
            "controller": self.config.controller, "temperature": f"{self.config.temperature:g}",
            "seed": str(self.config.seed), "version": __version__,
        }  # fmt: skip
        return Report(
            title="Endless motion", subtitle=self.sentence,
            shapes=tuple(
                Shape(i, g.kind, g.size, g.pos, g.quat)
                for i, b in enumerate(humanoid.table.rows) for g in b.geoms
            ),
            bodies=humanoid.bodies, reference=ref, simulated=sim, fps=fps, force=None, torque=None,
            error_mm=error_mm,
            error_global_mm=np.linalg.norm(sim.pos - ref.pos, axis=-1).mean(-1) * 1000,
            contacts=low[:, list(humanoid.feet)].numpy() < 0.015, score=score, curve={},
            notes=(self.sentence, *self.notes), facts=facts,
            others=tuple(track(c.done, f"character {k}") for k, c in enumerate(others, 2)),
            things=tuple(
                Shape(0, "box", (b.size[0] / 2, b.size[1] / 2, b.size[2] / 2), b.pos, b.quat)
                for b in self.config.supports
            ),
        )  # fmt: skip


#: Room for the number of frames in a file's header.
_DIGITS = 9
#: Bytes of a number in a BVH file, with its space.
NUMBER = 11


class MotionWriter:
    """Writes pieces of one motion into one file: BVH as they come, so that memory stays flat; any other
    format at the end. The file appears when it is closed.

    Args:
        path: the file. example: a clip on the skeleton, for its size. frames: how many are to come,
            in all files that are written beside each other.

    Raises:
        PoiseError: the format cannot be written, or there is no room for it on the disk.
    """

    def __init__(self, path: Path, example: Clip, frames: int):
        check_writable(path)
        self.path, self.frames = path, 0
        self._streams = path.suffix.lower() == ".bvh"
        need = NUMBER * (3 * len(example.skeleton) + 3) * frames
        free = shutil.disk_usage(path.parent).free
        if need > free:
            raise PoiseError(
                f"the motion takes about {need / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free",
                path,
                "Make a shorter one, or choose another disk",
                code="disk-full",
            )
        self._beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
        self._pieces = list[Clip]()
        self._turns: np.ndarray | None = None
        self._last: np.ndarray | None = None
        self._at = 0

    def add(self, clip: Clip) -> None:
        """The next frames."""
        self.frames += clip.frames
        if not self._streams:
            self._pieces.append(clip)
            return
        with tempfile.TemporaryDirectory(prefix="poise-") as folder:
            piece = Path(folder) / "piece.bvh"
            write_clip(clip, piece)
            head, _, rest = piece.read_text(encoding="utf-8").partition("MOTION\n")
        count, step, body = rest.split("\n", 2)
        assert count.startswith("Frames:")
        rows = np.array([line.split() for line in body.strip().split("\n")], float)
        if self._turns is None:
            words = [w for line in head.split("\n") if "CHANNELS" in line for w in line.split()[2:]]
            self._turns = np.array([w.endswith("rotation") for w in words])
            lines = f"{head}MOTION\nFrames: "
            self._at = len(lines.encode())
            self._beside.write_text(f"{lines}{0:<{_DIGITS}}\n{step}\n", encoding="utf-8")
        if self._last is not None:
            # Angles go on from those of the last piece.
            jump = np.round((rows[0] - self._last) / 360.0) * 360.0
            rows -= np.where(self._turns, jump, 0.0)
        self._last = rows[-1]
        form = " ".join(["%.6f"] * rows.shape[1]) + "\n"
        with self._beside.open("a", encoding="utf-8") as file:
            file.writelines(form % tuple(row) for row in rows)

    def close(self) -> Path | None:
        """Puts the file into its place; None where no frame came."""
        if not self.frames:
            return None
        if not self._streams:
            root = np.concatenate([p.root_pos for p in self._pieces])
            rot = np.concatenate([p.rot for p in self._pieces])
            write_clip(self._pieces[0].replaced(root_pos=root, rot=rot), self.path)
            return self.path
        with self._beside.open("r+", encoding="utf-8") as file:
            file.seek(self._at)
            file.write(f"{self.frames:<{_DIGITS}}")
            file.flush()
            os.fsync(file.fileno())
        self._beside.replace(self.path)
        return self.path

    def discard(self) -> None:
        """Leaves nothing behind."""
        self._beside.unlink(missing_ok=True)
