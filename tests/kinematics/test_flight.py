"""Flight is told by gravity, hovering is not flight, and a wrong frame rate shows in the fall."""

from __future__ import annotations

import json
import math

import mujoco
import numpy as np
import pytest

from poise.body import generate_table, make_humanoid
from poise.formats import read_clip
from poise.kinematics import Kinematics, clip_to_qpos, fit_ground, fit_humanoid
from poise.kinematics.forward import centre_of_mass, low_and_com, poses_of
from poise.kinematics.rate import Flight, clear_fall, find_flights
from poise.motion import Clip
from toy_human import human, swing

TABLE = generate_table(human())


def leap(fps: float = 60.0, gravity: float = 9.81) -> np.ndarray:
    """Height (m) over two seconds: half a second in the air from one second on."""
    t = np.arange(round(2 * fps) + 1) / fps - 1.0
    return np.where((t > 0) & (t < 0.5), gravity * t * (0.5 - t) / 2, 0.0)


def upright(height: np.ndarray) -> np.ndarray:
    """The centre of mass of a body that rises and falls with its lowest point."""
    return np.stack((0 * height, 0 * height, height + 1.0), -1)


def raised(clip: Clip, height: np.ndarray) -> Clip:
    path = clip.root_pos.copy()
    path[:, 2] += height
    return clip.replaced(root_pos=path)


@pytest.fixture(scope="module")
def still() -> np.ndarray:
    """Two seconds of a still stance on the floor at 60 Hz."""
    qpos = np.repeat(clip_to_qpos(swing(), TABLE)[:1], 121, 0)
    qpos[:, 7:] = 0.0
    return fit_ground(qpos, TABLE, 60.0)[0]


def test_the_centre_of_mass_is_mujocos():
    humanoid = make_humanoid(human(), TABLE)
    data = mujoco.MjData(humanoid.model)
    rng = np.random.default_rng(0)
    data.qpos[:] = rng.standard_normal(humanoid.model.nq)
    mujoco.mj_normalizeQuat(humanoid.model, data.qpos)
    mujoco.mj_forward(humanoid.model, data)
    state = Kinematics(TABLE)(data.qpos)
    np.testing.assert_allclose(
        centre_of_mass(TABLE, state.pos, state.quat), data.subtree_com[1], atol=1e-9
    )


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_a_leap_is_a_flight_that_falls_with_g(fps):
    height = leap(fps)
    (flight,) = find_flights(height, upright(height), fps)
    assert flight.fall == pytest.approx(9.81) and flight.rms_m < 1e-9
    # The lowest 6 cm at both ends are not seen.
    assert fps < flight.start <= 1.05 * fps + 1 and 1.44 * fps <= flight.stop < 1.5 * fps


def test_a_slow_rise_and_a_short_hop_are_no_flights():
    slow = 0.3 * np.sin(np.linspace(0, np.pi, 121)) ** 2
    assert find_flights(slow, upright(slow), 60.0) == ()
    hop = np.zeros(121)
    hop[60:63] = 0.1
    assert find_flights(hop, upright(hop), 60.0) == ()


@pytest.mark.parametrize("seconds", [0.8, 1.2, 2.0])
@pytest.mark.parametrize("metres", [0.09, 0.15, 0.2, 0.3, 0.5])
def test_a_body_that_is_lifted_and_put_down_is_no_slow_flight(metres, seconds):
    height = np.zeros(300)
    frames = round(60 * seconds)
    height[100 : 100 + frames] = metres * np.hanning(frames)
    fall = clear_fall(find_flights(height, upright(height), 60.0))
    assert fall is None or 9.81 / 2 < fall < 2 * 9.81


def test_a_slow_arc_that_leads_aside_is_no_flight():
    """A vault over hands, a ride: gravity pulls straight down."""
    height, t = leap(120.0), np.arange(241) / 60.0
    com = upright(height)
    assert clear_fall(find_flights(height, com, 60.0)) == pytest.approx(9.81 / 4)
    com[:, 0] += t**2 / 2
    assert find_flights(height, com, 60.0) == ()
    # One that falls as fast as it should stays a flight, which judges no rate.
    com[:, 0] += 3 * t**2 / 2
    (flight,) = find_flights(height, com, 120.0)
    assert flight.aside == pytest.approx(16 / 9.81) and clear_fall((flight,)) is None


def arc(fps: float, high: float, frames: int, off: float = 0.0) -> np.ndarray:
    """A parabola of `frames` in the air that rises `high` m with 4 g, `off` m of a wave on it."""
    u = np.linspace(-1, 1, frames)
    return np.concatenate((np.zeros(60), high * (1 - u * u) + off * np.sin(9 * u), np.zeros(60)))


def test_a_parabola_is_judged_by_its_rise():
    """2 cm of error are much in a hop and little in a flip."""
    flip, hop = arc(120.0, 0.8, 48, 0.032), arc(120.0, 0.2, 24, 0.032)
    (flight,) = find_flights(flip, upright(flip), 120.0)
    assert 0.02 < flight.rms_m < 0.05 * flight.rise_m and flight.clear
    assert flight.top == pytest.approx(0.5, abs=0.05)
    assert not any(f.clear for f in find_flights(hop, upright(hop), 120.0))


def test_the_ends_of_a_flight_are_left_out():
    """Feet that still push bend the path there."""
    height = arc(120.0, 0.5, 50)
    pushed = upright(height)
    pushed[62:66, 2] += (0.06, 0.05, 0.03, 0.01)
    (flight,) = find_flights(height, pushed, 120.0)
    (free,) = find_flights(height, upright(height), 120.0)
    assert flight.fall == pytest.approx(free.fall, rel=0.02) and flight.clear


def test_high_flights_weigh_more():
    low = [Flight(0, 30, 39.0, 0.0, rise_m=0.1), Flight(40, 60, 40.0, 0.0, rise_m=0.1)]
    assert clear_fall([*low, Flight(80, 130, 9.8, 0.0, rise_m=0.3)]) == 9.8
    assert clear_fall([*low, Flight(80, 130, 9.8, 0.0, rise_m=0.3, top=0.9)]) == 39.0
    assert clear_fall([Flight(0, 5, 39.0, 0.0, rise_m=0.1)]) is None and clear_fall([]) is None


def test_hovering_without_falling_is_lowered(still):
    hover = still.copy()
    hover[40:90, 2] += 0.09 * np.hanning(50)
    out, fit = fit_ground(hover, TABLE, 60.0)
    assert fit.flights == () and 0.03 < fit.settle_m.max() < 0.06
    # Never below the floor, and less of it is left.
    assert fit.after_m == pytest.approx(0.0, abs=1e-9) and fit.clear_m.max() == 0.0
    np.testing.assert_allclose(out[:, 2], (hover[:, 2] - fit.settle_m) + fit.lift_m, atol=1e-12)
    assert "hovered without falling" in fit.sentence()
    assert np.abs(np.diff(fit.settle_m)).max() < 0.005


def test_a_leap_is_not_lowered(still):
    jump = still.copy()
    jump[:, 2] += leap()
    out, fit = fit_ground(jump, TABLE, 60.0)
    np.testing.assert_allclose(out, jump, atol=1e-9)
    assert len(fit.flights) == 1 and fit.settle_m.max() == 0.0
    assert fit.to_dict()["flight_frames"] == fit.flights[0].stop - fit.flights[0].start + 1


def test_who_stands_on_something_stays_there(still):
    box = still.copy()
    box[30:90, 2] += 0.3
    np.testing.assert_allclose(fit_ground(box, TABLE, 60.0)[0], box, atol=1e-9)


def test_a_clip_8_cm_under_the_floor_comes_up():
    clip = swing(1.0, 60.0, speed=1.0)
    _, (right,), _ = fit_humanoid(clip, None, 60.0)
    _, (lifted,), report = fit_humanoid(raised(clip, np.full(clip.frames, -0.08)), None, 60.0)
    np.testing.assert_allclose(lifted, right, atol=1e-9)
    assert report.clips[0].ground.to_dict()["lowest_after_m"] > -0.0201


def test_an_impossible_range_is_widened_and_said():
    clip = swing(1.0, 60.0)
    knee = human().index("LeftLeg")
    rot = clip.rot.copy()
    angle = math.radians(130.0) * np.sin(np.linspace(0, np.pi, clip.frames)) / 2
    rot[:, knee] = np.stack((np.cos(angle), 0 * angle, np.sin(angle), 0 * angle), 1)
    humanoid, (qpos,), report = fit_humanoid(clip.replaced(rot=rot), None, 60.0)
    low, high = np.array([r for row in humanoid.table.rows for r in row.ranges]).T
    assert (qpos[:, 7:] > low + math.radians(9.9)).all() and (qpos[:, 7:] < high - 0.17).all()
    assert max(g for n, g in report.widened if n.startswith("LeftLeg")) == pytest.approx(50, abs=1)
    assert any("were widened" in s for s in report.sentences())


def test_the_report_is_plain_numbers():
    *_, report = fit_humanoid(swing(1.0, 60.0, speed=1.0))
    said = json.loads(json.dumps(report.to_dict()))
    clip = said["clips"]["swing"]
    assert clip["flips"] == clip["speeds"] == clip["left"] == [] and clip["likely_fps"] is None
    assert set(clip["ground"]) >= {"lift_m", "clear_max_m", "settle_max_m", "flight_frames"}


def test_a_cycle_whose_closing_bends_it_into_the_floor_is_played_once(data_dir):
    clip = read_clip(data_dir / "deepmimic_txt/humanoid3d_crawl.txt")
    _, _, report = fit_humanoid(clip)
    assert report.cyclic == (False,) and report.clips[0].cycle is not None
    assert report.clips[0].cycle.sunk_m > 0.1 and "cm into the floor" in report.clips[0].cycle.sentence()
    assert abs(report.clips[0].ground.lift_m) < 0.05


@pytest.mark.parametrize(
    "name", ["cmu_amc/01/01_01.amc", "cmu_amc/02/02_04.amc", "deepmimic_txt/humanoid3d_jump.txt"]
)
def test_real_jumps_fall_with_gravity(data_dir, name):
    clip = read_clip(data_dir / name)
    table = generate_table(clip.skeleton, None, [clip])
    flights = find_flights(*low_and_com(table, *poses_of(clip, table)), clip.fps)
    assert flights and np.median([f.fall for f in flights]) == pytest.approx(9.81, rel=0.05)
