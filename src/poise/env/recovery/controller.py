"""Who has lost a motion is led back to it: a policy's reference becomes a way from where it is.

PHC tells who has fallen or is far nothing but a point to come back to (`env.recovery.config`). A way
says how: it is planned (`env.recovery.planner`) from clips of somebody who gets up and somebody who
walks, when it is needed, and is tracked like any other motion. So the policy that tracks a library also
recovers, and needs no other goal, reward or network for it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.env.recovery.clips import RecoveryClips
from poise.env.recovery.get_up import GetUpPlanner, Poses
from poise.env.recovery.planner import plan_recovery
from poise.env.reference import Reference
from poise.env.task import Acts

#: m between bodies and their reference, on average, beyond which it is lost; the field's failure.
LOST = 0.5
#: m/s of the bodies on average, below which somebody has come to rest; s for which that is waited.
REST, WAITS_S = 0.5, 1.5
#: Where a motion is entered again: m for each m/s of its bodies, and for each s of it that is left out.
MOVES, SKIPS = 0.3, 0.05
#: What a world does.
TRACKS, FALLS, RETURNS = 0, 1, 2


class RecoveryController:
    """Acts as a policy in an environment, and leads worlds back that have lost their reference.

    The reference waits for whoever has lost it (`LOST`). Once the character has come to rest it follows
    a way to a frame of its clip in which it hardly moves and nearly stands, and goes on from there. Who
    loses the way gets another one.

    Args:
        env: without automatic restarts, its residual force, if any, of one group. Its reference is what
            worlds track and come back to.
        policy: acts on the environment's observations. ways: what its library knows of coming back.

    Attributes: `doing (N,)`, `TRACKS`, `FALLS` or `RETURNS`. frame: `(N,)` of the world's own clip, at
    which the reference is or waits. lost: (world, frame of its clip) of every time one was lost.
    """

    def __init__(self, env: ImitationEnv, policy: Acts, recovery_clips: RecoveryClips):
        self.env, self.policy, self.reference = env, policy, env.reference
        table, rate = env.reference.humanoid.table, env.reference.rate_hz
        self.get_up, self._ease = (
            GetUpPlanner(recovery_clips, table, rate),
            Poses(table, recovery_clips.ease[None]),
        )
        self.clip, self.frame = env.clip.clone(), env.frame.clone()
        self.doing, self._since = torch.zeros_like(self.clip), torch.zeros_like(self.clip)
        self.lost: list[tuple[int, int]] = []
        # What each world tracks: its way, if it is on one, and the frame of that or of its clip.
        self._on, self._at = torch.zeros_like(self.clip, dtype=torch.bool), env.frame.clone()
        self._ways: dict[int, Reference] = {}
        self._all = env.reference

    def lead(self, worlds: Tensor) -> Tensor:
        """Ways for worlds `(n,)` from where they are; observations `(N, O)` of all."""
        for i in worlds.tolist():
            self._ways[i] = self._way(i)
        self._on[worlds], self._at[worlds], self.doing[worlds] = True, 0, RETURNS
        self._ways = {i: way for i, way in self._ways.items() if self._on[i]}
        self._all = self.reference.joined(*self._ways.values())
        return self._take_up()

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for observations `(N, O)` of the worlds as they stand."""
        env, (tracks, falls, returns) = self.env, (self.doing == k for k in (TRACKS, FALLS, RETURNS))
        # Whoever falls waits for nothing but rest, and its reference with it.
        self._at = torch.where(falls, self._at, env.frame)
        self.frame[tracks] = self._at[tracks]
        pose, ref = env.pose(), env.reference.gather(env.clip, self._at)
        lost = ~((pose.pos - ref.pos).norm(dim=-1).mean(-1) <= LOST) & ~falls
        self.lost += [(i, int(self.frame[i])) for i in (lost & tracks).nonzero().squeeze(-1).tolist()]
        self.doing[lost], self._since[lost] = FALLS, 0
        back = returns & ~lost & (self._at >= env.reference.length[env.clip] - 1)
        self.doing[back], self._on[back], self._at[back] = TRACKS, False, self.frame[back]
        self._since += 1
        late = self._since > WAITS_S * env.reference.rate_hz
        rests = falls & ((pose.linvel.norm(dim=-1).mean(-1) < REST) | late)
        if bool((rests | back).any()):
            obs = self.lead(rests.nonzero().squeeze(-1))
        elif bool(falls.any()):
            obs = self._take_up()
        return self.policy.act(obs)

    def _take_up(self) -> Tensor:
        """Every world goes on with what it tracks."""
        clip = self.clip.clone()
        if self._ways:
            clip[list(self._ways)] = len(self.reference.length) + torch.arange(len(self._ways))
        return self.env.set_goal(self._all, clip, self._at)

    def _way(self, world: int) -> Reference:
        """From where a world's character is to where its clip is entered again."""
        own, one = self.reference, slice(world, world + 1)
        self.frame[world] = self._entry(int(self.clip[world]), int(self.frame[world]))
        place = own.coordinates(self.clip[one], self.frame[one])[0][0].cpu()
        way = plan_recovery(self.get_up, self.env.backend.state.qpos[world].double().cpu(), place)
        way = torch.cat((way[:-1], self.get_up.blend(way[-1], place)))
        found = Reference(own.humanoid, [way.numpy()], own.rate_hz, [f"way {world}"])
        return found.to(self.env.device)

    def _entry(self, clip: int, frame: int) -> int:
        """A frame of a clip, `frame` or a later one, from which it is easily gone on."""
        own = self.reference
        rows = slice(int(own.start[clip]) + frame, int(own.start[clip] + own.length[clip]))
        if rows.stop - rows.start < 2:
            return frame
        apart = self._ease.apart(Poses(own.humanoid.table, own.qpos[rows].cpu()))[0]
        speed = own.pose.linvel[rows].norm(dim=-1).mean(-1).cpu()
        later = torch.arange(len(apart)) / own.rate_hz
        return frame + int((apart + MOVES * speed + SKIPS * later).argmin())
