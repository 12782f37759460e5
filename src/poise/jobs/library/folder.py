"""A folder of motion files as one library on one humanoid, and whole performers held out of it.

Perpetual Humanoid Control (Luo et al. 2023, section 4) trains on AMASS without the sequences in which
a performer sits on furniture, hangs or is carried, by a list made by hand. Here rules tell them
(`kinematics.repair`), each clip that is cut or left out says why, and `LibraryConfig.keep` overrules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

from poise.body import BodyConfig
from poise.errors import PoiseError
from poise.formats.own import pack_clips, unpack_clips
from poise.jobs.library.clips import (
    LibraryConfig,
    LibraryReport,
    Target,
    place,
    read_all,
    set_down,
    shape_of,
    target_of,
)
from poise.jobs.library.files import (
    BACKWARDS,
    MIRRORED,
    MotionFile,
    check_patterns,
    content_key,
    matches,
    motion_files_of,
    subject_of,
)
from poise.learn.checkpoint import load_checkpoint, save_checkpoint, tensors_of
from poise.motion import Clip, ClipLibrary, Skeleton
from poise.motion.clip import backwards
from poise.motion.mirror import mirrored_clip

#: Grows whenever the same files and settings would give other clips.
VERSION = 5


class Split(NamedTuple):
    """Clips to learn from, and clips that were held out."""

    train: ClipLibrary
    test: ClipLibrary


def library_of(
    sources: Path | str | Sequence[Path | str],
    onto: Skeleton | Clip | Target | Path | str | None = None,
    fps: float = 30.0,
    *,
    config: LibraryConfig | None = None,
    body: BodyConfig | None = None,
    cache: Path | str | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[ClipLibrary, LibraryReport]:
    """Every clip of folders and files on one skeleton, cleaned, on the floor z = 0, at one rate.

    Each clip is read, cleaned (`without_noise`, `clean_clip`), resampled, retargeted where its skeleton
    has other joints or bone lengths (`retarget`), and lifted as a whole so that its feet stand
    (`fit_heights`). What no humanoid can do alone is cut off or left out: unreadable or no human,
    shorter than `min_frames`, in flight with another gravity, held above the floor, leaning on nothing,
    on several floors, a telling word in its name. The longest run of frames without such a spell stays.

    Args:
        onto: the skeleton, a clip on it, a motion file, an MJCF body (`.xml`), or a skeleton with its
            body; by default the skeleton on which most seconds of the library are.
        fps: frames per second of all clips.
        body: of the humanoid; its soles are set on the floor.
        cache: a folder; a library of the same content and settings is taken from it at once.
        tell: is told how far it is.

    Returns:
        the library; clips are named by folder and file ("cmu_amc-02-02_01"), and what they are
        taken as besides ("-mirrored", "-backwards"); and a note on every file.

    Raises:
        PoiseError: no file can be used, or a target that is no human skeleton.
    """
    config, body = config or LibraryConfig(), body or BodyConfig()
    files = motion_files_of(sources)
    store = None
    if cache is not None:
        key = _key(files, onto, fps, config, body)
        store = Path(cache) / f"library-{key}.safetensors"
    if store is not None and store.exists():
        tensors, meta = load_checkpoint(store)
        clips = unpack_clips(tensors, meta["clips"])
        return ClipLibrary.of(clips), LibraryReport.from_dict(meta["report"], cached=True)
    read, notes = read_all(files, fps, config, tell)
    target = target_of(onto, [taken.clip for taken in read], body)
    if config.own_bones and (target.example is None or body.mjcf is not None):
        what = "clips keep their bones on a body that is generated, from a clip that shows how it stands"
        raise PoiseError(
            what, hint="Leave own_bones out, or give a clip to come onto", code="settings-conflict"
        )
    examples: dict[tuple, Clip] = {}
    own: dict[tuple, Target] = {}
    clips: list[Clip] = []
    for k, taken in enumerate(read, 1):
        example = examples.setdefault(shape_of(taken.clip.skeleton), taken.clip)
        onto = own.get(shape_of(example.skeleton), target)
        if config.own_bones and onto is target:
            # A skeleton that is no human's is left out by `place`, which says why.
            with suppress(PoiseError):
                onto = own[shape_of(example.skeleton)] = target.with_bones_of(example, body)
        made, notes[taken.file.name] = place(taken, example, onto, config)
        clips += [] if made is None else images(made, onto, config)
        if k % 100 == 0:
            tell(f"{k} of {len(read)} clips placed")
    report = LibraryReport(tuple(notes[f.name] for f in files), target.words, fps)
    if not clips:
        what = f"none of the {len(files)} clips can be used"
        raise PoiseError(what, hint=report.clips[-1].sentence(), code="no-usable-files")
    if store is not None:
        arrays, packed = pack_clips(clips)
        save_checkpoint(store, tensors_of(arrays), {"clips": packed, "report": report.to_dict()})
    return ClipLibrary.of(clips), report


def split(library: ClipLibrary, hold_out: Sequence[str]) -> Split:
    """The library without some performers or clips, and these.

    Args:
        hold_out: regular expressions, sought in clip names ("^cmu_amc-02-", "walk"), or the whole of a
            subject ("cmu 02"). A subject holds out all its clips, from whatever folder.

    Raises:
        PoiseError: a pattern that fits no clip, or nothing is left on one side.
    """
    check_patterns(hold_out)
    subjects = {name: subject_of(name) for name in library.names}
    for pattern in hold_out:
        if not any(matches((pattern,), n, s) for n, s in subjects.items()):
            known = sorted(set(subjects.values()))
            hint = f"Subjects: {', '.join(known[:12])}{', ...' if len(known) > 12 else ''}"
            raise PoiseError(
                f"'{pattern}' fits no clip and no subject of the library",
                None,
                hint,
                code="pattern-fits-nothing",
            )
    held = [matches(hold_out, n, s) for n, s in subjects.items()]
    if all(held) or not any(held):
        raise PoiseError(
            f"{sum(held)} of {len(held)} clips are held out; both sides need some",
            code="split-one-sided",
        )
    return Split(
        *(
            ClipLibrary(
                tuple(c for c, h in zip(library.clips, held, strict=True) if h == side),
                tuple(w for w, h in zip(library.weights, held, strict=True) if h == side),
            )
            for side in (False, True)
        )
    )


def _key(
    files: Sequence[MotionFile],
    onto: Skeleton | Clip | Target | Path | str | None,
    fps: float,
    config: LibraryConfig,
    body: BodyConfig,
) -> str:
    """The key of a library's content and settings."""
    whole: list[MotionFile] = list(files)
    settings = [VERSION, fps, asdict(config), asdict(body)]
    paths = [Path(asf) for _, asf in config.skeletons]
    paths += [Path(onto)] if isinstance(onto, str | Path) else []
    paths += [Path(body.mjcf)] if body.mjcf else []
    whole += [MotionFile(p, "", "") for p in paths]
    if isinstance(onto, Target):
        settings.append(onto.table.to_dict())
        onto = onto.example or onto.skeleton
    if isinstance(onto, Clip):
        settings += [onto.root_pos.tobytes().hex(), onto.rot.tobytes().hex()]
    if isinstance(onto, Skeleton | Clip):
        skeleton = onto if isinstance(onto, Skeleton) else onto.skeleton
        settings.append([skeleton.names, skeleton.parents, skeleton.offsets.tolist(), skeleton.ends])
    return content_key(whole, settings)


def images(clip: Clip, target: Target, config: LibraryConfig) -> list[Clip]:
    """A placed clip, and as what else the library takes it.

    Raises:
        PoiseError: no joint's name tells a side.
    """
    both = [clip, mirror_image(clip, target, config)] if config.mirror else [clip]
    if matches(config.backwards, clip.name, subject_of(clip.name)):
        both += [backwards(c).replaced(name=c.name + BACKWARDS) for c in both]
    return both


def mirror_image(clip: Clip, target: Target, config: LibraryConfig) -> Clip:
    """A placed clip in a mirror, on the target again: its sides differ a little in bones and soles.

    Raises:
        PoiseError: no joint's name tells a side.
    """
    seen = mirrored_clip(clip)
    example = None if target.example is None else mirrored_clip(target.example)
    seen, _ = set_down(seen, example, target, config)
    return seen.replaced(skeleton=clip.skeleton, name=clip.name + MIRRORED, cyclic=clip.cyclic)
