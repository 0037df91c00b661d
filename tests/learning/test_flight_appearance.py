"""Appearance of flights: one draw a flight, images stay images, some flights are left clean."""

import pytest
import torch

from falconwing_kit.learning.flight_appearance import CLEAN_SHARE, FlightAppearance

FLIGHTS = 200


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def test_images_stay_images_and_flights_differ(generator):
    """The same picture in 200 flights."""
    picture = torch.rand(1, 3, 24, 32, generator=generator).expand(FLIGHTS, -1, -1, -1)
    out = FlightAppearance(FLIGHTS, generator).apply(picture, torch.arange(FLIGHTS))
    assert out.shape == picture.shape
    assert out.min() >= 0.0 and out.max() <= 1.0
    means = out.mean(dim=(1, 2, 3))
    assert means.std() > 0.05


def test_a_flight_keeps_its_light(generator):
    """Brightness of two images of one flight differs by noise, that of two flights by far more."""
    look = FlightAppearance(FLIGHTS, generator)
    picture = torch.full((FLIGHTS, 3, 24, 32), 0.5)
    rows = torch.arange(FLIGHTS)
    first, second = (look.apply(picture, rows).mean(dim=(1, 2, 3)) for _ in range(2))
    assert (first - second).abs().median() < 0.1 * first.std()


def test_a_share_of_the_flights_is_left_as_it_is(generator):
    """Binomial: 200 flights at 15 % are 15 to 45 with probability 0.999."""
    picture = torch.rand(FLIGHTS, 3, 24, 32, generator=generator)
    out = FlightAppearance(FLIGHTS, generator).apply(picture, torch.arange(FLIGHTS))
    same = int((out == picture).all(dim=(1, 2, 3)).sum())
    assert 15 <= same <= 45
    assert CLEAN_SHARE == 0.15


def test_images_are_changed_by_their_flights_draw(generator):
    """Rows in another order, of the clean flights: the clean ones stay with their numbers."""
    look = FlightAppearance(FLIGHTS, generator)
    rows = torch.arange(FLIGHTS).flip(0)
    picture = torch.rand(FLIGHTS, 3, 24, 32, generator=generator)
    out = look.apply(picture, rows)
    same = (out == picture).all(dim=(1, 2, 3))
    assert torch.equal(same, look.clean[rows])
