"""Pilots: the door and its refusals; the pose pilot on poses of a known accuracy, with images that
are missing, late, repeated, damaged, or of nothing.
"""

from dataclasses import dataclass, replace
from importlib.resources import files

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import SAFE_COMMAND, Command, Image, Observation, State
from falconwing_kit.flight import FollowTask, LandingTask, fpv_camera, load_pilot
from falconwing_kit.flight.loop import Loop
from falconwing_kit.flight.pose_pilot import PosePilot
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.vision.online_filter import FilterSettings

CAMERA, MOUNT = fpv_camera(64, 48), np.array([0.20, 0.0, 0.0])
SHIPPED = files("falconwing_kit.data")
SIGMAS = np.array([0.15, 0.15, 0.08, 0.01, 0.01, 0.01])  # about those of the pose network


@dataclass
class Pose:
    T_world_camera: np.ndarray
    covariance: np.ndarray


class KnownPoses:
    """A pose network whose images are numbers: image k shows true pose k, seen with white noise."""

    def __init__(self, seed=0, sigmas=SIGMAS):
        self.rng, self.sigmas, self.states, self.asked = (
            np.random.default_rng(seed), sigmas, [], 0,
        )  # fmt: skip

    def image(self, t, state):
        self.states.append(state)
        number = len(self.states) - 1
        pixels = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
        pixels[:24], pixels[24:] = 4 * (number // 64), 4 * (number % 64)  # survives a JPEG
        return Image(number, t, pixels)

    def estimate(self, image, camera):
        if image.shape != (camera.height, camera.width, 3):
            raise InputError("image: expected the camera's size, got another; scale the camera")
        self.asked += 1
        high, low = (round(float(half.mean()) / 4.0) for half in (image[:20], image[28:]))
        x = self.states[64 * high + low].vector.copy()
        noise = self.sigmas * self.rng.normal(size=6)
        x[:3] += noise[:3]
        x[3:6] += noise[3:]
        T = camera_pose(State.from_vector(x).pose.T_world_body, MOUNT)
        return Pose(T, np.diag(self.sigmas**2))

    def extrapolation(self, p_world_camera):
        return 0.0


class Camera:
    """Images of the true pose; `change` makes of (step, images so far) what the pilot gets."""

    def __init__(self, world, net, change=lambda k, images: images[-1]):
        self.world, self.net, self.change, self.images = world, net, change, []

    def next_image(self, t):
        self.world.advance(t)
        self.images.append(self.net.image(t, self.world.state))
        return self.change(len(self.images) - 1, self.images)


def pose_pilot(net):
    return PosePilot(rates_model(), load_airframe(), LandingPad(), CAMERA, MOUNT, net)


def land(seed, change=lambda k, images: images[-1], states=None):
    """Result of the evaluator, modes, commands, and the estimate's error along the runway, a root
    mean square after the first half second [m].
    """
    task, net = LandingTask(), KnownPoses(seed)
    trial, pilot = task.trial(seed), pose_pilot(net)
    judge, steps = task.judge(trial, CAMERA), []

    def watch(step):
        error = np.nan
        if pilot.state is not None:
            error = pilot.state.p_world[0] - trial.world.state.p_world[0]
        steps.append((step.mode, step.command.vector, error))

    loop = Loop(pilot, trial.world, Camera(trial.world, net, change), states, hooks=[watch])
    flight = loop.run(trial.duration, judge.watch)
    assert flight.faults == 0
    modes, commands, errors = zip(*steps, strict=True)
    rms = np.sqrt(np.nanmean(np.square(errors[10:])))
    return judge.result(), modes, np.array(commands), rms


KNOWN = FilterSettings(start_parameter_sigma=0.0, parameter_noise=0.0)  # looks for no parameter


def land_another(seed, settings, value, **factors):
    """World and pilot after a landing of an aircraft whose values differ from the model's by
    factors, and what `value(world, pilot)` was at each step.
    """
    model, net, values = rates_model(), KnownPoses(seed), []
    other = model.with_values({name: k * model.values[name] for name, k in factors.items()})
    start = LandingTask().trial(seed).world.state
    world = SimulatedWorld(other, load_airframe(), start, seed=seed, pad=LandingPad())
    pilot = PosePilot(model, load_airframe(), LandingPad(), CAMERA, MOUNT, net, settings=settings)
    hook = [lambda step: values.append(value(world, pilot))]
    flight = Loop(pilot, world, Camera(world, net), hooks=hook).run(
        6.0, lambda step: "contact" if world.contact else ""
    )
    assert len(values) == len(flight.t)
    return world, pilot, values


def test_an_aircraft_with_stronger_controls_lands():
    """Ailerons three times and elevator and rudder twice as effective as the model's: the pilot
    finds that, and rolls less and less; one that may not look for it goes on rolling.
    """
    rolls = []
    for settings in (None, KNOWN):
        world, pilot, roll = land_another(
            1, settings, lambda world, pilot: world.state.roll, L_da=3.0, M_de=2.0, N_dr=2.0
        )
        rolls.append(np.degrees(np.abs(roll[50:75])).max())
        if settings is None:
            assert world.contact.obstacle == "pad"
            assert pilot.effectiveness[:2] == pytest.approx([1.0, 3.0], rel=0.15)
    assert rolls[0] < 8.0 and rolls[1] > 20.0


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_an_aircraft_with_other_lift_is_seen_at_its_height(factor):
    """A fifth less or a quarter more lift than the model's: in the last second the height is within
    5 cm on average, and the wheels touch 1.5 to 7 m past the threshold. A pilot that may not look
    for an unmodelled acceleration sees the strong one too low, the weak one too high, by over 5 cm.
    """
    errors = []
    for settings in (None, KNOWN):
        world, _, error = land_another(
            2, settings, lambda world, pilot: pilot.state.p_world[2] - world.state.p_world[2],
            cL_0=factor, cL_alpha=factor,
        )  # fmt: skip
        errors.append(np.mean(error[-20:]))
        if settings is None:
            assert world.contact.obstacle == "pad"
            assert 1.5 < world.contact.touchdown.past_threshold < 7.0
    assert abs(errors[0]) < 0.05
    assert errors[1] * np.sign(1.0 - factor) > 0.05


def fly(pilot, net, images, t0=0.0):
    """Commands and modes of a pilot that is given images one by one, whatever it commands."""
    past, found = np.zeros((30, 4)), []
    for k, image in enumerate(images):
        command = pilot.act(Observation(t0 + 0.05 * k, image, past, None))
        assert np.isfinite(command.vector).all()
        past = np.vstack([past[1:], command.vector])
        found.append((command, pilot.mode))
    return found


def glide(net, n):
    """Images of an aircraft that flies straight and level towards the pad at 7 m/s."""
    x = np.array([-19.0, -2.0, 1.5, 0.05, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return [
        net.image(0.05 * k, State.from_vector(x + np.array([0.35 * k, *np.zeros(11)])))
        for k in range(n)
    ]


@pytest.mark.parametrize("task", ["landing", "follow"])
def test_the_student_is_the_network_of_colours(task):
    """Two names, one file; what sees a mask is another."""
    student = load_pilot("student", task, camera=CAMERA)
    same = load_pilot("rgb", task, camera=CAMERA)
    assert same.policy is student.policy and same.policy.shape.sees == "rgb"
    assert same.policy.shape.memory


def test_pilots_of_masks_see_them():
    """Each by its own file, with a memory."""
    for name in ("mask", "rgb_mask"):
        policy = load_pilot(name, "follow", camera=CAMERA).policy
        assert policy.shape.sees == name and policy.shape.memory


def test_weights_of_a_policy_that_sees_something_else_are_refused():
    """Or a table would name the colours a mask; the student flies by any."""
    weights = SHIPPED / "policy_follow_rgb.safetensors"
    for name in ("mask", "rgb_mask"):
        with pytest.raises(InputError, match=f"sees {name}, got one that sees rgb; fly it by"):
            load_pilot(name, "follow", camera=CAMERA, weights=weights)
    for name in ("rgb", "student"):
        assert load_pilot(name, "follow", camera=CAMERA, weights=weights).policy
    both = SHIPPED / "policy_follow_rgb_mask.safetensors"
    student = load_pilot("student", "follow", camera=CAMERA, weights=both)
    assert student.policy.shape.sees == "rgb_mask"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"name": "autopilot"}, "pilot: expected one of"),
        ({"task": "loop"}, "task: expected one of landing, follow, got 'loop'"),
        ({"scene": "garden"}, "scene: expected one of hall, arena, got 'garden'"),
        ({"task": "follow"}, "flies the task follow, got pose, which does not yet; use expert"),
        ({"scene": "arena"}, "scene: expected hall for pilot pose, got arena"),
        ({"camera": None}, "camera: expected a PinholeCamera"),
        ({"p_body_camera_m": (0.2, 0.0)}, "p_body_camera_m: expected shape"),
        ({"p_body_camera_m": (200.0, 0.0, 0.0)}, "p_body_camera_m: expected metres"),
        ({"p_body_camera_m": (np.nan, 0.0, 0.0)}, "p_body_camera_m: expected metres"),
        ({"name": "expert", "task": "follow"}, "leader: expected the path to follow"),
    ],
)
def test_wrong_arguments_are_one_sentence(words, sentence):
    """At the door, before anything flies."""
    arguments = {"name": "pose", "task": "landing", "scene": "hall", "camera": CAMERA} | words
    with pytest.raises(InputError, match=sentence):
        load_pilot(**arguments)


def test_a_camera_that_sees_less_than_the_network_needs_is_refused():
    """A lens of 20 deg has a fifteenth of the trained field of view."""
    narrow = replace(fpv_camera(160, 120), fx=450.0, fy=450.0)
    with pytest.raises(InputError, match="three quarters of the trained field of view"):
        load_pilot("pose", camera=narrow)


@pytest.mark.parametrize("name", ["expert", "expert_pid"])
def test_an_expert_lands_and_lands_again_after_reset(name):
    """Twice the same flight by one pilot gives the same commands: a reset forgets everything."""
    task, flights = LandingTask(), []
    pilot = load_pilot(name)
    for _ in range(2):
        pilot.reset()
        trial = task.trial(3)
        judge, commands = task.judge(trial, CAMERA), []
        loop = Loop(
            pilot, trial.world, None, MeasuredWorld(trial.world),
            hooks=[lambda step, commands=commands: commands.append(step.command.vector)],
        )  # fmt: skip
        loop.run(trial.duration, judge.watch)
        assert judge.result()["success"]
        flights.append(np.array(commands))
    assert np.array_equal(*flights)


class MeasuredWorld:
    def __init__(self, world):
        self.world = world

    def state_at(self, t):
        self.world.advance(t)
        return self.world.measured()


def test_the_expert_follows_a_leader():
    """By the leader's path; the first mode is the expert's own."""
    trial = FollowTask("left_turn_s_descent").trial(0)
    pilot = load_pilot("expert", task="follow", leader=trial.leader)
    pilot.act(Observation(0.0, None, np.zeros((30, 4)), trial.world.measured()))
    assert pilot.mode == "follow"


def test_the_mount_is_20_cm_ahead_by_default():
    """Two pilots by the same image: one with the mount in words, one with none."""
    camera, image = fpv_camera(160, 120), hall_image()
    states = []
    for mount in (None, (0.20, 0.0, 0.0), (-0.20, 0.0, 0.0)):
        pilot = load_pilot("pose", camera=camera, p_body_camera_m=mount)
        pilot.act(Observation(0.0, image, np.zeros((30, 4)), None))
        states.append(pilot.state.p_world)
    assert np.array_equal(states[0], states[1])
    # 0.4 m further back with the camera behind, along a nose within 5 deg of the runway
    assert states[2][0] - states[0][0] == pytest.approx(0.4, abs=0.01)


def hall_image():
    from falconwing_kit.scene import load_scene, render

    state = LandingTask().trial(3).world.state
    T_world_camera = camera_pose(state.pose.T_world_body, MOUNT)
    frame = render(load_scene("hall"), fpv_camera(160, 120), T_world_camera, backend="fast")
    return Image(0, 0.0, np.asarray(255.0 * frame.rgb + 0.5, np.uint8))


def test_noise_is_not_flown_by():
    """The real network on white noise and on a black image after a good one: both are left out, and
    the estimate stays the prediction.
    """
    camera, good = fpv_camera(160, 120), hall_image()
    noise = np.random.default_rng(0).integers(0, 256, good.pixels.shape, dtype=np.uint8)
    expected = fly(load_pilot("pose", camera=camera), None, [good, None, None])
    for pixels in (noise, np.zeros_like(noise)):
        images = [good, Image(1, 0.05, pixels), Image(2, 0.10, pixels // 2)]
        found = fly(load_pilot("pose", camera=camera), None, images)
        assert "predicting: " in found[1][1]
        assert found[1][0].vector == pytest.approx(expected[1][0].vector, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_it_lands_by_poses_as_noisy_as_the_networks(seed):
    """White noise of 15 cm and 0.6 deg: on the pad, half a metre from the centre line at most."""
    result, modes, _, _ = land(seed)
    assert result["success"] and result["ald_m"] < 0.5 and result["sink_rate_m_s"] < 0.8
    assert set(modes) <= {"approach", "flare", "landed"}


@pytest.mark.parametrize("late", [1, 2])
def test_it_lands_by_late_images(late):
    """50 and 100 ms, as video links are; nothing arrives in the first steps."""
    result, modes, _, error = land(1, lambda k, images: images[k - late] if k >= late else None)
    assert result["success"] and result["ald_m"] < 0.5
    assert error < 0.2  # a late pose taken for a present one is 0.35 or 0.7 m off
    assert modes[0] == "no state, predicting: no image"


def test_a_lying_state_changes_nothing():
    """The same flight with no state and with one that is wrong by 5 m and 1 rad: same commands."""

    class Liar:
        def state_at(self, t):
            return State.from_vector(np.array([5.0, 5.0, 5.0, 1.0, 1.0, 1.0, *np.ones(6)]))

    _, modes, commands, _ = land(2)
    _, modes_lied, commands_lied, _ = land(2, states=Liar())
    assert np.array_equal(commands, commands_lied) and modes == modes_lied


def test_without_an_image_it_predicts_and_says_so():
    """0.4 s without: no pose is asked for, the mode says why, and the aircraft still lands. The
    error grows by less than 0.1 m: a velocity known to 0.5 m/s drifts 0.2 m by the end of the gap.
    """
    _, _, _, error_with_all = land(0)
    result, modes, _, error = land(0, lambda k, images: None if 20 <= k < 28 else images[-1])
    # the loop keeps the newest image where the source gives none, so the pilot sees it again
    assert modes[20:28] == ("approach, predicting: repeated image",) * 8
    assert modes[28] == "approach" and result["success"]
    assert error < error_with_all + 0.1


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda image: None, "no image"),
        (lambda image: replace(image, t=5.0), "image of a wrong time"),
        (lambda image: replace(image, t=np.nan), "image of a wrong time"),
        (lambda image: replace(image, pixels=image.pixels[:24]), "image of another size or kind"),
        (lambda image: replace(image, pixels=image.pixels[..., 0]), "image of another size"),
        (lambda image: replace(image, pixels=np.zeros(9, np.uint8)), "image of another size"),
        (lambda image: replace(image, pixels=None), "image of another size or kind"),
    ],
)
def test_a_damaged_image_is_as_good_as_none(damage, reason):
    """The commands are those of a flight whose image was missing in that step."""
    without, damaged = [], []
    for found, change in ((without, lambda image: None), (damaged, damage)):
        net = KnownPoses(4)
        images = glide(net, 12)
        images[8] = change(images[8])
        found += fly(pose_pilot(net), net, images)
    assert damaged[8][1].startswith(f"approach, predicting: {reason}")
    assert damaged[9][1] == "approach"
    for (command, _), (expected, _) in zip(damaged, without, strict=True):
        assert np.array_equal(command.vector, expected.vector)


@pytest.mark.parametrize("same", ["sequence", "time", "pixels"])
def test_a_repeated_image_is_fused_once(same):
    """A frozen picture with a new number and time is no new measurement."""
    net = KnownPoses(4)
    images = glide(net, 12)
    changes = {
        "sequence": {"t": 0.4, "pixels": images[7].pixels},
        "time": {"sequence": 8},
        "pixels": {"sequence": 8, "t": 0.4},
    }
    images[8] = replace(images[7], **changes[same])
    found = fly(pose_pilot(net), net, images)
    assert found[8][1] == "approach, predicting: repeated image" and found[9][1] == "approach"
    assert net.asked == 11


def test_a_jpeg_is_an_image():
    """As a log and a camera give them."""
    net = KnownPoses(4)
    images = glide(net, 3)
    coded = [replace(image, pixels=np.frombuffer(image.jpeg, np.uint8)) for image in images]
    assert fly(pose_pilot(net), net, coded)[2][1] == "approach"


def test_it_is_lost_after_a_second_and_finds_itself_again():
    """From the first step without a pose 1 s passes; then the safe command until the next pose."""
    net = KnownPoses(4)
    images = glide(net, 40)
    found = fly(pose_pilot(net), net, [*images[:5], *[None] * 30, *images[35:40]])
    modes = [mode for _, mode in found]
    first = modes.index("lost: no image")
    assert first == 4 + 21  # the step after 1.0 s since the pose of step 4
    assert all(command == SAFE_COMMAND for command, _ in found[first:35])
    assert found[first - 1][0] != SAFE_COMMAND
    assert "lost" not in modes[-1]


def test_it_flies_level_before_the_first_image_and_is_lost_after_a_second():
    """Nothing is known yet: the controls of level flight, then the safe command."""
    found = fly(pose_pilot(KnownPoses()), None, [None] * 30)
    assert found[0][1] == "no state, predicting: no image"
    assert found[0][0].throttle > 0.1
    assert found[-1] == (SAFE_COMMAND, "lost: no image")


def test_poses_that_are_nan_are_as_good_as_none():
    """All poses nan: never a fault, and lost after a second."""

    class Broken(KnownPoses):
        def estimate(self, image, camera):
            return Pose(np.full((4, 4), np.nan), np.full((6, 6), np.nan))

    net = Broken()
    found = fly(pose_pilot(net), net, glide(net, 30))
    assert found[0][1] == "no state, predicting: uncertain pose"
    assert found[-1][1] == "lost: uncertain pose"


def test_past_commands_that_are_nan_do_not_spoil_the_estimate():
    """A damaged history counts as the safe command."""
    net = KnownPoses(4)
    pilot = pose_pilot(net)
    for k, image in enumerate(glide(net, 10)):
        command = pilot.act(Observation(0.05 * k, image, np.full((30, 4), np.nan), None))
        assert isinstance(command, Command) and np.isfinite(command.vector).all()
    assert pilot.mode == "approach" and np.isfinite(pilot.state.vector).all()


@pytest.mark.parametrize("jump", [-100.0, -0.3, 3.0, 1e6])
def test_a_clock_that_is_set_begins_anew(jump):
    """Images and steps alike; the state is that of a pilot that began there."""
    net, states = KnownPoses(4), []
    images = glide(net, 20)
    for first in (0, 10):
        net.rng, pilot = np.random.default_rng(1), pose_pilot(net)
        for k in range(first, 20):
            if k == 10:
                net.rng = np.random.default_rng(2)
            t = 0.05 * k + (jump if k >= 10 else 0.0)
            pilot.act(Observation(t, replace(images[k], t=t), np.zeros((30, 4)), None))
        assert pilot.mode == "approach"
        states.append(pilot.state.vector)
    assert states[0] == pytest.approx(states[1], abs=1e-6)
