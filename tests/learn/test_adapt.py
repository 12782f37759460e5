"""Test-time adaptation: Eqs. 1, 2 and 4 by hand, what is detached, and how iterations are chosen."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poise.errors import PoiseError
from poise.learn.between import Between
from poise.learn.inbetween_model import Adaptation, adapt, contact_loss, make_net, smoothness_loss
from poise.learn.inbetween_model import test_loss as eq4
from poise.papers.skeleton2humanoid.rtn import RTN
from toy_windows import SMALL, SMALL_RTN, bank, known, layout


def network(kind: str = "transformer") -> Between | RTN:
    of = bank()
    sizes = SMALL if kind == "transformer" else SMALL_RTN
    net = make_net(kind, layout(of), sizes, 0)
    net.calibrate(of.root[None, :60].float(), of.rot[None, :60].float(), of.offsets[:1].float())
    if isinstance(net, Between):
        with torch.no_grad():
            net.encoder.leave.weight.normal_(0, 0.02, generator=torch.Generator().manual_seed(1))
    return net


def test_equation_1_by_hand() -> None:
    # One foot at (0,0,0), (3,4,0), (3,4,2): steps of 5 and 2; contacts of frames 1 and 2 are .5 and .25
    feet = torch.tensor([[0.0, 0, 0], [3, 4, 0], [3, 4, 2]])[None, :, None]
    contact = torch.tensor([0.5, 0.25])[None, :, None]
    assert contact_loss(feet, contact).tolist() == [pytest.approx(5 * 0.5 + 2 * 0.25)]
    both = contact_loss(feet.repeat(1, 1, 4, 1), contact.repeat(1, 1, 4))
    assert both.tolist() == [pytest.approx(4 * 3.0)]


def test_equation_2_is_the_length_of_the_path() -> None:
    root = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [1, 2, 0]])[None]
    assert smoothness_loss(root).tolist() == [pytest.approx(3.0)]
    still = torch.zeros(1, 3, 3, requires_grad=True)
    smoothness_loss(still).sum().backward()
    assert still.grad is not None and bool(torch.isfinite(still.grad).all())


def test_equation_4_starts_at_the_last_frame_seen_and_leaves_the_target_out() -> None:
    net, k = network(), known(bank(), dtype=torch.float32)
    filled = net.fill(k, 12)
    config = Adaptation(beta=0.5)
    total = eq4(net, k, filled, config)
    from poise.learn.transition import joint_positions

    seen = joint_positions(net.layout, k.offsets, k.past_root[:, -1:], k.past_rot[:, -1:])[:, 0]
    by_hand = torch.zeros(2)
    for n in range(2):
        for t in range(12):
            before = seen[n] if t == 0 else filled.pos[n, t - 1]
            for f, joint in enumerate(net.layout.feet):
                by_hand[n] += (filled.pos[n, t, joint] - before[joint]).norm() * filled.contact[n, t, f]
            last = k.past_root[n, -1] if t == 0 else filled.root[n, t - 1]
            by_hand[n] += 0.5 * (filled.root[n, t] - last).norm()
    assert torch.allclose(total, by_hand, atol=1e-5)


def test_detached_contacts_only_weigh_and_the_papers_can_be_denied() -> None:
    net, k = network(), known(bank(), dtype=torch.float32)
    for contacts, flows in (("detached", False), ("paper", True)):
        filled = net.fill(k, 12)
        filled = filled._replace(contact=filled.contact.detach().requires_grad_(True))
        loss = eq4(net, k, filled, Adaptation(contacts=contacts)).sum()  # type: ignore[arg-type]
        (slope,) = torch.autograd.grad(loss, filled.contact, allow_unused=True)
        assert (slope is not None) == flows


@pytest.mark.parametrize("kind", ["transformer", "rtn"])
@pytest.mark.parametrize("contacts", ["detached", "paper"])
def test_iterations_lower_the_loss_of_a_copy(kind: str, contacts: str) -> None:
    net, k = network(kind), known(bank(), dtype=torch.float32)
    before = {name: v.clone() for name, v in net.state_dict().items()}
    losses: list[float] = []
    config = Adaptation(iterations=6, lr=1e-4, contacts=contacts, batch=1)  # type: ignore[arg-type]
    own = adapt(net, k, 12, config, lambda i, n, loss: losses.append(loss))
    assert len(losses) == 6 and losses[-1] < losses[0]
    assert all(torch.equal(v, before[name]) for name, v in net.state_dict().items())
    assert any(not torch.equal(a, b) for a, b in zip(own.parameters(), net.parameters(), strict=True))


def test_no_iteration_changes_nothing_and_seeds_do_not_matter() -> None:
    net, k = network(), known(bank(), dtype=torch.float32)
    same = adapt(net, k, 12, Adaptation(iterations=0))
    assert torch.allclose(same.fill(k, 12).pos, net.fill(k, 12).pos, atol=1e-5)
    runs = [adapt(net, k, 12, Adaptation(iterations=2)).fill(k, 12).pos for _ in range(2)]
    assert torch.equal(*runs)


def test_an_iteration_is_one_step_however_large_the_set_and_its_parts() -> None:
    """What was chosen on a small set does as much to a large one."""
    net, k = network(), known(bank(), dtype=torch.float32)
    config = Adaptation(iterations=3, lr=1e-4)
    whole = adapt(net, k, 12, config).fill(k, 12).pos
    parts = adapt(net, k, 12, replace(config, batch=1)).fill(k, 12).pos
    assert torch.allclose(whole, parts, atol=1e-5)
    thrice = type(k)(*(x.repeat(3, *[1] * (x.dim() - 1)) for x in k))
    more = adapt(net, thrice, 12, config).fill(k, 12).pos
    assert torch.allclose(whole, more, atol=1e-5)


def test_settings_that_make_no_sense_are_refused() -> None:
    for wrong in ({"iterations": -1}, {"lr": 0.0}, {"contacts": "none"}, {"optimizer": "lbfgs"}):
        with pytest.raises(PoiseError):
            Adaptation(**wrong)  # type: ignore[arg-type]


def test_minibatches_take_a_step_each() -> None:
    net, k = network(), known(bank(), dtype=torch.float32)
    assert len(k.target_root) > 1
    losses: list[float] = []
    often = Adaptation(iterations=3, lr=1e-4, steps="minibatch", batch=1)
    own = adapt(net, k, 12, often, lambda i, n, loss: losses.append(loss))
    assert len(losses) == 3 and losses[-1] < losses[0]
    # One batch that holds all is one step, however it is called.
    one = adapt(net, k, 12, replace(often, batch=1000)).fill(k, 12).pos
    whole = adapt(net, k, 12, replace(often, steps="whole")).fill(k, 12).pos
    assert torch.allclose(one, whole, atol=1e-6)
    assert not torch.allclose(own.fill(k, 12).pos, whole, atol=1e-6)
