"""Occlusion sensitivity against a policy whose answer to each square is known by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.vision.occlusion import Seen, occlusion_sensitivity


def corner_policy(gain: float):
    """Elevator: gain times the red of the upper left corner of 2x2 pixels; memory adds to it."""
    return SimpleNamespace(
        encode=lambda image: image[:2, :2, 0].mean(),
        step=lambda red, inputs, memory: (
            np.array([0.5, inputs[0], gain * red + memory, 0.0]),
            memory,
        ),
    )


def seen(memory: float = 0.0, red: float = 1.0) -> Seen:
    """An image of 4x6 that is black but for its corner."""
    image = np.zeros((4, 6, 3), np.float32)
    image[:2, :2, 0] = red
    return Seen(image, np.array([0.2], np.float32), np.float32(memory))


def test_only_the_square_over_the_corner_moves_the_command():
    """By hand: the mean red is 4/24, so hiding the corner takes 0.5 (1 - 1/6) off the elevator."""
    expected = np.zeros((2, 3))
    expected[0, 0] = 0.5 * (1.0 - 4.0 / 24.0)
    got = occlusion_sensitivity(corner_policy(0.5), seen(), patch=2, stride=2)
    assert got == pytest.approx(expected, abs=1e-6)


def test_squares_overlap_where_the_stride_is_smaller():
    """By hand: a square one pixel to the right covers half of the corner."""
    got = occlusion_sensitivity(corner_policy(0.5), seen(), patch=2, stride=1)
    assert got.shape == (3, 5)
    assert got[0, 1] == pytest.approx(0.5 * 0.5 * (1.0 - 4.0 / 24.0), abs=1e-6)


def test_commands_count_up_to_their_limits():
    """By hand: 2 is held to 1, and hidden it is 2/6: the change is 2/3."""
    got = occlusion_sensitivity(corner_policy(2.0), seen(), patch=2, stride=2)
    assert got[0, 0] == pytest.approx(2.0 / 3.0, abs=1e-6)


def test_the_memory_before_the_step_is_used():
    """By hand: a memory of 1 holds the elevator at its limit, whatever is hidden."""
    assert occlusion_sensitivity(corner_policy(0.5), seen(1.0), patch=2, stride=2).max() == 0.0


def test_an_image_of_one_colour_has_nothing_to_hide():
    """The mean colour is the image's own."""
    flat = Seen(np.full((4, 6, 3), 0.25, np.float32), np.zeros(1, np.float32), np.float32(0.0))
    assert occlusion_sensitivity(corner_policy(1.0), flat, patch=2, stride=2).max() < 1e-6
