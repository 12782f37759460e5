"""What recovery is learned on, and how well it goes: PHC's Q^loco and its fail-states.

The paper picks walking and running by hand for its recovery primitive, so that the motion prior knows
nothing else; here rules do.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from poise.env import Acts, Reference
from poise.env.falls import fall_states
from poise.errors import PoiseError
from poise.eval import RecoveryCard, recovery_card, trial_task
from poise.learn import PolicyBundle
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual
from poise.recipes.perpetual.eval import bare_env
from poise.sim import make_backend

#: Of those of who stands, between which the root's height and above which the body's top stay in a clip
#: that walks or stands.
HEIGHT, TOP = (0.85, 1.15), 0.85
#: Share of a library's frames that are lower than who stands; jumps are rarer than crawling.
STANDS = 0.7
#: m/s: nobody runs faster, and limbs do not move faster about the root, on average.
ROOT_SPEED, LIMB_SPEED = 2.5, 0.7
#: s: shorter clips are no walk.
SECONDS = 1.0
#: Distance from the reference, m, at which trials far from it begin (PHC, Sec. 4.2).
FAR = 3.0


def walking_clips(reference: Reference) -> Tensor:
    """`(C,)` bool on the CPU: clips of somebody who walks or stands, for the recovery primitive.

    In all frames the root is about as high, and the body about as tall, as of who stands, nobody runs
    fast, and on average the limbs move about the root no faster than in a walk. All clips if there is no
    such one.
    """
    pos, vel = (getattr(reference.pose, k).cpu() for k in ("pos", "linvel"))
    height, top = pos[:, 0, 2], pos[:, :, 2].amax(-1)
    usual, tall = _standing(height), _standing(top)
    good = (height > HEIGHT[0] * usual) & (height < HEIGHT[1] * usual) & (top > TOP * tall)
    good &= vel[:, 0, :2].norm(dim=-1) < ROOT_SPEED
    limbs = (vel - vel[:, :1]).norm(dim=-1).mean(-1)
    starts, lengths = reference.start.cpu().tolist(), reference.length.cpu().tolist()
    least = SECONDS * reference.rate_hz
    out = torch.tensor(
        [
            n >= least and bool(good[s : s + n].all()) and float(limbs[s : s + n].mean()) < LIMB_SPEED
            for s, n in zip(starts, lengths, strict=True)
        ]
    )
    return out if bool(out.any()) else torch.ones_like(out)


def standing(reference: Reference) -> tuple[int, int]:
    """(clip, frame) of the reference of trials: the last frame of the clip that ends upright most
    quietly, on which it then goes on standing. Clips that go round and round end nowhere."""
    pos, vel = (getattr(reference.pose, k).cpu() for k in ("pos", "linvel"))
    last = (reference.start + reference.length - 1).cpu()
    upright = pos[last, 0, 2] / _standing(pos[:, 0, 2])
    restless = vel[last].norm(dim=-1).mean(-1)
    unfit = (upright < HEIGHT[0]) | (upright > HEIGHT[1]) | reference.cyclic.cpu()
    clip = int((restless + 1e3 * unfit).argmin())
    return clip, int(reference.length[clip]) - 1


def _standing(heights: Tensor) -> Tensor:
    """The height, m, of who stands, of the heights `(F,)` in all frames of a library."""
    return heights.kthvalue(1 + int(STANDS * (len(heights) - 1))).values


def check_falls(imitation: Imitation, count: int = 32) -> None:
    """Lets some characters fall, so that a body that never comes to lie is known before the training.

    Raises:
        PoiseError: they do not.
    """
    recovery = imitation.task.recovery
    if recovery is None:
        return
    backend = make_backend(imitation.humanoid.model, count, "cpu", threads=1)
    try:
        drop = replace(recovery.drop, count=min(count, recovery.drop.count))
        fall_states(backend, imitation.humanoid, imitation.task.pd, drop, int(imitation.config.seed))
    except PoiseError as problem:
        hint = "Train without recovery: --no-recovery"
        raise PoiseError(problem.what, "recovery", hint) from None
    finally:
        backend.close()


def try_recovery(
    imitation: Imitation, policy: Acts, trials: int, threads: int = 0, device: str = "cpu"
) -> RecoveryCard:
    """Trials of every kind of fail-state against a reference that stands, without help.

    imitation: with the task of a stage that learns recovery. The same falls and directions every time.
    """
    config: Perpetual = imitation.config
    clip, frame = standing(imitation.reference)
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    ways = imitation.ways
    tried = replace(imitation, task=trial_task(imitation.task, FAR, trials, ways is not None))
    return recovery_card(
        lambda worlds: bare_env(tried, worlds, 0.0, threads, device),
        policy, trials, method=config.method, clip=clip, frame=frame, seconds=config.recovering.seconds,
        ways=ways,
    )  # fmt: skip


def back(card: RecoveryCard) -> tuple[int, int]:
    """How many of how many trials of all kinds were back in the last of the card's times."""
    return sum(round(r.within[-1] * r.trials) for r in card.rows), sum(r.trials for r in card.rows)
