"""Flight is told by gravity, hovering is not flight, and a wrong frame rate shows in the fall."""

from __future__ import annotations

import json
import math

import mujoco
import numpy as np
import pytest
import torch

from poise.body import generate_table, make_humanoid
from poise.kin import Kinematics, clip_to_qpos, examine, find_guesses, fit_ground, fit_humanoid
from poise.kin.flight import Flight, find_flights, likely_rate, rate_sentence
from poise.kin.ground import clip_flights
from poise.kin.solids import centre_of_mass
from poise.motion import Clip, read_clip
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
    state = Kinematics(TABLE)(torch.tensor(data.qpos))
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
    assert likely_rate(find_flights(height, upright(height), 60.0), 60.0) is None


def test_a_slow_arc_that_leads_aside_is_no_flight():
    """A vault over hands, a ride: gravity pulls straight down."""
    height, t = leap(120.0), np.arange(241) / 60.0
    com = upright(height)
    assert likely_rate(find_flights(height, com, 60.0), 60.0) == 120.0
    com[:, 0] += t**2 / 2
    assert find_flights(height, com, 60.0) == ()
    # One that falls as fast as it should stays a flight, which judges no rate.
    com[:, 0] += 3 * t**2 / 2
    (flight,) = find_flights(height, com, 120.0)
    assert flight.aside == pytest.approx(16 / 9.81) and likely_rate((flight,), 1200.0) is None


@pytest.mark.parametrize(
    ("factor", "rate"), [(1.0, None), (2.0, 60.0), (4.0, 30.0), (0.5, 240.0), (0.75, None)]
)
def test_a_clip_played_too_fast_or_too_slow_is_told(factor, rate):
    clip = raised(swing(2.0, 120.0 / factor), leap(120.0 / factor)).replaced(fps=120.0)
    flights = clip_flights(clip, TABLE)
    assert likely_rate(flights, 120.0) == rate
    said = rate_sentence(flights, 120.0)
    if rate is None:
        assert said is None
    else:
        assert said is not None and f"{factor**2:.3g} times gravity" in said
        assert ("too slow" in said) == (factor < 1)
        assert said.endswith(f"state it with --fps {rate:g}.")


def test_a_rough_parabola_is_no_judge():
    assert likely_rate((Flight(10, 30, 40.0, 0.012),), 120.0) is None
    assert likely_rate((), 120.0) is None


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
    ("name", "rate"), [("90_08", 60.0), ("90_11", 60.0), ("90_05", None), ("05_06", None)]
)
def test_gravity_tells_the_rate_of_real_clips(data_dir, name, rate):
    folder = data_dir / "cmu_amc/rfc"
    clip = read_clip(folder / f"{name}.amc", skeleton=folder / "08.asf")
    *_, report = fit_humanoid(clip)
    assert likely_rate(report.clips[0].flights, clip.fps) == rate
    assert any("times gravity" in s for s in report.sentences()) == (rate is not None)


@pytest.mark.parametrize(
    ("name", "stated", "rate"),
    [
        ("cmu_amc/rfc/90_05.amc", 60.0, 120.0),
        ("cmu_amc/rfc/90_05.amc", 30.0, 120.0),
        ("cmu_amc/rfc/90_08.amc", 60.0, None),
        ("cmu_amc/02/02_04.amc", 60.0, 120.0),
        ("deepmimic_txt/humanoid3d_spinkick.txt", 30.0, 60.0),
        ("deepmimic_txt/humanoid3d_cartwheel.txt", None, None),
        ("cmu_bvh/acrnn_indian/07.bvh", None, None),
        ("cmu_amc/07/07_11.amc", None, None),
    ],
)
def test_gravity_tells_slow_motion_of_real_clips(data_dir, name, stated, rate):
    skeleton = data_dir / "cmu_amc/rfc/08.asf" if "/rfc/" in name else None
    clip = read_clip(data_dir / name, skeleton=skeleton)
    clip = clip.replaced(fps=stated or clip.fps)
    faults = [f for f in examine(clip).faults if f.kind == "frame rate"]
    assert [f.size for f in faults] == ([] if rate is None else [rate])
    (told,) = [g for g in find_guesses(clip) if g.what == "fps"]
    assert (f"--fps {rate or 0:g}" == told.override) == (rate is not None)


@pytest.mark.parametrize(
    "name", ["cmu_amc/01/01_01.amc", "cmu_amc/02/02_04.amc", "deepmimic_txt/humanoid3d_jump.txt"]
)
def test_real_jumps_fall_with_gravity(data_dir, name):
    clip = read_clip(data_dir / name)
    flights = clip_flights(clip, generate_table(clip.skeleton, None, [clip]))
    assert flights and np.median([f.fall for f in flights]) == pytest.approx(9.81, rel=0.05)
