"""Online filter: equal to least squares where all is linear, blind to what it must leave out, and
the same whether a pose comes in time or late.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.estimate import SimulatedAircraft
from falconwing_kit.core.frames import GRAVITY, camera_pose
from falconwing_kit.core.messages import State
from falconwing_kit.vision.online_filter import (
    AircraftProcess,
    FilterSettings,
    OnlineFilter,
)

DT, DELAY = 0.05, 0.05
MOUNT = np.array([0.2, 0.05, -0.03])
V_BODY = np.array([7.0, 0.0, 0.3])
COVARIANCE = np.diag([0.2, 0.25, 0.1, 0.02, 0.02, 0.03]) ** 2


@pytest.fixture
def rng():
    return np.random.default_rng(18)


@dataclass
class Pose:
    T_world_camera: np.ndarray
    covariance: np.ndarray


class ConstantVelocity:
    """A linear process: the place moves with the velocity, all else stays."""

    parameter_sigmas = np.zeros(0)

    def advance(self, t, t_end, x):
        after = x.copy()
        after[:3] += (t_end - t) * x[6:9]
        return after


def pose_of(x, mount=MOUNT, covariance=COVARIANCE, noise=None):
    """The camera's pose of a state (12,), with noise (6,) added to x y z roll pitch yaw."""
    x = np.array(x)
    if noise is not None:
        x[:3] += noise[:3]
        x[[5, 3, 4]] += noise[3:]
    T_world_body = State.from_vector(x).pose.T_world_body
    return Pose(camera_pose(T_world_body, mount), covariance)


def flown(rng, steps=50):
    """A flight of the kit's aircraft with random controls: states (steps + 1, 12), commands."""
    steady = trim(rates_model(), 7.0)
    commands = steady.command + np.repeat(0.15 * rng.normal(size=(steps // 4 + 1, 4)), 4, axis=0)
    start = steady.state.copy()
    start[:3], start[4] = (-18.0, -2.0, 1.5), 0.2
    aircraft = SimulatedAircraft(rates_model(), State.from_vector(start), DELAY)
    states = [aircraft.x]
    for k in range(steps):
        aircraft.send(k * DT, commands[k])
        aircraft.advance((k + 1) * DT)
        states.append(aircraft.x)
    return np.array(states), commands


class Flight:
    """A filter that is given poses of a flight, one step after the other."""

    def __init__(self, commands, settings=None, level=None):
        self.process, self.commands = AircraftProcess(rates_model(), DELAY, level), commands
        self.filter = OnlineFilter(self.process, V_BODY, MOUNT, settings)
        self.k = -1

    def step(self, *poses):
        """One step of 50 ms with pairs (step of the image, pose); returns why each was left out."""
        self.k += 1
        if self.k > 0:
            self.process.send((self.k - 1) * DT, self.commands[self.k - 1])
        reasons = [self.filter.fuse(k * DT, pose) for k, pose in poses]
        self.filter.estimate(self.k * DT)
        return reasons

    @property
    def now(self):
        return self.filter.estimate(self.k * DT)


def test_a_linear_case_equals_least_squares(rng):
    """Level, camera at the centre of gravity, constant velocity: the Kalman filter's last estimate
    is the least squares solution of all measurements and all steps at once, solved here in one
    matrix [Simon, Optimal State Estimation, ch. 3 and 5]. One axis.
    """
    settings = FilterSettings(velocity_noise=0.3, correlation=2.0, start_velocity_sigma=1.5)
    filter_ = OnlineFilter(ConstantVelocity(), V_BODY, np.zeros(3), settings)
    n, sigma = 8, 0.2
    measured = np.array([1.0 + 7.0 * k * DT for k in range(n)]) + sigma * rng.normal(size=n)
    for k, px in enumerate(measured):
        x = np.zeros(12)
        x[0] = px
        pose = pose_of(x, np.zeros(3), np.diag([sigma**2] * 3 + [1e-4] * 3))
        assert filter_.fuse(k * DT, pose) == ""
    # Unknown: the first place and the velocity of each step; places follow from them exactly.
    places = np.tri(n, n + 1, 0) * DT
    places[:, 0] = 1.0
    velocities = np.eye(n + 1)[1:]
    changes = np.diff(velocities, axis=0)
    A = np.concatenate([velocities[:1], places, changes])
    right = np.concatenate([[7.0], measured, np.zeros(n - 1)])
    variances = np.repeat([1.5**2, 2.0 * sigma**2, 0.3**2], [1, n, n - 1])
    covariance = np.linalg.inv(A.T @ (A / variances[:, None]))
    solution = covariance @ A.T @ (right / variances)
    last = np.stack([places[-1], velocities[-1]])
    estimate = filter_.estimate((n - 1) * DT)
    # 1e-7: the derivative F is by differences
    assert estimate.x[[0, 6]] == pytest.approx(last @ solution, abs=1e-7)
    found = estimate.P[np.ix_([0, 6], [0, 6])]
    assert found == pytest.approx(last @ covariance @ last.T, abs=1e-7)


def test_the_start_is_the_pose_that_was_seen(rng):
    """Inverse: state -> camera -> state, with a camera beside the centre of gravity; the velocity
    lies along the nose.
    """
    x = np.array([-5.0, 1.0, 2.0, 0.2, -0.4, 0.5, *np.zeros(6)])
    filter_ = OnlineFilter(ConstantVelocity(), V_BODY, MOUNT)
    assert filter_.estimate(0.0) is None
    assert filter_.fuse(0.0, pose_of(x)) == ""
    estimate = filter_.estimate(0.0)
    assert estimate.x[:6] == pytest.approx(x[:6], abs=1e-9)
    R_world_body = State.from_vector(x).pose.T_world_body[:3, :3]
    assert estimate.x[6:9] == pytest.approx(R_world_body @ V_BODY, abs=1e-9)


def test_the_start_has_the_covariance_of_the_pose(rng):
    """Monte Carlo: poses with the stated noise in world axes (times two for correlation) scatter
    the start as its P says. A camera 1.5 m ahead, so that its attitude moves the aircraft more than
    its place does. 4,000 draws: 2.2 % of a variance, allowed 12 %.
    """
    from scipy.spatial.transform import Rotation

    x = np.array([-5.0, 1.0, 2.0, 0.2, -0.4, 0.5, *np.zeros(6)])
    ahead, covariance = np.array([1.5, 0.4, -0.3]), np.diag([0.02] * 3 + [0.03, 0.02, 0.04]) ** 2
    T, found = pose_of(x, ahead).T_world_camera, []
    for _ in range(4000):
        noise = np.sqrt(2.0) * rng.multivariate_normal(np.zeros(6), covariance)
        noisy = T.copy()
        noisy[:3, 3] += noise[:3]
        noisy[:3, :3] = Rotation.from_rotvec(noise[3:]).as_matrix() @ T[:3, :3]
        filter_ = OnlineFilter(ConstantVelocity(), V_BODY, ahead)
        filter_.fuse(0.0, Pose(noisy, covariance))
        found.append(filter_.estimate(0.0).x[:6])
    filter_ = OnlineFilter(ConstantVelocity(), V_BODY, ahead)
    filter_.fuse(0.0, Pose(T, covariance))
    P = filter_.estimate(0.0).P[:6, :6]
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    assert np.abs((np.cov(np.array(found).T) - P) / scale).max() < 0.12


def test_late_poses_give_the_same_estimate_as_poses_in_time(rng):
    """The same poses, in time; two steps late; and late by one to three steps in a changed order.
    To rounding: the filter computes the same from the same, whenever it arrives.
    """
    states, commands = flown(rng)
    poses = [
        pose_of(x, noise=rng.multivariate_normal(np.zeros(6), 0.5 * COVARIANCE)) for x in states
    ]
    in_time, late, mixed = Flight(commands), Flight(commands), Flight(commands)
    for k in range(40):
        in_time.step(*([(k, poses[k])] if k < 37 else []))
        late.step(*([(k - 2, poses[k - 2])] if 2 <= k < 39 else []))
        # 0, then 2 1 4 3 6 5 ...: every second pose is overtaken by the next
        order = k - 2 + (1 if (k - 2) % 2 else -1)
        due = 0 if k == 2 else order
        mixed.step(*([(due, poses[due])] if k >= 2 and 0 <= due < 37 else []))
    for other in (late, mixed):
        assert np.abs(other.now.x - in_time.now.x).max() < 1e-10
        assert np.abs(other.now.P - in_time.now.P).max() < 1e-10


def test_a_late_pose_taken_for_a_present_one_is_worse(rng):
    """What the time stamp is for: at 7 m/s, 0.1 s are 0.7 m. The same exact poses, two steps late,
    fused at their own time and at their arrival.
    """
    states, commands = flown(rng)
    stamped, unstamped = Flight(commands), Flight(commands)
    for k in range(2, 40):
        pose = pose_of(states[k - 2])
        if k == 2:
            stamped.k = unstamped.k = 1
        stamped.step((k - 2, pose))
        unstamped.step((k, pose))
    assert np.linalg.norm(stamped.now.x[:3] - states[39, :3]) < 0.05
    assert np.linalg.norm(unstamped.now.x[:3] - states[39, :3]) > 0.4


def test_the_estimate_is_better_than_its_poses(rng):
    """Root mean square over a flight against the poses' noise; velocities, which no pose holds, to
    0.6 m/s of 7.
    """
    states, commands = flown(rng)
    flight, errors = Flight(commands), []
    for k in range(50):
        noise = rng.multivariate_normal(np.zeros(6), COVARIANCE)
        flight.step((k, pose_of(states[k], noise=noise)))
        errors.append(flight.now.x[:12] - states[k])
    rms = np.sqrt(np.mean(np.square(errors[10:]), axis=0))
    assert (rms[:3] < 0.75 * np.sqrt(np.diag(COVARIANCE)[:3])).all()
    assert (rms[6:9] < 0.6).all()


def test_the_covariance_stays_symmetric_and_positive(rng):
    """A covariance is both; over poses, wild poses, gaps and inflated ones."""
    states, commands = flown(rng)
    flight = Flight(commands)
    for k in range(50):
        noise = rng.multivariate_normal(np.zeros(6), COVARIANCE) * (8.0 if k % 7 == 3 else 1.0)
        flight.step(*([(k, pose_of(states[k], noise=noise))] if k % 11 < 8 else []))
        P = flight.now.P
        assert np.abs(P - P.T).max() < 1e-9 * P.max()
        assert np.linalg.eigvalsh(P).min() > 0.0


def test_the_effectiveness_of_the_controls_is_found(rng):
    """The aircraft flies level + e (u - level) of each command u that the filter is given, e = 2.5,
    0.6 and 1.8; with e = 1 all stay near one. Poses have noise, the model has no other error.
    Within 10 % after four seconds, the rudder's, which moves the aircraft least, within 30 %.
    """
    level, settings = trim(rates_model(), 7.0).command, FilterSettings(rate_noise=0.1)
    for e in (np.array([1.0, 2.5, 0.6, 1.8]), np.ones(4)):
        states, acting = flown(rng, steps=80)
        flight = Flight(level + (acting - level) / e, settings, level)
        for k in range(80):
            noise = rng.multivariate_normal(np.zeros(6), 0.1**2 * COVARIANCE)
            flight.step((k, pose_of(states[k], covariance=0.1**2 * COVARIANCE, noise=noise)))
        found = np.exp(flight.now.x[12:15])
        assert found[:2] == pytest.approx(e[1:3], rel=0.1)
        assert found[2] == pytest.approx(e[3], rel=0.3)


def test_the_unmodelled_acceleration_acts_along_the_body():
    """Added to a flight of 1 ms, turned by hand: nose, right wing and belly in the world, where x
    is forward, y left and z up. At another speed it goes with the speed squared.
    """
    roll, pitch, yaw = 0.5, 0.1, 0.8
    nose = [np.cos(pitch) * np.cos(yaw), -np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
    level_right = np.array([-np.sin(yaw), -np.cos(yaw), 0.0])
    right = np.cos(roll) * level_right + np.sin(roll) * np.cross(nose, level_right)
    belly = np.cross(nose, right)
    for speed in (7.0, 3.5):
        x = np.zeros((17, 2))
        x[:12, :] = trim(rates_model(), 7.0).state[:, None]
        x[3:6] = np.array([[pitch], [yaw], [roll]])
        x[6:9] = speed * np.array(nose)[:, None]
        x[15:, 1] = 1.0, -2.0
        after = AircraftProcess(rates_model(), DELAY).advance(0.0, 0.001, x)
        expected = right - 2.0 * belly
        expected *= (speed / 7.0) ** 2
        added = after[:, 1] - after[:, 0]
        assert added[6:9] / 0.001 == pytest.approx(expected, abs=0.02)
        assert added[:3] / (0.5 * 0.001**2) == pytest.approx(expected, abs=0.02)
        assert (after[12:] == x[12:]).all()


def test_the_lift_that_the_model_leaves_out_is_found(rng):
    """Level flight of an aircraft with 1.25 times the lift coefficients: lift is the weight, of
    which the model has g / 1.25 at that angle of attack. The rest is found within 5 %, and height
    and climb are right. With the acceleration held at zero they stay wrong.
    """
    nominal = rates_model()
    strong = nominal.with_values({k: 1.25 * nominal.values[k] for k in ("cL_0", "cL_alpha")})
    steady = trim(strong, 7.0)
    left_out = GRAVITY * (1.0 - 1.0 / 1.25)
    errors = []
    for settings in (None, FilterSettings(start_parameter_sigma=0.0, parameter_noise=0.0)):
        flight = Flight(np.tile(steady.command, (160, 1)), settings, steady.command)
        for k in range(160):
            x = steady.state.copy()
            x[:3] = -18.0 + k * DT * x[6], -2.0, 1.5
            flight.step((k, pose_of(x)))
        if settings is None:
            assert flight.now.x[16] == pytest.approx(-left_out, rel=0.05)  # along the belly
            assert abs(flight.now.x[15]) < 0.05 * left_out
        errors.append(np.abs(flight.now.x[[2, 8]] - x[[2, 8]]))
    assert (errors[0] < (0.005, 0.01)).all()
    assert (errors[1] > (0.05, 0.1)).all()


def test_a_planted_pose_20_m_off_changes_nothing(rng):
    """Equal to the same flight without it; it states a small sigma, as such a pose did in a photo
    that no training saw (20.7 m off).
    """
    states, commands = flown(rng)
    clean, planted = Flight(commands), Flight(commands)
    for k in range(40):
        pose = pose_of(states[k], noise=rng.multivariate_normal(np.zeros(6), COVARIANCE))
        clean.step(*([] if k == 20 else [(k, pose)]))
        if k == 20:
            pose = pose_of(states[k] + np.array([20.0, *np.zeros(11)]))
        reasons = planted.step((k, pose))
        assert reasons == (["implausible pose"] if k == 20 else [""])
    assert planted.now.x == pytest.approx(clean.now.x, abs=1e-12)


@pytest.mark.parametrize("sigmas", [(1.01, 0.02), (0.2, 0.11)])
def test_a_pose_that_states_a_large_sigma_is_left_out(sigmas):
    """The limits are 1 m and 0.1 rad; inside them the same pose is fused."""
    filter_ = OnlineFilter(ConstantVelocity(), V_BODY, MOUNT)
    covariance = np.diag(np.square(np.repeat(sigmas, 3)))
    assert filter_.fuse(0.0, pose_of(np.zeros(12), covariance=covariance)) == "uncertain pose"
    assert filter_.estimate(0.0) is None
    assert filter_.fuse(0.0, pose_of(np.zeros(12), covariance=0.8 * covariance)) == ""


@pytest.mark.parametrize("damage", ["pose", "covariance", "infinite", "negative", "zero"])
def test_a_pose_that_is_no_pose_is_ignored(rng, damage):
    """Equal to the same flight without it, and finite."""
    states, commands = flown(rng)
    clean, damaged = Flight(commands), Flight(commands)
    for k in range(20):
        pose = pose_of(states[k], noise=rng.multivariate_normal(np.zeros(6), COVARIANCE))
        clean.step(*([] if k == 10 else [(k, pose)]))
        if k == 10:
            T, covariance = pose.T_world_camera.copy(), COVARIANCE.copy()
            T[0, 3] = np.nan if damage == "pose" else T[0, 3]
            covariance[2, 2] = {"covariance": np.nan, "infinite": np.inf, "negative": -1e-3}.get(
                damage, covariance[2, 2]
            )
            pose = Pose(T, 0.0 * COVARIANCE if damage == "zero" else covariance)
        reasons = damaged.step((k, pose))
        assert reasons == (["uncertain pose"] if k == 10 else [""])
    assert np.isfinite(damaged.now.x).all()
    assert damaged.now.x == pytest.approx(clean.now.x, abs=1e-12)


def test_without_poses_it_flies_the_model_and_grows_uncertain(rng):
    """After an exact start the prediction is the flown flight, for the model and commands are the
    same: 1 s later still within the drift of the start's velocity. The variance grows.
    """
    states, commands = flown(rng)
    flight, sigmas = Flight(commands), []
    for k in range(40):
        flight.step(*([(k, pose_of(states[k]))] if k < 20 else []))
        sigmas.append(flight.now.sigma_position)
    assert np.linalg.norm(flight.now.x[:3] - states[39, :3]) < 0.3
    assert (np.diff(sigmas[20:]) > 0.0).all() and sigmas[-1] > 3.0 * sigmas[19]


def test_an_inflated_pose_counts_less(rng):
    """A pose 0.3 m to the left moves the estimate less the larger its factor, and never past it."""
    states, commands = flown(rng)
    moves = []
    for inflation in (1.0, 10.0, 1000.0):
        flight = Flight(commands)
        for k in range(10):
            flight.step((k, pose_of(states[k])))
        before = flight.now.x[1]
        left = states[9] + np.array([0.0, 0.3, *np.zeros(10)])
        assert flight.filter.fuse(9 * DT, pose_of(left), inflation) == ""
        moves.append(flight.now.x[1] - before)
    assert 0.3 > moves[0] > 3.0 * moves[1] > 0.0
    assert moves[1] > 10.0 * moves[2] > 0.0


def test_a_wrong_start_is_corrected_after_ten_rejected_poses(rng):
    """The first pose is 8 m off and states 0.2 m; all others are right. It starts again from the
    eleventh, and is right from then on.
    """
    states, commands = flown(rng)
    flight = Flight(commands)
    flight.step((0, pose_of(states[0] + np.array([8.0, *np.zeros(11)]))))
    reasons = [flight.step((k, pose_of(states[k])))[0] for k in range(1, 30)]
    assert reasons == ["implausible pose"] * 10 + [""] * 19
    assert np.linalg.norm(flight.now.x[:3] - states[29, :3]) < 0.1


def test_a_new_start_keeps_what_was_found_of_the_controls(rng):
    """The aircraft is the same: after ten poses 8 m off, which are rejected, the eleventh of these
    is a new start of the state, not of the process's parameters.
    """
    states, commands = flown(rng)
    level = trim(rates_model(), 7.0).command
    flight = Flight(level + (commands - level) / 2.0, FilterSettings(rate_noise=0.1), level)
    for k in range(30):
        flight.step((k, pose_of(states[k])))
    before = flight.now
    assert before.x[12:14].min() > 0.3
    off = np.array([8.0, *np.zeros(11)])
    for k in range(30, 41):
        flight.step((k, pose_of(states[k] + off)))
    assert np.linalg.norm(flight.now.x[:3] - (states[40] + off)[:3]) < 0.1
    assert flight.now.x[12:] == pytest.approx(before.x[12:], abs=1e-12)
    assert (np.diag(flight.now.P)[12:] > np.diag(before.P)[12:]).all()  # by the noise since


def test_a_pose_from_long_ago_is_late(rng):
    """Half a second is the horizon."""
    states, commands = flown(rng)
    flight = Flight(commands)
    for k in range(30):
        flight.step((k, pose_of(states[k])))
    assert flight.filter.fuse(0.9, pose_of(states[18])) == "late image"
    assert flight.filter.fuse(1.1, pose_of(states[22])) == ""


def test_minutes_without_a_pose_end_the_estimate_not_the_filter(rng):
    """A model left alone for long may leave all finite numbers; then there is no estimate, and the
    next pose starts anew.
    """

    class Diverging:
        parameter_sigmas = np.zeros(0)

        def advance(self, t, t_end, x):
            return x * 1e40

    filter_ = OnlineFilter(Diverging(), V_BODY, MOUNT)
    filter_.fuse(0.0, pose_of(np.ones(12)))
    assert filter_.estimate(2.0) is None
    assert filter_.fuse(2.0, pose_of(np.ones(12))) == ""
    assert filter_.estimate(2.0) is not None
