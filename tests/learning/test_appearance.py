"""Appearance: each image is randomised differently, with a mask, and unbiased where it must be."""

import pytest
import torch

from falconwing_kit.learning.appearance import (
    add_blur,
    add_occluders,
    analog_link,
    randomise_appearance,
    vary_lighting,
)

SHAPE = (16, 3, 48, 64)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def images(generator):
    return torch.rand(SHAPE, generator=generator)


def test_everything_stays_an_image_and_differs(images, generator):
    """Colours 0..1; sixteen copies of one picture come out as sixteen pictures."""
    out, clear = randomise_appearance(images[:1].expand(16, -1, -1, -1), generator)
    assert out.shape == SHAPE
    assert clear.shape == (16, 48, 64)
    assert clear.dtype == torch.bool
    assert out.min() >= 0.0
    assert out.max() <= 1.0
    assert (out[1:] - out[:1]).abs().amax(dim=(1, 2, 3)).min() > 0.05


def test_the_same_seed_gives_the_same(images):
    """A second run must be able to repeat a first."""
    first, second = (
        randomise_appearance(images, torch.Generator().manual_seed(3))[0] for _ in range(2)
    )
    assert torch.equal(first, second)


def test_clear_pixels_are_unchanged(images, generator):
    """Clear pixels keep their bits; the others, a few per cent of all, do not."""
    out, clear = add_occluders(images, generator)
    changed = (out != images).any(dim=1)
    assert torch.equal(changed, ~clear)
    assert 0.005 < changed.float().mean() < 0.2


def test_a_blur_spreads_and_keeps_the_light(generator):
    """A kernel sums to 1: flat stays flat, and a point keeps its sum while its peak falls."""
    flat = torch.full(SHAPE, 0.4)
    assert torch.allclose(add_blur(flat, generator), flat, atol=1e-6)
    point = torch.zeros(SHAPE)
    point[:, :, 24, 32] = 1.0
    out = add_blur(point, generator)
    assert torch.allclose(out.sum(dim=(2, 3)), torch.ones(16, 3), atol=1e-5)
    assert (out.amax(dim=(2, 3)) < 0.999).float().mean() > 0.6


def test_light_changes_brightness_both_ways(generator):
    """A grey of one half comes out darker and brighter, at the documented spread of about a
    quarter.
    """
    means = vary_lighting(torch.full((400, 3, 8, 8), 0.5), generator).mean(dim=(1, 2, 3))
    assert means.min() < 0.35
    assert means.max() > 0.65
    assert means.mean() == pytest.approx(0.5, abs=0.06)


def test_analog_link_delays_colours_but_not_luma(generator):
    """A red stripe on grey of the same luma: behind the decoder's low-pass its colour's middle lies
    further right.
    """
    red = torch.tensor([0.9, 0.3, 0.3])
    luma = float((red * torch.tensor([0.299, 0.587, 0.114])).sum())
    images = torch.full((64, 3, 32, 64), luma)
    images[..., 20:24] = red[:, None, None]
    out = analog_link(images, generator).mean(dim=(0, 2))
    colour = (out[0] - out[2]).clamp(min=0.0) - 0.02
    colour = colour.clamp(min=0.0)
    middle = (colour * torch.arange(64.0)).sum() / colour.sum()
    assert 22.0 < middle < 27.0
    grey = (out * torch.tensor([0.299, 0.587, 0.114])[:, None]).sum(dim=0)
    assert (grey - luma).abs().max() < 0.05
