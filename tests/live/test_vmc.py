"""VMC: an independent client's datagrams, and there and back again."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.kinematics.retargeting.passage import world_of
from poise.live.people import Calibration
from poise.live.protocol import LiveConfig
from poise.live.session import Live
from poise.live.sinks import OwnPuppet, Puppet, VmcSink
from poise.live.stream import Inbox
from poise.live.vmc import (
    MESSAGES,
    NEEDED,
    Avatar,
    Message,
    VmcSource,
    bundled,
    datagram,
    encoded,
    from_unity,
    messages,
    skeleton_of,
    standard,
    t_pose,
    to_unity,
)
from poise.motion import Clip, Skeleton
from poise.motion.rotations import normalize, quat_rotate, yaw_quat
from refusals import refused
from test_docs import WALK


def joints(skeleton: Skeleton, root: np.ndarray, rot: np.ndarray) -> np.ndarray:
    """`(J, 3)` m."""
    world, out = world_of(skeleton, rot), [root]
    for j, parent in enumerate(skeleton.parents[1:], 1):
        out.append(out[parent] + quat_rotate(world[parent], skeleton.offsets[j]))
    return np.stack(out)


def body_of(bones: list[Message]) -> tuple[Skeleton, np.ndarray, np.ndarray]:
    """Model, hips and rotations of the messages of a frame."""
    rows = {m.arguments[0]: np.array(m.arguments[1:], float) for m in bones}
    pos, rot = from_unity(*np.split(np.stack(list(rows.values())), [3], 1))
    skeleton = skeleton_of(dict(zip(map(str, rows), pos, strict=True)))
    assert list(skeleton.names) == list(rows)
    return skeleton, pos[0], rot


def on_vrm() -> Clip:
    """The embedded walk on a VRM model."""
    from poise.kinematics import retarget

    return retarget(read_clip(WALK), t_pose(standard()))[0]


def test_unity_is_left_handed_with_y_up() -> None:
    # Ahead, left and up of Poise are +Z, -X and +Y of Unity.
    pos, _ = to_unity(np.eye(3), np.tile([1.0, 0, 0, 0], (3, 1)))
    np.testing.assert_allclose(pos, [[0, 0, 1], [-1, 0, 0], [0, 1, 0]])
    # A quarter turn to the left about Poise's +Z takes ahead to left; in Unity +Z to -X, which is a
    # turn by -90 degrees about +Y.
    _, turn = to_unity(np.zeros(3), yaw_quat(np.pi / 2))
    np.testing.assert_allclose(turn, [0, -np.sqrt(0.5), 0, np.sqrt(0.5)])
    rng = np.random.default_rng(0)
    p, r = rng.normal(size=(9, 3)), normalize(rng.normal(size=(9, 4)))
    back = from_unity(*to_unity(p, r))
    np.testing.assert_allclose(back[0], p)
    np.testing.assert_allclose(back[1], r)
    # Rotations and reflections commute: turned, then converted, is converted, then turned.
    v = rng.normal(size=(9, 3))
    there, turns = to_unity(v, r)
    unity = np.concatenate((turns[:, 3:], turns[:, :3]), 1)
    np.testing.assert_allclose(quat_rotate(unity, there), to_unity(quat_rotate(r, v), r)[0], atol=1e-12)


def test_what_goes_out_comes_in_within_a_millimetre() -> None:
    clip, avatar = on_vrm(), Avatar("a")
    for t in range(clip.frames):
        made = avatar.take(
            messages(datagram(clip.skeleton, clip.root_pos[t], clip.rot[t], 1 + t / 30)), 0
        )
        if t == 0:
            # The first frame is known to be whole when the second begins.
            assert made == []
            continue
        packet = made[-1]
        off = joints(packet.skeleton, packet.root_pos, packet.rot) - joints(
            clip.skeleton, clip.root_pos[t], clip.rot[t]
        )
        assert np.abs(off).max() < 1e-3
        assert packet.time_s == pytest.approx(1 + t / 30, abs=1e-4)


def test_an_independent_client_drives_it() -> None:
    client = pytest.importorskip("pythonosc.udp_client")
    builder = pytest.importorskip("pythonosc.osc_message_builder")
    clip, box = on_vrm(), Inbox()
    source = VmcSource("127.0.0.1", 0, box, time.perf_counter)
    source.start()
    try:
        sender = client.SimpleUDPClient("127.0.0.1", source.port)
        seen = []
        for t in range(20):
            pos = clip.skeleton.offsets.copy()
            pos[0] = clip.root_pos[t]
            places, turns = to_unity(pos, clip.rot[t])
            sender.send_message("/VMC/Ext/OK", 1)
            sender.send_message("/VMC/Ext/Root/Pos", ["root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
            for name, place, turn in zip(clip.skeleton.names, places, turns, strict=True):
                made = builder.OscMessageBuilder("/VMC/Ext/Bone/Pos")
                for value in (name, *place, *turn):
                    made.add_arg(value if isinstance(value, str) else float(value))
                sender.send(made.build())
            sender.send_message("/VMC/Ext/Unknown", [1, "x"])
            time.sleep(0.005)
        end = time.monotonic() + 5
        while len(seen) < 18 and time.monotonic() < end:
            seen += [p for line in box.take().values() for _, p in line]
            time.sleep(0.01)
    finally:
        source.close()
    assert len(seen) >= 18 and not box.refused
    last = seen[-1]
    off = joints(last.skeleton, last.root_pos, last.rot)
    near = min(
        np.abs(off - joints(clip.skeleton, clip.root_pos[t], clip.rot[t])).max() for t in range(20)
    )
    assert near < 1e-3


def test_through_the_body_and_out_again() -> None:
    """Without physics: what a body's hinges cannot do is lost, and nothing else."""
    import mujoco

    tracker, clip = open_run(None).tracker, on_vrm()
    assert tracker.recovery_clips is not None
    ease = tracker.recovery_clips.ease.numpy()
    onto = Calibration.by(clip, tracker.humanoid, tracker.example, ease, tracker.onto)
    onto.feet, onto.floor, onto.planted = {}, 0.0, 0.0
    factor = onto.scale
    puppet = Puppet(tracker.humanoid.table, tracker.example, clip.skeleton, 1.0 / factor)
    model = tracker.humanoid.model
    data, worst = mujoco.MjData(model), []
    for t in range(0, clip.frames, 7):
        data.qpos[:] = onto(clip.root_pos[t], clip.rot[t])
        mujoco.mj_kinematics(model, data)
        bodies = np.concatenate((data.xpos[1:], data.xquat[1:]), 1)
        hips, rot = puppet(bodies)
        a, b = joints(clip.skeleton, hips, rot), joints(clip.skeleton, clip.root_pos[t], clip.rot[t])
        worst.append(np.linalg.norm((a - a[0]) - (b - b[0]), axis=-1).max())
    assert max(worst) < 0.06


def test_in_through_the_body_and_out_agree_to_a_millimetre_on_the_wire() -> None:
    """VMC in, a character that is exactly where its goal is, VMC out: what came is what goes. Where a
    character differs from its goal, the model differs by as much."""
    tracker, clip = open_run(None).tracker, on_vrm()
    live, now, out = Live(tracker, LiveConfig(buffer_s=0.1), clock=lambda: 0.0), 0.0, list[Message]()
    source, avatar = Avatar("a"), OwnPuppet(tracker.humanoid.table, tracker.example)
    worst, seen_once, bent = list[float](), 0, list[float]()
    for k in range(150):
        # It stands for 2 s, then walks.
        t = max(0, k - 75) % clip.frames
        for packet in source.take(
            messages(datagram(clip.skeleton, clip.root_pos[t], clip.rot[t], 1 + now)), now
        ):
            live.inbox.offer(packet, now)
        seen = live.step(now)
        now += 1 / 30
        assert seen is not None
        own = seen.own[0]
        if own is None:
            continue
        seen_once += 1
        skeleton, hips, rot = avatar(seen.goals[0], seen.goals[0], own)
        out = [m for m in messages(datagram(skeleton, hips, rot, 1.0)) if m.address.endswith("Bone/Pos")]
        told = body_of(out)
        here = yaw_quat(own.where.yaw)
        want = (
            quat_rotate(here, joints(own.skeleton, own.root_pos, own.rot)) + own.where.shift / own.factor
        )
        worst.append(float(np.abs(joints(*told) - want).max()))
        _, hips, rot = avatar(seen.bodies[0], seen.goals[0], own)
        apart = np.linalg.norm(joints(skeleton, hips, rot) - want, axis=-1).mean()
        bent.append(float(apart * own.factor - seen.off_m[0]))
    live.close()
    assert seen_once > 30 and max(worst) < 1e-3
    # With physics it is off by the tracking error.
    assert abs(np.median(bent)) < 0.03


def test_a_sink_is_heard() -> None:
    tracker = open_run(None).tracker
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5)
        puppet = OwnPuppet(tracker.humanoid.table, tracker.example)
        sink = VmcSink(f"127.0.0.1:{ear.getsockname()[1]}", puppet)
        bodies = np.zeros((1, len(tracker.humanoid.bodies), 7))
        bodies[..., 3] = 1.0
        sink.write(bodies, 2.5)
        told = messages(ear.recv(65_507))
        sink.close()
    assert [m.arguments for m in told if m.address == "/VMC/Ext/T"] == [(2.5,)]
    assert {m.arguments[0] for m in told if "Bone" in m.address} == set(standard().names)
    with refused("address-malformed"):
        VmcSink("nowhere", puppet)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"abc", b"abcd", b"/a\0\0", b"/a\0\0,f\0\0", b"/a\0\0,x\0\0\0\0\0\0",
        b"/a\0x,f\0\0\0\0\0\0",
        b"#bundle\0", b"#bundle\0" + bytes(8) + b"\xff\xff\xff\xff", bytes(70_000),
        bundled([bundled([bundled([bundled([bundled([encoded("/a", (1,))])])])])]),
        bundled([encoded("/a", (1,))] * (MESSAGES + 1)), b"/\xff\0\0,\0\0\0",
    ],
)  # fmt: skip
def test_what_is_no_osc_is_refused(data: bytes) -> None:
    with pytest.raises(PoiseError):
        messages(data)


def test_ten_thousand_torn_datagrams_are_counted() -> None:
    rng, box, clip = np.random.default_rng(5), Inbox(), on_vrm()
    source = VmcSource("127.0.0.1", 0, box, lambda: 0.0)
    whole = datagram(clip.skeleton, clip.root_pos[0], clip.rot[0], 1.0)
    for k in range(3000):
        data = bytearray(whole[: rng.integers(1, len(whole) + 1)])
        for at in rng.integers(0, len(data), rng.integers(0, 6)):
            data[at] = rng.integers(256)
        source.receive(bytes(data), ("x", k % 3))
    source.close()
    assert sum(box.refused.values()) > 1500
    for line in box.take().values():
        for _, packet in line:
            assert np.isfinite(packet.root_pos).all() and np.isfinite(packet.rot).all()


def test_models_without_optional_bones_are_known() -> None:
    whole = standard()
    few = skeleton_of({n: whole.offsets[whole.index(n)] for n in NEEDED})
    assert len(few) == len(NEEDED) and few.parents[few.index("LeftUpperArm")] == few.index("Spine")
    with refused("joint-missing"):
        skeleton_of({"Hips": np.zeros(3)})
