"""A trained controller as one small file: weights, body, settings, and what it was trained on.

    policy = open_run("run").tracker             # or of "policy.safetensors"
    save_tracker(policy, "policy.safetensors")

The file is a checkpoint (`poise.learn.checkpoint`). Matrices are in half precision, everything else as
it was trained; the body stands in it with every number, so that no clip of the training is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from poise.body import BodyTable, Humanoid
from poise.body.body_table import leg_length
from poise.body.humanoid import make_humanoid
from poise.env.recovery.get_up import RecoveryClips
from poise.errors import PoiseError
from poise.formats.own import pack_clips, unpack_clips
from poise.jobs.library.clips import Target
from poise.jobs.run_file import RUN_FILE
from poise.kinematics import RetargetConfig, onto_own, own_body
from poise.learn import PolicyBundle, Value, load_checkpoint, save_checkpoint
from poise.learn.checkpoint import PolicyMeta, prefixed, tensors_of, under
from poise.learn.policy import policy_in
from poise.motion import Clip, trim
from poise.recipes.perpetual import lengths_seen
from poise.recipes.perpetual_settings import Perpetual, config_of
from poise.settings import check_data, to_data
from poise.version import __version__


class _About(TypedDict, total=False):
    clips: list[str]
    samples: int
    seconds: float
    help_n: float


class TrackerMeta(PolicyMeta):
    """The metadata of a policy file."""

    config: dict[str, Any]
    table: dict[str, Any]
    example: dict[str, Any]
    about: _About


#: What a policy file calls itself, and the version of what stands in it.
KIND, VERSION = "tracker", 1
_DATA = Path(__file__).parents[1] / "data"
#: The policy that comes with Poise.
SHIPPED = _DATA / "tracker.safetensors"
#: One that comes along by a name: it is told places of joints alone.
POLICIES = {"keypoints": _DATA / "keypoints.safetensors"}
#: Frames of a clip that are kept, by which the skeleton's standing is known.
EXAMPLE_FRAMES = 300
#: The largest number of half precision.
_HALF_MAX = torch.finfo(torch.float16).max
_EXAMPLE, _WAYS = "example/", "ways/"


@dataclass(frozen=True, eq=False)
class Tracker:
    """A policy with the body that it moves.

    Attributes:
        policy: acts deterministically on raw observations.
        humanoid: the body.
        example: a clip on the body's skeleton, which tells how it stands.
        config: the settings by which it was trained.
        about: "clips" (names), "stage", "samples", "seconds", "help_n" (what help the training still
            gave), "poise" (the version that wrote it).
        recovery_clips: by which the policy comes back where it has lost a motion; None if it has not
            learned that.
        value: what its critic tells of a state, by which `track.recovery_run` looks ahead; None where
            the critic was not kept.
        onto: how motions pass onto the body; None for those of any size, as `retarget` does by itself.
    """

    policy: PolicyBundle
    humanoid: Humanoid
    example: Clip
    config: Perpetual
    about: Mapping[str, Any]
    recovery_clips: RecoveryClips | None = None
    value: Value | None = None
    onto: RetargetConfig | None = None

    @property
    def target(self) -> Target:
        """The body as what a library is brought onto, see `library_of`."""
        return Target(self.humanoid.skeleton, self.example, self.humanoid.table, "the policy's body")

    def with_bones_of(self, clip: Clip) -> Tracker:
        """The policy on its own bodies and hinges with the lengths and masses of a clip's skeleton.

        It sees lengths and speeds in units of its legs: as if the character and all that it does were
        as large as the body that it was trained on.

        Raises:
            PoiseError: see `own_body`.
        """
        table, example = own_body(clip, self.humanoid.table, self.example, self.config.body)
        humanoid = make_humanoid(example.skeleton, table)
        own = replace(self, humanoid=humanoid, example=example, onto=onto_own(humanoid.table))
        lengths = lengths_seen(self.config, self.humanoid)
        if len(lengths) != self.policy.num_obs:
            return own
        size = leg_length(self.humanoid.table) / leg_length(table)
        policy = self.policy.seeing(torch.where(lengths, size, 1.0))
        return replace(own, policy=policy, value=None if self.value is None else self.value.of(policy))

    def with_damping(self, seconds: float) -> Tracker:
        """The policy on its body with other servos, which it does not know yet and has to learn.

        seconds: their damping kd as a fraction of kp, see `BodyConfig`.

        Raises:
            PoiseError: its own servos have no damping, which is what is scaled.
        """
        config = self.config
        if not config.body.damping:
            raise PoiseError("the policy's body has no damping that could be scaled", code="no-damping")
        share = seconds / config.body.damping
        table = self.humanoid.table
        table = replace(table, rows=tuple(replace(r, kd=r.kd * share) for r in table.rows))
        humanoid = make_humanoid(self.humanoid.skeleton, table)
        config = replace(config, body=replace(config.body, damping=seconds))
        return replace(self, humanoid=humanoid, config=config)


def save_tracker(tracker: Tracker, path: Path) -> None:
    """Writes the file whole or not at all."""
    example = trim(tracker.example, 0, EXAMPLE_FRAMES)
    packed, clip = pack_clips([example])
    # The rotations only show how the skeleton stands; offsets are the body's and stay exact.
    small = {k: v if "offsets" in k else v.float() for k, v in tensors_of(packed).items()}
    tensors = {k: halved(k, v) for k, v in tracker.policy.state().items()}
    meta = {
        "kind": KIND,
        "tracker": VERSION,
        "recipe": "perpetual",
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
        tensors |= {k: halved(k, v) for k, v in prefixed("value", tracker.value.state()).items()}
    save_checkpoint(path, tensors, meta)


def load_tracker(path: Path) -> Tracker:
    """The policy in a file that `save_tracker` wrote.

    Raises:
        PoiseError: missing, damaged, of another version, or another kind of file.
    """
    tensors, meta = load_checkpoint(path)
    check_policy_file(meta, path)
    config = config_of(meta["config"], path)
    bundle = policy_in(tensors, meta, path)
    try:
        table = BodyTable.from_dict(meta["table"])
        wide = {k.removeprefix(_EXAMPLE): v.double() for k, v in tensors.items() if _EXAMPLE in k}
        example = unpack_clips(wide, [meta["example"]])[0]
        humanoid = make_humanoid(example.skeleton, table)
        about, character = meta["about"], meta["character"]
        told = {k: v.double() for k, v in under(_WAYS.rstrip("/"), tensors).items()}
        recovery_clips = RecoveryClips.of(told) if told else None
        critic = {
            k: v.float() if v.dtype == torch.half else v for k, v in under("value", tensors).items()
        }
        value = Value(bundle, critic, config.ppo.activation) if critic else None
    except (PoiseError, KeyError, TypeError, ValueError, AttributeError, RuntimeError):
        raise _foreign(meta, path) from None
    if humanoid.identity != character:
        raise PoiseError(
            f"the policy was trained for the character '{character}', and its body is "
            f"'{humanoid.identity}'",
            path,
            "Export it anew from its run",
            code="bodies-differ",
        )
    bundle.meta = {"samples": about.get("samples", 0), "seconds": about.get("seconds", 0.0)}
    return Tracker(bundle, humanoid, example, config, about, recovery_clips, value)


def check_policy_file(meta: Mapping[str, Any], path: Path) -> None:
    """Refuses what is no policy file of this version, by its metadata alone.

    Raises:
        PoiseError: another kind of file, another version, or metadata that is not `TrackerMeta`.
    """
    if meta.get("kind") != KIND:
        where = path.parent if (path.parent / RUN_FILE).exists() else None
        hint = f"Give the folder {where}" if where else "Give the run's folder, or a policy file"
        if meta.get("kind") == "run":
            raise PoiseError(
                "it holds a run's clips and settings alone", path, hint, code="not-a-policy"
            )
        raise PoiseError(
            "it holds a policy's weights without the body that they move",
            path,
            hint,
            code="policy-without-body",
        )
    if meta.get("tracker") != VERSION:
        raise _foreign(meta, path)
    check_data(TrackerMeta, meta, path)


def _foreign(meta: Mapping[str, Any], path: Path) -> PoiseError:
    wrote = str(meta.get("poise", "of an unknown version"))[:40]
    return PoiseError(
        f"the policy was written by Poise {wrote} and does not fit this version, {__version__}",
        path,
        "Export it anew from its run, or install that version",
        code="version-differs",
    )


def halved(name: str, value: Tensor) -> Tensor:
    """Matrices of the networks in half precision, where its range holds them."""
    if not name.startswith(("policy/", "value/")) or value.ndim < 2 or not value.is_floating_point():
        return value
    return value.half() if float(value.abs().max()) < _HALF_MAX else value
