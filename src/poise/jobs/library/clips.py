"""One clip of a library: read, cleaned, brought onto its skeleton, or left out; the report of all."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from poise.body import BodyConfig, BodyTable, generate_table, read_mjcf
from poise.errors import PoiseError
from poise.formats import read_skeleton
from poise.jobs.library.files import MotionFile, check_patterns, matches
from poise.kinematics import RetargetConfig, onto_own, own_body, place_on_body
from poise.kinematics.place import OnBody
from poise.kinematics.rate import judge_rate, read_clip
from poise.kinematics.repair.estimate import clean_clip
from poise.kinematics.repair.motion_doctor import without_noise
from poise.kinematics.repair.needs import AloneRules, leaps, longest_alone, not_alone
from poise.kinematics.travel import find_travel, travelled
from poise.motion import Clip, Skeleton, resample, shifted, trim
from poise.settings import Limit, Range, validate

State = Literal["kept", "cut", "left out"]


@dataclass(frozen=True)
class ClipNote:
    """One file of a library.

    Attributes:
        name, subject: see `MotionFile`.
        path: of the file.
        state: taken whole, in part, or not at all.
        reason: why it was cut or left out, a clause.
        rule: that rule's name: unreadable, not human, short, word, held, leaning, below, leap, rate,
            unlike, by hand.
        seconds: of the file's motion.
        kept_s: what the library has of it, (0, 0) for none.
        retargeted: it came from another skeleton.
        scale: of its steps.
        direction_deg, slide_mm_s: see `RetargetReport`.
        lift_m: how far it was lifted onto the floor.
        repairs: what was cleaned.
        notes: what its reader guessed.
    """

    name: str
    subject: str
    path: str
    state: State
    reason: str = ""
    rule: str = ""
    seconds: float = 0.0
    kept_s: tuple[float, float] = (0.0, 0.0)
    frames: int = 0
    retargeted: bool = False
    scale: float = 1.0
    direction_deg: float = 0.0
    slide_mm_s: float = 0.0
    lift_m: float = 0.0
    repairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def sentence(self) -> str:
        """The note in one sentence."""
        if self.state == "kept":
            return f"{self.name}: {self.frames} frames."
        if self.state == "cut":
            a, b = self.kept_s
            return (
                f"{self.name}: cut to {a:.1f} to {b:.1f} s of {self.seconds:.1f} s, since {self.reason}."
            )
        return f"{self.name}: left out, since {self.reason}."


@dataclass(frozen=True)
class LibraryReport:
    """A library in short. onto: what the skeleton is. fps: of all clips. cached: it was not made now."""

    clips: tuple[ClipNote, ...]
    onto: str
    fps: float
    cached: bool = False

    def count(self, state: State) -> int:
        """How many files had this fate."""
        return sum(c.state == state for c in self.clips)

    def of(self, name: str) -> ClipNote:
        """The note of the clip of that name."""
        return next(c for c in self.clips if c.name == name)

    @property
    def subjects(self) -> tuple[str, ...]:
        """The performers of the library, in order."""
        return tuple(sorted({c.subject for c in self.clips if c.state != "left out"}))

    def sentences(self) -> list[str]:
        """The report in words, with a line for each clip that was not taken whole."""
        kept = [c for c in self.clips if c.state != "left out"]
        seconds = sum(c.kept_s[1] - c.kept_s[0] for c in kept)
        out = [
            f"{len(kept)} of {len(self.clips)} clips, {seconds / 60:.1f} minutes at {self.fps:g} frames "
            f"per second, {self.count('cut')} of them cut, on {self.onto}."
        ]
        moved = [c for c in kept if c.retargeted]
        if moved:
            worst = max(moved, key=lambda c: c.direction_deg)
            out.append(
                f"{len(moved)} came from other skeletons; their limbs point "
                f"{sum(c.direction_deg for c in moved) / len(moved):.1f} degrees away on average, most "
                f"in {worst.name} ({worst.direction_deg:.1f})."
            )
        repaired = sum(bool(c.repairs) for c in kept)
        if repaired:
            out.append(f"{repaired} had impossible speeds or flipped joints, which were repaired.")
        return out + [c.sentence() for c in self.clips if c.state != "kept"]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {"onto": self.onto, "fps": self.fps, "clips": [asdict(c) for c in self.clips]}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], cached: bool = False) -> LibraryReport:
        """What `to_dict` gave."""
        clips = tuple(ClipNote(**_lists_to_tuples(c)) for c in data["clips"])
        return cls(clips, data["onto"], data["fps"], cached)


def _lists_to_tuples(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {
        k: tuple(v) if isinstance(v, Sequence) and not isinstance(v, str) else v
        for k, v in entry.items()
    }


_T = TypeVar("_T")
#: Words in a file's name or folder that tell what no floor bears.
WORDS = (
    *("swim", "swimming", "underwater", "climb", "climbing", "ladder", "hanging", "chair", "stool"),
    *("sofa", "bicycle", "bike", "skateboard", "trampoline", "stilts"),
)


@dataclass(frozen=True)
class LibraryConfig:
    """How a library is made.

    Attributes:
        min_frames: shorter clips are left out (PHC's converter: 10).
        min_cut_s: what is left of a cut clip must last so long.
        rules: see `AloneRules`.
        words: see `WORDS`.
        max_unlike_deg: mean angle between the limbs before and after retargeting beyond which a clip is
            left out.
        keep: regular expressions of clips that are taken whole whatever the rules say.
        leave_out: of clips that are not taken.
        skeletons: (pattern, ASF file) pairs for AMC files without one of their own.
        rates: (pattern, frames per second) pairs for files that state none or a wrong one.
        allow_pickle: pickled files are read too, `.pkl` where they are given by name.
        level: feet are turned to stand flat on the humanoid's soles, see `level_feet`, which motion that
            is not simulated has no need of.
        mirror: each clip is taken in a mirror, too.
        backwards: of clips that are taken backwards, too; see `images`.
        own_bones: each skeleton keeps its lengths on the target's joints, see `own_body`.
    """

    min_frames: Annotated[int, Range(3)] = 10
    min_cut_s: float = 1.0
    rules: AloneRules = field(default_factory=AloneRules)
    words: tuple[str, ...] = WORDS
    max_unlike_deg: Limit = 20.0
    keep: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    skeletons: tuple[tuple[str, str], ...] = ()
    rates: tuple[tuple[str, float], ...] = ()
    allow_pickle: bool = False
    level: bool = True
    mirror: bool = False
    backwards: tuple[str, ...] = ()
    own_bones: bool = False

    def __post_init__(self) -> None:
        validate(self)
        taken = (*self.keep, *self.leave_out, *self.backwards)
        check_patterns((*taken, *(p for p, _ in (*self.skeletons, *self.rates))))


@dataclass(frozen=True, eq=False)
class Target:
    """The skeleton that all clips come onto, a clip that shows how it stands, its body, and how clips
    come onto it."""

    skeleton: Skeleton
    example: Clip | None
    table: BodyTable
    words: str
    how: RetargetConfig | None = None

    def with_bones_of(self, clip: Clip, body: BodyConfig) -> Target:
        """The same joints with the lengths of a clip's skeleton.

        Raises:
            PoiseError: see `own_body`.
        """
        assert self.example is not None
        table, example = own_body(clip, self.table, self.example, body)
        return replace(
            self, skeleton=example.skeleton, example=example, table=table, how=onto_own(table)
        )


class LibraryClip(NamedTuple):
    """A clip that was read and cleaned, at the library's rate, with its file and repairs, and the doubt
    about the file's own rate in words. obeyed: the rate is one that the user stated."""

    file: MotionFile
    clip: Clip
    repairs: tuple[str, ...]
    doubt: str | None
    obeyed: bool


def read_all(
    files: Sequence[MotionFile], fps: float, config: LibraryConfig, tell: Callable[[str], None]
) -> tuple[list[LibraryClip], dict[str, ClipNote]]:
    """Every clip that can be read and is long enough, and by name a note on each of the others.

    Raises:
        PoiseError: no file can be used.
    """
    read: list[LibraryClip] = []
    notes: dict[str, ClipNote] = {}
    for k, file in enumerate(files, 1):
        got = _read(file, fps, config)
        if isinstance(got, ClipNote):
            notes[file.name] = got
        else:
            read.append(got)
        if k % 100 == 0:
            tell(f"{k} of {len(files)} files read")
    if not read:
        first = next(iter(notes.values()))
        raise PoiseError(
            f"none of the {len(files)} files can be used", None, first.sentence(), code="no-usable-files"
        )
    return read, notes


def _read(file: MotionFile, fps: float, config: LibraryConfig) -> LibraryClip | ClipNote:
    note = ClipNote(file.name, file.subject, str(file.path), "left out")
    if matches(config.leave_out, file.name, file.subject):
        return replace(note, rule="by hand", reason="it was to be left out")
    is_amc = file.path.suffix.lower() == ".amc"
    rule = "unreadable"
    try:
        clip = read_clip(
            file.path,
            skeleton=_stated(config.skeletons, file.name) if is_amc else None,
            fps=_stated(config.rates, file.name),
            allow_pickle=config.allow_pickle,
        )
        note = replace(note, seconds=clip.seconds, notes=clip.skeleton.source.notes)
        rule = "not human"
        calm, noise = without_noise(clip)
        cleaned, report = clean_clip(calm, raw=True)
        report = noise.then(report)
        travel = find_travel(cleaned)
        cleaned = cleaned if travel is None else travelled(cleaned, travel)
        rule = "short"
        resampled = resample(cleaned, fps).replaced(name=file.name)
    except PoiseError as problem:
        return replace(note, rule=rule, reason=str(problem).rstrip("."))
    if resampled.frames < config.min_frames:
        reason = (
            f"it has {resampled.frames} frames at {fps:g} per second, fewer than {config.min_frames}"
        )
        return replace(note, rule="short", reason=reason)
    word = _telling_word(file.name, config.words)
    if word and not matches(config.keep, file.name, file.subject):
        return replace(note, rule="word", reason=f"its name says '{word}'")
    said = [] if travel is None else [f"It {travel.words()}, and was given that travel."]
    doubt, obeyed = judge_rate(clip).sentence(), _stated(config.rates, file.name) is not None
    return LibraryClip(file, resampled, (*said, *report.sentences()), doubt, obeyed)


def _stated(pairs: Sequence[tuple[str, _T]], name: str) -> _T | None:
    return next((value for p, value in pairs if re.search(p, name, re.IGNORECASE)), None)


def _telling_word(name: str, words: Sequence[str]) -> str:
    said = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    return next((w for w in words if w in said), "")


def shape_of(skeleton: Skeleton) -> tuple:
    return skeleton.names, skeleton.parents, skeleton.offsets.tobytes()


def target_of(
    onto: Skeleton | Clip | Target | Path | str | None, clips: Sequence[Clip], body: BodyConfig
) -> Target:
    """The skeleton that was asked for, or the one on which most of the motion is."""
    if isinstance(onto, Target):
        return onto
    if body.mjcf is not None and onto is None:
        onto = body.mjcf
    if isinstance(onto, str | Path):
        path = Path(onto)
        if path.suffix.lower() == ".xml":
            own = read_mjcf(path, body.damping)
            return Target(own.skeleton, None, own.table, f"the body of {path.name}")
        onto = read_skeleton(path)
    if onto is None:
        return _most_common(clips, body)
    skeleton, example = (onto, None) if isinstance(onto, Skeleton) else (onto.skeleton, onto)
    table = generate_table(skeleton, body, [] if example is None else [example])
    named = "the skeleton that was given" if example is None else f"the skeleton of '{example.name}'"
    return Target(skeleton, example, table, named)


def _most_common(clips: Sequence[Clip], body: BodyConfig) -> Target:
    """The bones with the most seconds, among those of the hierarchy with the most seconds."""
    trees: Counter[tuple] = Counter()
    bones: Counter[tuple] = Counter()
    for clip in clips:
        shape = shape_of(clip.skeleton)
        trees[shape[:2]] += clip.seconds  # type: ignore[assignment]
        bones[shape] += clip.seconds  # type: ignore[assignment]
    ranked = sorted(bones, key=lambda s: (-trees[s[:2]], -bones[s]))
    problem: PoiseError | None = None
    for shape in ranked:
        example = next(c for c in clips if shape_of(c.skeleton) == shape)
        try:
            table = generate_table(example.skeleton, body, [example])
        except PoiseError as error:
            problem = problem or error
            continue
        words = f"the skeleton of '{example.name}', on which most of the library is"
        return Target(example.skeleton, example, table, words)
    assert problem is not None
    raise problem


def place(
    taken: LibraryClip, example: Clip, target: Target, config: LibraryConfig
) -> tuple[Clip | None, ClipNote]:
    """A clip on the target and on the floor, without what no humanoid can do alone; and its note.

    example: a clip on the same skeleton that tells how it stands.
    """
    file, clip = taken.file, taken.clip
    note = ClipNote(
        file.name, file.subject, str(file.path), "left out", seconds=clip.seconds,
        repairs=taken.repairs, notes=clip.skeleton.source.notes,
    )  # fmt: skip
    keep = matches(config.keep, file.name, file.subject)
    broken = () if keep else leaps(clip, config.rules)
    begins, stop = longest_alone(clip, broken)
    if broken:
        worst = max(broken, key=lambda f: f.size_m)
        note = replace(note, rule=worst.kind, reason=worst.sentence(clip.fps))
        if stop - begins < _least(clip, config):
            return None, note
        clip = trim(clip, begins, stop)
    try:
        clip, on = set_down(clip, example, target, config)
    except PoiseError as problem:
        return None, replace(note, rule="not human", reason=str(problem).rstrip("."))
    if report := on.retargeting:
        note = replace(
            note, retargeted=True, scale=report.scale, direction_deg=report.direction_deg,
            slide_mm_s=report.slide_mm_s[1],
        )  # fmt: skip
    if note.direction_deg > config.max_unlike_deg and not keep:
        reason = f"its limbs point {note.direction_deg:.0f} degrees elsewhere on the other skeleton"
        return None, replace(note, rule="unlike", reason=reason)
    note = replace(note, lift_m=on.ground.lift_m)
    if taken.doubt and taken.obeyed:
        note = replace(note, notes=(*note.notes, taken.doubt))
    elif taken.doubt and not keep:
        reason = taken.doubt.partition(";")[0]
        return None, replace(note, rule="rate", reason=reason[0].lower() + reason[1:])
    return _alone(clip, target, note, config, keep, begins)


def set_down(
    clip: Clip, example: Clip | None, target: Target, config: LibraryConfig
) -> tuple[Clip, OnBody]:
    """A clip on the target's skeleton, with its feet flat on the floor, and how it came there.

    example: a clip on the same skeleton that tells how it stands.
    """
    # As the humanoid can turn its joints: its feet are rigid and turn about two axes alone.
    onto = target.example or target.skeleton
    on = place_on_body(
        clip, target.table, onto, example=example, how=target.how, clean=False, level=config.level,
        known=False,
    )  # fmt: skip
    return shifted(on.clip, (0.0, 0.0, on.ground.lift_m)), on


def _alone(
    clip: Clip, target: Target, note: ClipNote, config: LibraryConfig, keep: bool, begins: int
) -> tuple[Clip | None, ClipNote]:
    """The longest run of frames that needs no more than a floor, of what is left from `begins` on."""
    found = () if keep else not_alone(clip, target.table, config.rules)
    first, stop = longest_alone(clip, found) if found else (0, clip.frames)
    if found:
        worst = max(found, key=lambda f: f.seconds)
        note = replace(note, rule=worst.kind, reason=worst.sentence(clip.fps))
        if stop - first < _least(clip, config):
            return None, note
        clip = trim(clip, first, stop)
    # The floor is known now, so that a part of a clip in which no foot stands is not set down anew, and
    # its noise was judged as the file has it.
    source = target.skeleton.with_source(ground_m=0.0, raw=True)
    made = clip.replaced(skeleton=source, name=note.name)
    kept = ((begins + first) / clip.fps, (begins + stop - 1) / clip.fps)
    state = "cut" if note.rule else "kept"
    return made, replace(note, state=state, kept_s=kept, frames=stop - first)


def _least(clip: Clip, config: LibraryConfig) -> float:
    """Frames that what is left of a cut clip must have."""
    return max(config.min_frames, config.min_cut_s * clip.fps)
