"""Looking ahead in a process of its own: the loop goes on meanwhile, and when that process is gone."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable

import torch

from poise.jobs.open import open_run
from poise.live.lookahead_process import LEAD, QUICK, AheadBeside, tries_of
from poise.live.world import LiveWorld
from refusals import refused


def decisions(ahead: AheadBeside, count: int, step: Callable[[], object]) -> int:
    """Steps until so many more were made, each waited for as long as the busiest machine needs."""
    begun, until = ahead.decided, time.monotonic() + 120
    while ahead.decided < begun + count and time.monotonic() < until:
        step()
        while ahead.decides and time.monotonic() < until:
            time.sleep(0.01)
    return ahead.decided - begun


def test_a_decision_begins_with_what_is_done_meanwhile() -> None:
    tracker = open_run(None).tracker
    world, lookahead = LiveWorld(tracker), tries_of(tracker, QUICK, 0)
    world.step(world.characters[0].ease[None])
    snapshot, past = world.env.snapshot(torch.tensor([0])), world.env.pose().pos[:, None][0]
    meanwhile = torch.full((LEAD, world.env.num_actions), 0.01)
    made = lookahead.decide(snapshot, past, 0.1, None, meanwhile)
    assert made.offsets.shape == (LEAD + QUICK.horizon, world.env.num_actions)
    assert torch.equal(made.offsets[:LEAD], meanwhile) and bool(made.offsets.isfinite().all())
    world.close()
    lookahead.copies.close()


def test_the_loop_goes_on_while_another_process_decides_and_after_its_end() -> None:
    tracker = open_run(None).tracker
    others = multiprocessing.active_children()
    world = LiveWorld(tracker, 2, lookahead=(0,), beside=True)
    ahead = world.ahead
    assert isinstance(ahead, AheadBeside)
    ease = torch.stack([c.ease for c in world.characters])
    # At first nothing is decided, and the policy acts alone.
    world.step(ease)
    assert world.looked == 0
    assert decisions(ahead, 2, lambda: world.step(ease)) == 2
    (process,) = (p for p in multiprocessing.active_children() if p not in others)
    assert world.looked > 0 and bool(world.rows.state.qpos.isfinite().all())
    assert max(world.step(ease).off_m) < 0.3
    # Asked for once more, it begins anew.
    world.look_ahead((1,))
    assert decisions(ahead, 1, lambda: world.step(ease)) == 1
    # After steps in which there was no time, nothing that was decided before is acted by.
    assert decisions(ahead, 1, lambda: world.step(ease)) == 1
    world.hurries, looked = True, world.looked
    world.step(ease)
    world.hurries = False
    world.step(ease)
    assert world.looked == looked
    if hasattr(os, "kill"):
        assert process.pid is not None
        os.kill(process.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        process.join(30)
        looked = world.looked
        for _ in range(2 * (LEAD + QUICK.horizon)):
            world.step(ease)
        assert world.looked - looked <= LEAD + QUICK.horizon
        assert max(world.step(ease).off_m) < 0.3
    begun = time.monotonic()
    world.close()
    assert not process.is_alive() and time.monotonic() - begun < 60


def test_a_policy_without_critic_is_refused() -> None:
    from dataclasses import replace

    tracker = replace(open_run(None).tracker, value=None)
    with refused("critic-missing"):
        LiveWorld(tracker, lookahead=(0,))
    world = LiveWorld(tracker)
    assert not world.can_look_ahead
    world.close()
