"""Image faults: counted frames and single pixels, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.messages import Image
from falconwing_kit.tools.trials.image_faults import ImageFaults, exposure_table, world_link
from falconwing_kit.tools.trials.worlds import WORLDS, World


class Counting:
    """Images whose pixels are their number; 20 a second."""

    def __init__(self) -> None:
        self.sequence = -1

    def next_image(self, t: float) -> Image:
        self.sequence += 1
        return Image(self.sequence, t, np.full((48, 64, 3), self.sequence, np.uint8))


def seen(world: World, count: int = 200, seed: int = 5) -> list[Image | None]:
    source = ImageFaults(world)(Counting(), seed)
    return [source.next_image(0.05 * k) for k in range(count)]


def test_a_world_without_faults_changes_nothing():
    """Every image is that of its step."""
    images = seen(WORLDS["paper"])
    assert [image.sequence for image in images] == list(range(200))
    assert all((image.pixels == image.sequence).all() for image in images)


@pytest.mark.parametrize("frames", [1, 2])
def test_late_images_are_those_of_earlier_steps(frames):
    """None before the first; then number and time of the step before, or of two before."""
    images = seen(WORLDS[f"late {frames}"], 10)
    assert images[:frames] == [None] * frames
    assert [image.sequence for image in images[frames:]] == list(range(10 - frames))
    assert images[-1].t == pytest.approx(0.05 * (9 - frames))


def test_a_lost_frame_leaves_the_one_before():
    """Of 200 frames with 40 % lost, 120 +- 3 sd (7) arrive; none is ever newer than its step or
    older than the last that was seen.
    """
    numbers = [image.sequence for image in seen(WORLDS["lost 0.4"]) if image is not None]
    assert len(set(numbers)) == pytest.approx(120, abs=21)
    assert numbers == sorted(numbers) and numbers[-1] > 190
    assert seen(replace(WORLDS["lost 0.4"], lost=1.0), 5) == [None] * 5


def test_exposure_is_a_factor_of_light():
    """Twice the light is 2^(1/2.2) = 1.370 times the pixel value, cut at 255; half is 0.730."""
    bright, dark = exposure_table(1.0), exposure_table(-1.0)
    assert (bright[100], dark[100], bright[200]) == (137, 73, 255)
    assert np.array_equal(exposure_table(0.0), np.arange(256))
    assert (seen(WORLDS["exposure -1"], 101)[100].pixels == 73).all()


def test_half_of_the_image_is_covered_from_the_left():
    """64 pixels wide: columns 0 to 31 are black, the others as they were."""
    pixels = seen(WORLDS["half covered"], 51)[50].pixels
    assert not pixels[:, :32].any() and (pixels[:, 32:] == 50).all()


def test_the_picture_is_black_for_half_a_second_once():
    """Ten frames in a row, from 0.3 to 1.5 s after the start; elsewhere the picture is there."""
    black = [not image.pixels.any() for image in seen(WORLDS["black 0.5 s"], 100)[1:]]
    assert sum(black) == 10
    first = black.index(True)
    assert all(black[first : first + 10]) and 0.25 <= 0.05 * first <= 1.5


def test_dark_discs_cover_their_share_and_stay():
    """Six discs of 30 % in all; 15 to 30 % after overlaps and edges; the same in all frames."""
    images = seen(WORLDS["occluders 0.3"], 120)
    masks = [(image.pixels[..., 0] != image.sequence) for image in images[100:]]
    assert 0.15 <= masks[0].mean() <= 0.31
    assert all(np.array_equal(mask, masks[0]) for mask in masks)
    other = seen(WORLDS["occluders 0.3"], 120, seed=6)[100].pixels[..., 0] != 100
    assert not np.array_equal(other, masks[0])


def test_a_grey_image_shows_nothing():
    """One value in all frames."""
    assert {int(v) for image in seen(WORLDS["grey image"], 9) for v in np.unique(image.pixels)} == {
        128
    }


def test_the_analog_link_has_the_worlds_noise():
    """At 26 dB the rms of the luma noise is 255 / 10^(26/20) = 12.8 grey levels on a grey image;
    the measured link has 38.7 dB. Only the worlds that say so are seen through it.
    """
    assert world_link(WORLDS["snr 26"], 1).snr_db == 26.0
    assert world_link(WORLDS["reality"], 1).snr_db == 38.7
    assert world_link(WORLDS["paper"], 1) is None
    grey = replace(WORLDS["snr 26"], is_grey=True)
    pixels = np.array([image.pixels for image in seen(grey, 40)], float)
    luma = pixels @ (0.299, 0.587, 0.114)
    assert np.median(luma.std(axis=(1, 2))) == pytest.approx(12.8, rel=0.25)
