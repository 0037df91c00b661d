"""Foreign cases: what is asked for is in the tables, and only that; expectations by definition."""

import json

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import nominal_rate_hz, read_flight_table
from tests.benchmarks.foreign_aircraft import AIRPLANES, kit_states
from tests.benchmarks.foreign_flights import (
    EFFECTS,
    IN_CATALOGUE,
    NOISES,
    OUTSIDE,
    effects_of,
    make_case,
    write_cases,
)

SHORT = {"seconds": (25.0, 25.0), "missing": 0.0, "outliers": 0.0}


def true_poses(case, which=1):
    """Positions and angles of the rows as they were."""
    return kit_states(case.true_states[which])


def test_the_catalogue_is_covered_and_something_lies_outside_it():
    """Every effect that the kit names, the others by names that it does not have."""
    assert set(IN_CATALOGUE) == {effect.name for effect in CATALOGUE}
    assert len(OUTSIDE) >= 4
    assert not set(OUTSIDE) & set(IN_CATALOGUE)


def test_there_are_aircraft_of_every_size_and_of_every_set_of_controls():
    """30 g to 25 kg, 3 to 27 m/s, one without ailerons, one without rudder, one with tables."""
    masses = [airplane.body.mass for airplane in AIRPLANES.values()]
    assert (min(masses), max(masses)) == (0.030, 25.0)
    controls = {airplane.controls for airplane in AIRPLANES.values()}
    assert (True, False, True, True) in controls
    assert (True, True, True, False) in controls
    assert any(airplane.tables is not None for airplane in AIRPLANES.values())
    assert "aileron_loss" not in effects_of("slow_flyer")
    assert "rudder_roll" not in effects_of("zagi")
    assert all(AIRPLANES[name].source for name in AIRPLANES)


@pytest.mark.parametrize("aircraft", AIRPLANES)
def test_every_aircraft_flies_a_usable_baseline(aircraft):
    """It stays up, turns both ways, moves every control it has and no other."""
    case = make_case(aircraft, "none", 3)
    p_world, angles = true_poses(case, 0)
    speed = np.linalg.norm(np.gradient(p_world, case.calm.t, axis=0), axis=1)
    assert p_world[:, 2].min() > 0.0
    assert speed.mean() == pytest.approx(AIRPLANES[aircraft].speed, rel=0.15)
    assert angles[:, 0].min() < -0.2 < 0.2 < angles[:, 0].max()
    for stick, there in zip(case.calm.commands.T, AIRPLANES[aircraft].controls, strict=True):
        assert (stick.std() > 0.02) == there
        assert there or not stick.any()


def test_the_same_seed_gives_the_same_case_and_another_another():
    """Nothing is drawn outside the seed."""
    one, same, other = (make_case("cub", "wind", seed, **SHORT) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one.flight.p_world, same.flight.p_world)
    assert one.truth == same.truth
    assert one.truth["size"] != other.truth["size"]


def test_noise_missing_poses_and_rate_are_as_asked():
    """Standard deviations within 5 % of some 2000 values each, 30 % of the rows without a pose."""
    case = make_case(
        "navion", "none", 1, noise="gps", rate_hz=50.0, seconds=(25.0, 40.0), missing=0.3,
        outliers=0.0,
    )  # fmt: skip
    p_world, angles = true_poses(case)
    seen = case.flight.has_pose
    assert nominal_rate_hz(case.flight) == pytest.approx(50.0)
    assert np.mean(~seen) == pytest.approx(0.3, abs=0.04)
    sigma = NOISES["gps"]
    assert np.std((case.flight.p_world - p_world)[seen]) == pytest.approx(sigma[0], rel=0.05)
    off = np.angle(np.exp(1j * (case.flight.attitude - angles)[seen]))
    assert np.std(off) == pytest.approx(sigma[1], rel=0.05)


def test_correlated_noise_is_correlated():
    """Half the variance AR(1) with 0.5 s: neighbours at 20 Hz correlate by exp(-0.1) / 2 = 0.45."""
    case = make_case("cub", "none", 2, correlated=True, seconds=(25.0, 120.0), missing=0.0,
                     outliers=0.0)  # fmt: skip
    error = case.flight.p_world - true_poses(case)[0]
    together = np.mean([np.corrcoef(e[1:], e[:-1])[0, 1] for e in error.T])
    assert together == pytest.approx(0.45, abs=0.06)
    assert error.std() == pytest.approx(NOISES["marker"][0], rel=0.1)


def test_tilted_and_moved_cameras_and_late_stamps_change_the_poses_only():
    """Turned up by 0.1 rad, level flight reads 0.1 rad more pitch; moved 0.3 m to the nose, it
    reads 0.3 m further along the heading; 0.1 s late, the place of 0.1 s ago.
    """
    quiet = {**SHORT, "noise": "mocap"}
    plain = make_case("aerosonde", "none", 6, **quiet)
    tilted = make_case(
        "aerosonde", "camera_tilt", 6, size={"tilt_pitch": 0.1, "tilt_roll": 0.0}, **quiet
    )
    np.testing.assert_array_equal(tilted.flight.commands, plain.flight.commands)
    level = np.abs(true_poses(plain)[1][:, 0]) < 0.05
    more = (tilted.flight.attitude - true_poses(tilted)[1])[level, 1]
    assert more.mean() == pytest.approx(0.1, abs=0.002)
    forward = {"camera_forward": 0.3, "camera_right": 0.0, "camera_down": 0.0}
    ahead = make_case("aerosonde", "camera_offset", 6, size=forward, **quiet)
    shift = (ahead.flight.p_world - true_poses(ahead)[0])[level]
    heading = true_poses(ahead)[1][level, 2]
    along = shift[:, 0] * np.cos(heading) - shift[:, 1] * np.sin(heading)
    assert along.mean() == pytest.approx(0.3, abs=0.01)
    late = make_case("aerosonde", "time_offset", 6, size={"late": 0.1}, **quiet)
    was = true_poses(late)[0]
    np.testing.assert_allclose(late.flight.p_world[2:, 0], was[:-2, 0], atol=0.02)  # 2.5 m on


def test_a_delay_is_a_delay():
    """With 0.1 s more the aircraft flies as with its sticks two rows later: what was delayed is
    found again as the shift where roll rate and aileron correlate best.
    """

    def lag(case):
        p = case.true_states[1][:, 10]
        stick = case.flight.commands[:, 1]
        shifts = np.arange(0, 12)
        match = [np.corrcoef(stick[: len(p) - s or None], p[s:])[0, 1] for s in shifts]
        return shifts[int(np.argmax(match))]

    none = make_case("navion", "none", 8, noise="mocap", seconds=(25.0, 60.0))
    late = make_case(
        "navion", "control_delay", 8, noise="mocap", seconds=(25.0, 60.0), size={"delay_added": 0.2}
    )
    assert 3 <= lag(late) - lag(none) <= 5


@pytest.mark.parametrize(
    ("effect", "parameter"),
    [("wind", "wind_x"), ("mass_change", "mass_added"), ("thrust_loss", "thrust_lost")],
)
def test_the_answer_is_in_the_kits_units(effect, parameter):
    """Names as in the catalogue's parameters, values as in the simulator."""
    case = make_case("cub", effect, 1, **SHORT)
    names = {p.name for e in CATALOGUE if e.name == effect for p in e.parameters}
    assert set(case.truth["kit"]) <= names
    assert case.truth["kit"][parameter] in case.truth["size"].values()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_wind_blows_where_the_answer_says(seed):
    """Galilei: air velocity is ground velocity less the wind. The autopilot holds the airspeed, so
    it spreads less with this wind than with either of its components reversed, or with none.
    """
    case = make_case("cub", "wind", seed, **SHORT)
    p_world, _ = true_poses(case)
    ground = np.gradient(p_world, case.flight.t, axis=0)
    wind = np.array([case.truth["kit"]["wind_x"], case.truth["kit"]["wind_y"], 0.0])
    spread = {
        signs: np.linalg.norm(ground - wind * [*signs, 0.0], axis=1).std()
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0))
    }
    assert min(spread, key=spread.get) == (1, 1)


def test_an_onset_leaves_the_time_before_alone():
    """The same seed flies the same until the onset."""
    calm = make_case("navion", "none", 9, noise="mocap", **SHORT)
    later = make_case(
        "navion", "extra_drag", 9, noise="mocap", onset=15.0, size={"CD_added": 0.03}, **SHORT
    )
    before, after = calm.flight.t < 14.9, calm.flight.t > 18.0
    np.testing.assert_allclose(
        later.true_states[1][before, :3], calm.true_states[1][before, :3], atol=1e-6
    )
    apart = later.true_states[1][after, :3] - calm.true_states[1][after, :3]
    assert np.abs(apart).max() > 0.1


def test_unknown_names_are_refused_with_what_there_is():
    """One sentence with the way out."""
    with pytest.raises(InputError, match="expected one of aerosonde"):
        make_case("concorde")
    with pytest.raises(InputError, match="slow_flyer can have"):
        make_case("slow_flyer", "aileron_loss")
    with pytest.raises(InputError, match="expected one of mocap"):
        make_case("cub", noise="radar")


def test_cases_are_written_as_a_user_has_them(tmp_path):
    """Two tables that the kit reads without a warning, three keys of an airframe, the answer."""
    case = make_case("zagi", "wind+flap", 2, **SHORT)
    write_cases(tmp_path, {"one": case})
    table = read_flight_table(tmp_path / "one" / "flight.csv")
    np.testing.assert_allclose(table.p_world, case.flight.p_world, atol=1e-4)
    assert not table.warnings
    keys = [
        line.split(" = ")[0]
        for line in (tmp_path / "one" / "airframe.toml").read_text().splitlines()
    ]
    assert keys == ["mass_g", "wing_area_m2", "span_m"]
    truth = json.loads((tmp_path / "truth.json").read_text())["one"]
    assert truth["effect"] == "wind+flap"
    assert {"wind_x", "wind_y", "flap_lift", "flap_drag"} == set(truth["kit"])


def test_every_effect_changes_a_flight():
    """Flights of one seed are the same to the last bit unless something is hidden in them."""
    plain = make_case("navion", "none", 11, **SHORT)
    for effect in EFFECTS:
        if effect in ("none", "stall", "ground_effect"):
            continue  # these need slow or low flight, which a short one may lack
        case = make_case("navion", effect, 11, strength=0.5, **SHORT)
        assert any(case.truth["size"].values()), effect
        assert case.truth["attempts"] == plain.truth["attempts"] == 1, effect
        np.testing.assert_array_equal(case.calm.p_world, plain.calm.p_world)
        apart = np.abs(case.flight.p_world - plain.flight.p_world).max()
        turned = np.abs(case.flight.attitude - plain.flight.attitude).max()
        assert max(apart, turned) > 0.01, effect


def test_jsbsim_flies_along():
    """The aircraft of the other simulator, with its own effects; what it cannot do is refused."""
    assert "gust_field" in effects_of("jsbsim")
    case = make_case("jsbsim", "wind", 3, seconds=(20.0, 20.0))
    assert case.truth["airframe"]["mass_g"] == pytest.approx(150.0)
    assert set(case.truth["kit"]) == {"wind_x", "wind_y"}
    with pytest.raises(InputError, match="missing: expected only"):
        make_case("jsbsim", "wind", 3, missing=0.3)
