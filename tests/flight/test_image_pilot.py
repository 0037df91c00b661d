"""Image pilot: lands by the hall's images alone; whatever the images, it gives a command and says
what is missing.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit import data
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import SAFE_COMMAND, Image, Observation, State
from falconwing_kit.flight import load_pilot
from falconwing_kit.flight.image_pilot import blank_or_noise
from falconwing_kit.flight.loop import Loop
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.scene import load_scene

CAMERA, MOUNT = fpv_camera(160, 120), (0.20, 0.0, 0.0)


@pytest.fixture(scope="module")
def hall():
    return load_scene("hall")


class Changed:
    """A view whose images `change` makes of (step, images so far)."""

    def __init__(self, view, change):
        self.view, self.change, self.images = view, change, []

    def next_image(self, t):
        self.images.append(self.view.next_image(t))
        return self.change(len(self.images) - 1, self.images)


class Liar:
    """A state that is wrong by metres."""

    def state_at(self, t):
        return State.from_vector(np.array([5.0, 5.0, 5.0, 1.0, 1.0, 1.0, *np.ones(6)]))


def land(hall, seed, change=lambda k, images: images[-1], states=None, seconds=None):
    """Result, modes and commands of a landing, or of its first seconds."""
    task, pilot = LandingTask(), load_pilot("student", camera=CAMERA)
    trial = task.trial(seed)
    judge, steps = task.judge(trial, CAMERA), []
    view = Changed(RenderedView(trial.world, hall, CAMERA, MOUNT), change)
    loop = Loop(
        pilot, trial.world, view, states,
        hooks=[lambda step: steps.append((step.mode, step.command.vector))],
    )  # fmt: skip
    flight = loop.run(seconds or trial.duration, judge.watch)
    assert flight.faults == 0
    modes, commands = zip(*steps, strict=True)
    return judge.result(), modes, np.array(commands)


def test_it_lands_by_images_alone(hall):
    """A seed of tuning: on the pad, a quarter of a metre from its centre line."""
    result, modes, _ = land(hall, 501)
    assert result["success"] and result["ald_m"] < 0.25 and result["sink_rate_m_s"] < 0.6
    assert set(modes) == {"policy"}


def test_a_lying_state_changes_nothing(hall):
    """With no state and with a wrong one: the same commands to the bit."""
    *_, commands = land(hall, 502, seconds=0.5)
    *_, lied = land(hall, 502, states=Liar(), seconds=0.5)
    assert np.array_equal(commands, lied)


def test_it_lands_by_images_two_frames_late(hall):
    """100 ms, and nothing in the first steps."""
    result, modes, _ = land(hall, 503, lambda k, images: images[k - 2] if k >= 2 else None)
    assert result["success"]
    assert modes[0] == "policy, predicting: no image" and modes[5] == "policy"


def test_a_flipped_image_gives_other_commands(hall):
    """Left and right exchanged: a pilot that looked at nothing would not mind."""

    def flip(k, images):
        return replace(images[-1], pixels=np.ascontiguousarray(images[-1].pixels[:, ::-1]))

    *_, commands = land(hall, 504, seconds=1.0)
    *_, flipped = land(hall, 504, flip, seconds=1.0)
    assert np.abs(flipped[:, 1] - commands[:, 1]).max() > 0.2


@pytest.mark.parametrize(
    ("image", "note"),
    [
        (lambda k, good: None, "no image"),
        (lambda k, good: good, "repeated image"),
        (lambda k, good: Image(k, 99.0, np.roll(good.pixels, k)), "image of a wrong time"),
        (lambda k, good: Image(k, np.nan, np.roll(good.pixels, k)), "image of a wrong time"),
        (lambda k, good: Image(k, 0.05 * k, good.pixels[:60]), "image of another size or kind"),
        (lambda k, good: Image(k, 0.05 * k, np.zeros(9, np.uint8)), "image of another size or"),
        (lambda k, good: Image(k, 0.05 * k, None), "image of another size or kind"),
        (lambda k, good: Image(k, 0.05 * k, np.full_like(good.pixels, k)), "blank image"),
        (lambda k, good: Image(k, 0.05 * k, noise(k)), "noise"),
    ],
)
def test_without_a_usable_image_it_flies_on_for_a_second(hall, image, note):
    """Then the safe command; a good image ends that."""
    world = LandingTask().trial(505).world
    good = RenderedView(world, hall, CAMERA, MOUNT).next_image(0.0)
    pilot, past = load_pilot("student", camera=CAMERA), np.zeros((30, 4))
    pilot.act(Observation(0.0, good, past))
    assert pilot.mode == "policy"
    for k in range(1, 31):
        command = pilot.act(Observation(0.05 * k, image(k, good), past))
        assert np.isfinite(command.vector).all()
        if k <= 20:
            assert pilot.mode.startswith(f"policy, predicting: {note}")
        else:
            assert pilot.mode.startswith(f"lost: {note}")
            assert command.vector == pytest.approx(SAFE_COMMAND.vector)
    pilot.act(Observation(1.6, Image(99, 1.6, np.roll(good.pixels, 1, axis=0)), past))
    assert pilot.mode == "policy"


def noise(k):
    return np.random.default_rng(k).integers(0, 256, (120, 160, 3), dtype=np.uint8)


def test_salt_and_pepper_is_a_picture_and_white_noise_is_none(hall):
    """Of a picture of correlation 0.9 with 30 % of its pixels black or white."""
    world = LandingTask().trial(505).world
    picture = RenderedView(world, hall, CAMERA, MOUNT).look() / np.float32(255.0)
    rng = np.random.default_rng(0)
    draw = rng.random((120, 160, 1))
    salted = np.where(draw < 0.15, 0.0, np.where(draw > 0.85, 1.0, picture)).astype(np.float32)
    assert blank_or_noise(picture) == blank_or_noise(salted) == ""
    assert blank_or_noise(rng.random((120, 160, 3)).astype(np.float32)) == "noise"
    assert blank_or_noise(np.full((120, 160, 3), 0.5, np.float32)) == "blank image"


def test_damaged_past_commands_stay_out(hall):
    """NaN among the past commands: a finite command."""
    world = LandingTask().trial(505).world
    good = RenderedView(world, hall, CAMERA, MOUNT).next_image(0.0)
    past = np.zeros((30, 4))
    past[-1] = np.nan
    command = load_pilot("student", camera=CAMERA).act(Observation(0.0, good, past))
    assert np.isfinite(command.vector).all()


def test_it_needs_a_camera_and_weights_of_its_task():
    """One sentence each."""
    weights = Path(data.__file__).with_name("policy_follow_mask.safetensors")
    with pytest.raises(InputError, match="a policy for the task landing, got one for follow"):
        load_pilot("student", camera=CAMERA, weights=weights)
    with pytest.raises(InputError, match="flies the task landing, got mask, which does not"):
        load_pilot("mask", camera=CAMERA)
    with pytest.raises(InputError, match="expected a PinholeCamera"):
        load_pilot("student")
