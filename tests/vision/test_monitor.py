"""Frame monitor: the paper's rule to the letter, what it misses, and what the kit's rule does
instead.

Pictures are shifted cuts of one random scene, 20 a second, unless stated otherwise.
"""

import math
from dataclasses import replace
from time import process_time

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Image
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.tools.devices.cameras import FakeCamera
from falconwing_kit.vision import FrameMonitor, FrameVerdict, load_monitor_settings
from falconwing_kit.vision.monitor import downscale, flat_share, motion_ssim, noise_level
from falconwing_kit.vision.ssim import ssim

FAKE = FakeCamera(size=(320, 288), seed=4)


def moving(number: int) -> np.ndarray:
    """Frame of a live camera: the scene moves by three pixels a frame. The bar code is cut off."""
    return FAKE.picture(number)[48:]


def noise(number: int) -> np.ndarray:
    """A receiver without signal: snow."""
    return np.random.default_rng(number).integers(0, 256, (240, 320, 3), dtype=np.uint8)


def watch(monitor: FrameMonitor, pictures: list, start: float = 0.0) -> list[FrameVerdict]:
    """One verdict for each picture, 0.05 s apart."""
    return [monitor.update(picture, start + 0.05 * k) for k, picture in enumerate(pictures)]


def first_alert(verdicts: list[FrameVerdict]) -> int | None:
    return next((k for k, verdict in enumerate(verdicts) if verdict.alert), None)


@pytest.fixture
def flying() -> FrameMonitor:
    """A monitor that has seen one second of good video, pictures 0 to 19 at 0 to 0.95 s."""
    monitor = FrameMonitor()
    assert not any(verdict.alert for verdict in watch(monitor, [moving(k) for k in range(20)]))
    return monitor


# The paper's rule


def test_papers_rule_alerts_at_the_fifth_frame_below():
    """Good, good, then snow: pictures 2 to 6 are the five whose SSIM to the one before is below
    0.7.
    """
    verdicts = watch(FrameMonitor("paper"), [moving(0), moving(0), *(noise(k) for k in range(6))])
    assert [verdict.alert for verdict in verdicts] == [False] * 6 + [True] * 2
    assert math.isnan(verdicts[0].ssim)
    assert verdicts[1].ssim == pytest.approx(1.0, abs=1e-6)
    assert max(verdict.ssim for verdict in verdicts[2:]) < 0.1
    assert verdicts[6].reason.startswith("noise")


def test_papers_rule_counts_in_a_row():
    """Four below, one above, again and again: never five in a row."""
    pictures = [
        noise(k // 5 if k % 5 < 2 else 100 + k) for k in range(40)
    ]  # the first two of five are the same
    verdicts = watch(FrameMonitor("paper"), pictures)
    assert sum(verdict.ssim > 0.7 for verdict in verdicts) >= 7
    assert first_alert(verdicts) is None


def test_papers_rule_is_ssim_of_the_pictures_as_they_are():
    """Its number is that of `ssim` on the full grey pictures, by the luma weights of ITU-R BT.601
    to a level.
    """
    first, second = (np.rint(moving(k) @ (0.299, 0.587, 0.114)).astype(np.uint8) for k in (3, 4))
    verdicts = watch(FrameMonitor("paper"), [moving(3), moving(4)])
    assert verdicts[1].ssim == pytest.approx(ssim(first, second), abs=2e-3)


@pytest.mark.parametrize("picture", [moving(5), np.zeros((240, 320, 3), np.uint8)])
def test_papers_rule_misses_frozen_and_blank_pictures(picture):
    """Two equal pictures score one, by the equation."""
    verdicts = watch(FrameMonitor("paper"), [picture] * 40)
    assert first_alert(verdicts) is None
    assert verdicts[-1].ssim == pytest.approx(1.0, abs=1e-6)


def test_papers_rule_alarms_on_perfect_video_in_a_turn():
    """60 deg/s at 20 Hz and 0.62 widths of focal length: 10 px a frame at 320 wide. The picture is
    perfect.
    """
    pictures = [moving(round(k * 10 / 3)) for k in range(20)]
    assert first_alert(watch(FrameMonitor("paper"), pictures)) == 5
    assert first_alert(watch(FrameMonitor(), pictures)) is None


# The kit's rule


@pytest.mark.alone
def test_640_by_480_is_judged_within_20_ms():
    """The issue's limit, which leaves a loop of 50 ms its time; of CPU, on one thread, the median
    of 15 pictures.
    """
    fake, monitor, took, threads = (
        FakeCamera(size=(640, 480)),
        FrameMonitor(),
        [],
        cv2.getNumThreads(),
    )
    pictures = [fake.picture(k) for k in range(17)]
    cv2.setNumThreads(1)
    for k, picture in enumerate(pictures):
        begin = process_time()
        monitor.update(picture, 0.05 * k)
        took.append(process_time() - begin)
    cv2.setNumThreads(threads)
    assert np.median(took[2:]) <= 0.020


def test_motion_is_taken_out():
    """The same scene 6 px on: nearly one after moving it back, far from it before."""
    first, second = (downscale(moving(k), 160)[..., 1] for k in (0, 4))
    assert ssim(first, second) < 0.5
    assert motion_ssim(first, second) > 0.95


def test_another_scene_is_no_motion():
    """No motion turns one random scene into another."""
    other = downscale(FakeCamera(size=(320, 288), seed=5).picture(0)[48:], 160)[..., 1]
    assert motion_ssim(downscale(moving(0), 160)[..., 1], other) < 0.6


@pytest.mark.parametrize("size", [(320, 240), (640, 480)])
def test_noise_alerts_within_300_ms(size):
    """Six frames at 20 Hz after its onset; 14 dB is below the threshold of FM reception."""
    fake, link, monitor = FakeCamera(size=size), AnalogVideo(14.0, seed=8), FrameMonitor()
    pictures = [fake.picture(k) if k < 20 else link.apply(fake.picture(k), k) for k in range(40)]
    assert 20 <= first_alert(watch(monitor, pictures)) <= 26


@pytest.mark.parametrize("size", [(160, 120), (320, 240), (640, 480)])
def test_white_noise_over_strong_contrasts_alerts_within_300_ms(size):
    """Boxes at rest, then a standard deviation of 40 levels: reduced and compared, boxes still
    match.
    """
    boxes = np.kron(
        np.random.default_rng(1).integers(40, 216, (6, 8), dtype=np.uint8),
        np.ones((20, 20), np.uint8),
    )
    scene = np.kron(boxes, np.ones((size[1] // 120, size[0] // 160), np.uint8)).astype(float)
    rng, monitor = np.random.default_rng(2), FrameMonitor()
    pictures = [
        np.clip(scene + rng.normal(0.0, 2.0 if k < 20 else 40.0, scene.shape), 0, 255)
        for k in range(40)
    ]
    assert (
        20 <= first_alert(watch(monitor, [picture.astype(np.uint8) for picture in pictures])) <= 26
    )


@pytest.mark.parametrize("sigma", [3.0, 12.0, 30.0])
def test_noise_level_is_the_standard_deviation_of_white_noise(sigma):
    """By its definition, on a ramp that the mask does not see; 19,000 pixels of the median know it
    to 1 %.
    """
    ramp = np.linspace(110.0, 146.0, 320) + np.zeros((240, 1))
    picture = ramp + np.random.default_rng(3).normal(0.0, sigma, ramp.shape)
    assert noise_level(np.rint(np.clip(picture, 0, 255)).astype(np.uint8)) == pytest.approx(
        sigma, rel=0.04
    )


def test_edges_are_no_noise():
    """Lines every eight pixels in both directions: the mask sees their crossings alone."""
    picture = np.full((240, 320), 200, np.uint8)
    picture[::8] = picture[:, ::8] = 20
    assert noise_level(picture) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_a_usable_analog_link_is_no_alert(seed):
    """32 dB, with motion: grain that does not hurt."""
    link = AnalogVideo(32.0, seed, dropouts=0.1)
    assert first_alert(watch(FrameMonitor(), [link.apply(moving(k), k) for k in range(60)])) is None


def test_a_frozen_picture_alerts_within_300_ms(flying):
    """The last new one is of 0.95 s; older than 0.2 s at 1.2 s, the fifth frame that does not
    change.
    """
    verdicts = watch(flying, [moving(19)] * 10, start=1.0)
    assert first_alert(verdicts) == 4
    assert "old or frozen: no new picture for 0.25 s" in verdicts[4].reason
    assert verdicts[0].ssim == pytest.approx(1.0, abs=1e-6)  # equal pictures, by the equation


def test_no_picture_at_all_alerts_within_300_ms(flying):
    """The same without a picture; and a camera that never gave one."""
    assert first_alert(watch(flying, [None] * 10, start=1.0)) == 4
    assert first_alert(watch(FrameMonitor(), [None] * 10)) == 5


def test_late_pictures_alert():
    """Each is new but was taken 0.3 s ago, by its own time; 0.1 s ago is fine."""
    for late, alert in ((0.3, True), (0.1, False)):
        pictures = [Image(k, 0.05 * k - late, moving(k)) for k in range(20)]
        assert watch(FrameMonitor(), pictures)[-1].alert == alert


def test_pictures_from_the_future_grow_old_all_the_same():
    """Unix time as a stamp, seconds from the start as now: the frozen picture alerts as any other,
    at 1.2 s.
    """
    monitor = FrameMonitor()
    watch(monitor, [Image(k, 1.7e9 + 0.05 * k, moving(k)) for k in range(20)])
    assert first_alert(watch(monitor, [Image(19, 1.7e9 + 0.95, moving(19))] * 10, start=1.0)) == 4


@pytest.mark.parametrize("rule", ["motion", "paper"])
def test_a_buffer_that_is_written_again_hides_no_noise(rule):
    """A grey camera that reads every picture into the same array; five comparisons of snow are
    below any threshold.
    """
    monitor, buffer, verdicts = FrameMonitor(rule), np.zeros((120, 160), np.uint8), []
    for k in range(8):
        buffer[:] = noise(k)[:120, :160, 0]
        verdicts.append(monitor.update(buffer, 0.05 * k))
    assert max(verdict.ssim for verdict in verdicts[1:]) < 0.5
    assert first_alert(verdicts) is not None


@pytest.mark.parametrize(
    ("colour", "word"), [((0, 0, 0), "black"), ((20, 30, 220), "blue"), ((128, 128, 128), "grey")]
)
def test_a_receiver_without_signal_alerts_within_300_ms(flying, colour, word):
    """One colour, a level of capture noise and a few white words: 7 % of the picture."""
    rng, pictures = np.random.default_rng(2), []
    for _ in range(10):
        screen = np.clip(np.array(colour) + rng.integers(-1, 2, (240, 320, 3)), 0, 255).astype(
            np.uint8
        )
        screen[100:120, 20:290] = 255
        pictures.append(screen)
    verdicts = watch(flying, pictures, start=1.0)
    assert 0 < first_alert(verdicts) <= 6
    assert word in verdicts[9].reason
    assert "blank" in verdicts[9].reason


def test_flat_share_by_hand():
    """A quarter of the picture has another colour; 6 levels off still count."""
    picture = np.full((40, 40, 3), (20, 30, 220), np.uint8)
    picture[:10] += np.uint8(7)
    picture[10:15] += np.uint8(6)
    assert flat_share(picture, 6.0) == (0.75, "blue")
    assert flat_share(np.full((40, 40), 250, np.uint8), 6.0) == (1.0, "white")


def test_flicker_alerts_although_every_fourth_picture_is_good(flying):
    """Three bad of four, and the picture after snow does not match either: more than five of any
    eight.
    """
    pictures = [moving(20 + k) if k % 4 == 3 else noise(k) for k in range(16)]
    assert first_alert(watch(flying, pictures, start=1.0)) <= 6


def test_one_torn_picture_is_no_alert(flying):
    """It spoils two comparisons, itself and the next; five are needed."""
    pictures = [noise(0) if k == 3 else moving(20 + k) for k in range(20)]
    verdicts = watch(flying, pictures, start=1.0)
    assert first_alert(verdicts) is None
    assert sum(verdict.ssim < 0.75 for verdict in verdicts) == 2


def test_pictures_that_come_twice_do_not_hide_noise(flying):
    """A 10 Hz camera in a 20 Hz loop: every second picture is the one before, and SSIM would call
    it perfect.
    """
    verdicts = watch(flying, [noise(k // 2) for k in range(20)], start=1.0)
    assert first_alert(verdicts) == 8  # the fifth new picture
    assert first_alert(watch(FrameMonitor("paper"), [noise(k // 2) for k in range(20)])) is None


def test_an_alert_ends_after_a_second_of_good_video(flying):
    """Twenty good comparisons in a row; the first good picture is still compared with snow."""
    verdicts = watch(
        flying, [*(noise(k) for k in range(6)), *(moving(k) for k in range(30))], start=1.0
    )
    assert [verdict.alert for verdict in verdicts] == [False] * 4 + [True] * (2 + 1 + 19) + [
        False
    ] * 10
    assert verdicts[20].reason.startswith("noise")
    assert verdicts[-1].reason == ""


def test_grey_pictures_and_a_change_of_size():
    """Grey pictures are accepted; after a change of size one picture is not compared."""
    pictures = [moving(k)[..., 1] for k in range(10)] + [moving(k)[:200] for k in range(10)]
    verdicts = watch(FrameMonitor(), pictures)
    assert first_alert(verdicts) is None
    assert [k for k, verdict in enumerate(verdicts) if math.isnan(verdict.ssim)] == [0, 10]


def test_smallest_pictures_are_judged():
    """32 pixels a side, also in a strip that would be lower once reduced."""
    for shape in ((32, 32, 3), (32, 600, 3)):
        rng = np.random.default_rng(0)
        pictures = [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(6)]
        assert (
            first_alert(watch(FrameMonitor(), pictures)) == 4
        )  # snow is noise from its first picture on


def test_reduced_pictures_keep_their_means():
    """Areas are averaged: the whole's mean stays; small pictures stay as they are."""
    picture = noise(1)
    small = downscale(picture, 160)
    assert small.shape == (120, 160, 3)
    assert small.mean() == pytest.approx(picture.mean(), abs=0.5)
    assert downscale(small, 160) is small


@pytest.mark.parametrize(
    "picture",
    [np.zeros((240, 320, 3)), np.zeros((240, 320, 4), np.uint8), np.zeros((16, 320), np.uint8),
     np.zeros(5000, np.uint8), "picture"],
)  # fmt: skip
def test_what_is_no_picture_is_refused(picture):
    """Floats, four channels, too small, JPEG bytes, a text."""
    with pytest.raises(InputError, match="image: expected"):
        FrameMonitor().update(picture, 0.0)


def test_wrong_use_is_refused(flying):
    """An unknown rule, time that runs backward, no time, settings that cannot be."""
    with pytest.raises(InputError, match="motion, paper"):
        FrameMonitor("optical")
    for t in (0.5, math.nan):
        with pytest.raises(InputError, match="t: expected"):
            flying.update(moving(0), t)
    with pytest.raises(InputError, match="frames"):
        replace(load_monitor_settings(), frames=9)


def test_settings_hold_the_papers_numbers():
    """0.7 and five, from the paper's passage on the monitor."""
    paper = load_monitor_settings().paper
    assert (paper.threshold, paper.frames) == (0.7, 5)
