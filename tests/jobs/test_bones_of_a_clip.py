"""A policy on bodies with the bones of a clip."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.recipes.perpetual import lengths_seen
from toy_policy import WALK


@pytest.mark.parametrize("kind", ["rotations", "keypoints"])
def test_a_policy_sees_lengths_in_units_of_its_legs(kind: str) -> None:
    """A person who is smaller all over is seen as one of the policy's own size."""
    tracker = open_run(None if kind == "rotations" else kind).tracker
    clip, factor = read_clip(WALK), 0.7
    bones = clip.skeleton
    ends = tuple((j, (x * factor, y * factor, z * factor)) for j, (x, y, z) in bones.ends)
    small = clip.replaced(
        skeleton=replace(bones, offsets=bones.offsets * factor, ends=ends),
        root_pos=clip.root_pos * factor,
    )
    seen = list[torch.Tensor]()
    for one in (clip, small):
        own = tracker.with_bones_of(one)
        env = imitation_of(own, [place(one, own)]).env(1, None, False, 1, help_scale=0.0)
        env.reset_to(torch.zeros(1, dtype=torch.long), torch.full((1,), 20))
        obs = env.observe()
        seen.append(own.policy.norm.forward(obs).clone())
        action, value = own.policy.act(obs), own.value
        assert torch.equal(action, own.policy.policy.act(own.policy.norm.forward(obs)))
        assert value is not None and value.norm is own.policy.norm
        env.close()
    lengths = lengths_seen(tracker.config, tracker.humanoid)
    assert lengths.sum() > 250 and len(lengths) == tracker.policy.num_obs
    torch.testing.assert_close(seen[0][:, lengths], seen[1][:, lengths], rtol=0, atol=0.03)
    # Bodies of another size may have other frames of their own.
    assert float((seen[0] - seen[1])[:, ~lengths].abs().mean()) < 0.01
    # The tracker itself is as it was.
    assert not torch.equal(own.policy.norm.std, tracker.policy.norm.std)
