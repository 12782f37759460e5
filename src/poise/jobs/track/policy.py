"""A trained controller as one small file: weights, body, settings, and what it was trained on.

    policy = policy_of_run(Path("run"))          # or load_tracker("policy.safetensors")
    save_tracker(policy, "policy.safetensors")

The file is a checkpoint (`poise.learn.checkpoint`). Matrices are in half precision, everything else as
it was trained; the body stands in it with every number, so that no clip of the training is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise import __version__
from poise.body import BodyTable, Humanoid
from poise.body.humanoid import make_humanoid
from poise.env.recovery.clips import RecoveryClips
from poise.errors import PoiseError
from poise.jobs.library.clips import Target
from poise.jobs.perpetual import run as perpetual_run
from poise.jobs.runs import FINAL, RUN_FILE, trained_policy
from poise.learn import LATEST, PolicyBundle, Value, load_checkpoint, save_checkpoint
from poise.learn.state import prefixed, under
from poise.motion import Clip, trim
from poise.motion.pack import pack_clips, unpack_clips
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import RECIPE, Perpetual
from poise.recipes.perpetual.config import config_of
from poise.settings import to_data

#: What a policy file calls itself, and the version of what stands in it.
KIND, VERSION = "tracker", 1
#: The policy that comes with Poise.
SHIPPED = Path(__file__).parents[2] / "data/tracker.safetensors"
#: Frames of a clip that are kept, by which the skeleton's standing is known.
EXAMPLE_FRAMES = 300
#: The largest number of half precision.
_HALF_MAX = torch.finfo(torch.float16).max
_EXAMPLE, _WAYS = "example/", "ways/"


@dataclass(frozen=True, eq=False)
class Tracker:
    """A policy with the body that it moves.

    policy: acts deterministically on raw observations. humanoid: the body, its model with the physics
    settings. example: a clip on the body's skeleton, which tells how it stands. config: the settings by
    which it was trained. about: "clips" (names), "stage", "samples", "seconds", "help_n" (what help the
    training still gave), "poise" (the version that wrote it). ways: by which the policy comes back
    where it has lost a motion; None if it has not learned that. value: what its critic tells of a state,
    by which `track.searching` looks ahead; None where the critic was not kept.
    """

    policy: PolicyBundle
    humanoid: Humanoid
    example: Clip
    config: Perpetual
    about: Mapping[str, Any]
    recovery_clips: RecoveryClips | None = None
    value: Value | None = None

    @property
    def target(self) -> Target:
        """The body as what a library is brought onto, see `library_of`."""
        return Target(self.humanoid.skeleton, self.example, self.humanoid.table, "the policy's body")


def open_tracker(path: Path | None = None) -> Tracker:
    """The policy in a file or a run folder; without a path the one that comes with Poise.

    Raises:
        PoiseError: it is not there, or it cannot be used.
    """
    if path is None:
        path = SHIPPED
    if not path.exists():
        raise PoiseError(
            "there is no such policy", path, "Give a policy file or the folder of a perpetual run"
        )
    return policy_of_run(path) if path.is_dir() else load_tracker(path)


def policy_of_run(folder: Path) -> Tracker:
    """The latest policy of a run of `poise train perpetual`; builds its body anew from all its clips.

    Raises:
        PoiseError: no run, a run of another recipe, or nothing was trained in it.
    """
    path = folder / RUN_FILE
    if not path.exists() and (folder / "run" / RUN_FILE).exists():
        path = folder / "run" / RUN_FILE
    if not path.exists():
        raise PoiseError(
            f"is no run folder: there is no {RUN_FILE} in it",
            folder,
            "Give a policy file or the folder of a perpetual run",
        )
    _, meta = load_checkpoint(path)
    if meta.get("recipe") != RECIPE["name"]:
        raise PoiseError(
            "its policy knows only the clips that it was trained on, and cannot track others",
            folder,
            "Give the run of poise train perpetual, or imitate the clip with poise imitate",
        )
    return tracker_of(path.parent, perpetual_run.reopen(path.parent))


def tracker_of(folder: Path, imitation: Imitation) -> Tracker:
    """The latest policy of a run in `folder`, whose task is built already."""
    policy, said = trained_policy(folder, imitation)
    inner: Mapping[str, Any] = said.get("metadata", {})
    earlier = load_checkpoint(folder / RUN_FILE)[1].get("earlier", {"samples": 0, "seconds": 0.0})
    about = {
        "clips": list(imitation.library.names),
        "stage": inner.get("stage") or inner.get("course", {}).get("stage", {}).get("kind", ""),
        "finished": (folder / FINAL).exists(),
        # With what the policy had cost that the run went on from.
        "samples": int(said.get("samples", 0)) + earlier["samples"],
        "seconds": float(said.get("seconds", 0.0)) + earlier["seconds"],
        "help_n": float(said["help_limit"]),
        "poise": __version__,
    }
    example = imitation.library.clips[0]
    value = value_of_run(folder, policy, imitation.config)
    return Tracker(
        policy, imitation.humanoid, example, imitation.config, about, imitation.recovery_clips, value
    )


def value_of_run(folder: Path, policy: PolicyBundle, config: Perpetual) -> Value | None:
    """The critic of a run's last checkpoint, None where there is none."""
    path = folder / LATEST
    if not path.exists():
        return None
    state = load_checkpoint(path)[0]
    return Value(policy, state, config.ppo.activation) if "critic/layers.0.weight" in state else None


def export_policy(run: Path, path: Path) -> Tracker:
    """Writes the latest policy of a run folder as one file, and returns it as the file has it."""
    save_tracker(policy_of_run(run), path)
    return load_tracker(path)


def save_tracker(tracker: Tracker, path: Path) -> None:
    """Writes the file whole or not at all."""
    example = trim(tracker.example, 0, EXAMPLE_FRAMES)
    packed, clip = pack_clips([example])
    # The rotations only show how the skeleton stands; offsets are the body's and stay exact.
    small = {k: v if "offsets" in k else v.float() for k, v in packed.items()}
    tensors = {k: _halved(k, v) for k, v in tracker.policy.state().items()}
    meta = {
        "kind": KIND,
        "tracker": VERSION,
        "recipe": RECIPE["name"],
        "config": to_data(tracker.config),
        "table": tracker.humanoid.table.to_dict(),
        "example": clip[0],
        "about": dict(tracker.about),
        **tracker.policy.identity(tracker.humanoid.identity),
    }
    tensors |= {_EXAMPLE + k: v for k, v in small.items()}
    if tracker.recovery_clips is not None:
        tensors |= {_WAYS + k: v.float() for k, v in tracker.recovery_clips.state().items()}
    if tracker.value is not None:
        tensors |= {k: _halved(k, v) for k, v in prefixed("value", tracker.value.state()).items()}
    save_checkpoint(path, tensors, meta)


def load_tracker(path: Path) -> Tracker:
    """The policy in a file that `save_tracker` wrote.

    Raises:
        PoiseError: missing, damaged, of another version, or another kind of file.
    """
    tensors, meta = load_checkpoint(path)
    _check_kind(meta, path)
    foreign = PoiseError(
        f"the policy was written by Poise {meta.get('poise', 'of an unknown version')} and does not fit "
        f"this version, {__version__}",
        path,
        "Export it anew from its run, or install that version",
    )
    if meta.get("tracker") != VERSION:
        raise foreign
    try:
        config = config_of(meta["config"])
        table = BodyTable.from_dict(meta["table"])
        wide = {k.removeprefix(_EXAMPLE): v.double() for k, v in tensors.items() if _EXAMPLE in k}
        example = unpack_clips(wide, [meta["example"]])[0]
        humanoid = make_humanoid(example.skeleton, table)
        bundle = PolicyBundle.rebuild(meta["num_obs"], meta["num_actions"], meta["policy"])
        bundle.load_state(tensors)
        about, character = meta["about"], meta["character"]
        told = {k: v.double() for k, v in under(_WAYS.rstrip("/"), tensors).items()}
        recovery_clips = RecoveryClips.of(told) if told else None
        critic = {
            k: v.float() if v.dtype == torch.half else v for k, v in under("value", tensors).items()
        }
        value = Value(bundle, critic, config.ppo.activation) if critic else None
    except (PoiseError, KeyError, TypeError, ValueError, AttributeError):
        raise foreign from None
    if humanoid.identity != character:
        raise PoiseError(
            f"the policy was trained for the character '{character}', and its body is "
            f"'{humanoid.identity}'",
            path,
            "Export it anew from its run",
        )
    config.sim.apply(humanoid.model)
    bundle.meta = {"samples": about.get("samples", 0), "seconds": about.get("seconds", 0.0)}
    return Tracker(bundle, humanoid, example, config, about, recovery_clips, value)


def _check_kind(meta: Mapping[str, Any], path: Path) -> None:
    kind = meta.get("kind")
    if kind == KIND:
        return
    if kind == "run":
        raise PoiseError("it holds a run's clips and settings", path, f"Give the folder {path.parent}")
    where = f"Give the folder {path.parent}" if (path.parent / RUN_FILE).exists() else ""
    raise PoiseError(
        "it holds a policy's weights without the body that they move",
        path,
        where or "Give the run's folder, or a file that poise track --save-policy wrote",
    )


def _halved(name: str, value: Tensor) -> Tensor:
    """Matrices of the networks in half precision, where its range holds them."""
    if not name.startswith(("policy/", "value/")) or value.ndim < 2 or not value.is_floating_point():
        return value
    return value.half() if float(value.abs().max()) < _HALF_MAX else value
