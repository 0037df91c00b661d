"""Analog video: noise by its definition, and each fault by the law it is modelled on."""

import math

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import analog
from falconwing_kit.scene.analog import AnalogVideo

PIXEL_S = 52.66e-6 / 640  # of a 640 wide picture: the seen part of a line lasts 52.66 us


def flat(width: int = 640, level: int = 128) -> np.ndarray:
    return np.full((width * 3 // 4, width, 3), level, np.uint8)


def luma(picture: np.ndarray) -> np.ndarray:
    """Y of ITU-R BT.601, by its weights."""
    return picture.astype(np.float64) @ (0.299, 0.587, 0.114)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("width", [320, 640])
@pytest.mark.parametrize("snr_db", [22.0, 26.0, 32.0, 38.0])
def test_luma_noise_is_what_was_asked(snr_db, width):
    """S/N = 20 log10(255 / rms) on flat grey; 75,000 pixels measure it to 0.03 dB; rounding adds
    0.1 at 38 dB.
    """
    picture = AnalogVideo(snr_db, seed=3, dropouts=0.0).apply(flat(width), 0)
    measured = 20.0 * math.log10(255.0 / luma(picture).std())
    assert measured == pytest.approx(snr_db, abs=0.25)
    assert luma(picture).mean() == pytest.approx(128.0, abs=0.5)


def test_noise_ends_at_the_luma_bandwidth(rng):
    """Half the gain at 4.2 MHz, a quarter of the power; nothing at 5.8 MHz. Fifteen taps reach
    a tenth.
    """
    noise = analog.luma_noise((480, 640), 20.0, PIXEL_S, rng)
    power = (np.abs(np.fft.rfft(noise, axis=1)) ** 2).mean(axis=0)
    hertz = np.fft.rfftfreq(640, PIXEL_S)
    low, near, beyond = (power[np.abs(hertz - f) < 0.1e6].mean() for f in (1.0e6, 4.2e6, 5.8e6))
    assert near / low == pytest.approx(0.25, rel=0.1)
    assert beyond / low < 0.01


def test_fm_gain_by_hand():
    """D = 3.5 / 4.2: 12 D^2 (D + 1) = 15.28, so 20 dB of picture need 8.16 dB of carrier."""
    assert 10.0 * math.log10(analog.carrier_to_noise(20.0)) == pytest.approx(
        20.0 - 10.0 * math.log10(15.28), abs=0.01
    )


def test_clicks_come_as_often_as_rice_says(rng):
    """20 dB: C/N 6.545, 15.4 MHz / sqrt(12) erfc(2.558) / 29.97 = 44 a frame; far fewer at 23 dB.
    Five sigma.
    """
    by_hand = 15.4e6 / math.sqrt(12.0) * math.erfc(math.sqrt(100.0 / 15.28)) / 29.97
    assert by_hand == pytest.approx(44.0, abs=1.0)
    total = 0.0
    for _ in range(20):
        sheet = np.zeros((480, 640), np.float32)
        analog.add_clicks(sheet, 20.0, PIXEL_S, rng)
        total += (np.abs(sheet) == 255.0).sum()  # a click begins as high as white
    assert total / 20 == pytest.approx(by_hand, abs=5.0 * math.sqrt(by_hand / 20))
    assert analog.clicks_per_frame(23.0) < 0.1


def test_click_fades_to_the_right(rng):
    """After 0.3 us, 3.6 pixels, it has lost a factor e; nothing stands before it."""
    sheet = np.zeros((480, 640), np.float32)
    analog.add_clicks(sheet, 21.0, PIXEL_S, rng)
    row, column = next((r, c) for r, c in np.argwhere(np.abs(sheet) == 255.0) if 10 < c < 600)
    assert sheet[row, column + 4] / sheet[row, column] == pytest.approx(
        math.exp(-4 * PIXEL_S / 0.3e-6), rel=1e-4
    )
    assert sheet[row, column - 1] == 0.0


def test_colours_run_to_the_right():
    """A first-order low-pass of 0.6 MHz lags by 1 / (2 pi 0.6 MHz) = 0.265 us on average: 3.22
    pixels of a line.
    """
    picture = flat()
    picture[:, 320:] = (200, 100, 128)  # other colours of nearly the same luma
    cr = cv2.cvtColor(AnalogVideo(80.0).apply(picture, 0), cv2.COLOR_RGB2YCrCb)[100:400, :, 1].mean(
        axis=0
    )
    rise = (cr - cr[300]) / (cr[400] - cr[300])
    assert (1.0 - rise[320:400]).sum() + (-rise[300:320]).sum() == pytest.approx(
        3.22, abs=0.2
    )  # levels are whole
    assert (
        np.abs(rise[300:316]).max() < 0.02
    )  # nothing runs to the left, but for the four pixels of a sample


def test_lines_jitter_as_the_sync_edge_is_noisy(rng):
    """Slope law: 0.25 us * noise / 0.4, behind a first-order lock, a = 0.5: times sqrt((1 - a) / (1
    + a)) = 0.577.
    """
    shifts = np.concatenate([analog.line_shifts_s(480, 26.0, rng) for _ in range(20)])
    by_hand = 0.25e-6 * 10.0 ** (-26.0 / 20.0) / 0.4 * math.sqrt(1.0 / 3.0)
    assert shifts.std() == pytest.approx(by_hand, rel=0.05)


def test_lines_tear_when_noise_hides_the_sync_pulse(rng):
    """12 dB: noise 0.251 * sqrt(0.5 / 4.2) = 0.087, half a pulse 0.2 is 2.31 sigma: 1.05 % of
    lines; none at 26 dB.
    """
    assert analog.tear_chance(12.0) == pytest.approx(0.0105, abs=2e-4)
    assert analog.tear_chance(26.0) < 1e-20
    torn = [np.abs(analog.line_shifts_s(480, 12.0, rng)).max() / PIXEL_S for _ in range(20)]
    assert np.median(torn) > 20.0  # some lines are off by a good part of a tenth of the line
    assert np.abs(analog.line_shifts_s(480, 26.0, rng)).max() / PIXEL_S < 2.0


def test_lines_move_by_their_shift():
    """Three pixels right is np.roll by three, away from the edge; the edge repeats."""
    picture = np.random.default_rng(0).integers(0, 256, (20, 40, 3), dtype=np.uint8)
    moved = analog.shift_lines(picture, np.where(np.arange(20) == 7, 3.0, 0.0))
    assert (moved[7, 3:] == picture[7, :-3]).all()
    assert (moved[7, :3] == picture[7, 0]).all()
    assert (np.delete(moved, 7, axis=0) == np.delete(picture, 7, axis=0)).all()


def test_odd_lines_show_the_field_before():
    """Two fields in turn; at 80 dB each line keeps its own level to the smear's rounding."""
    out = luma(AnalogVideo(80.0, dropouts=0.0).apply(flat(320, 200), 0, earlier=flat(320, 40)))
    assert out[0::2].mean() == pytest.approx(200.0, abs=1.0)
    assert out[1::2].mean() == pytest.approx(40.0, abs=1.0)


def test_fades_come_as_often_as_asked():
    """Poisson: 100 frames with a mean of 0.5; five sigma are 35. Two that overlap count as one."""
    video = AnalogVideo(60.0, dropouts=0.5)
    lost = [
        np.abs(np.diff(luma(video.apply(flat(64), k)).std(axis=1) > 20.0)).sum() / 2
        for k in range(100)
    ]
    assert sum(lost) == pytest.approx(50.0, abs=35.0)
    assert sum(lost) > 0


def test_same_seed_and_number_same_picture():
    """Determinism; another number or seed has other noise, uncorrelated."""
    first = AnalogVideo(26.0, seed=1).apply(flat(), 4)
    assert (first == AnalogVideo(26.0, seed=1).apply(flat(), 4)).all()
    for other in (
        AnalogVideo(26.0, seed=1).apply(flat(), 5),
        AnalogVideo(26.0, seed=2).apply(flat(), 4),
    ):
        assert np.corrcoef(luma(first).ravel(), luma(other).ravel())[0, 1] == pytest.approx(
            0.0, abs=0.02
        )


@pytest.mark.parametrize("shape", [(480, 640), (8, 64, 3), (48, 64, 4)])
def test_what_is_no_colour_picture_is_refused(shape):
    """Grey, too small, four channels."""
    with pytest.raises(InputError, match="analog video: expected"):
        AnalogVideo(26.0).apply(np.zeros(shape, np.uint8), 0)
    with pytest.raises(InputError, match=r"analog video: expected .* got \(\) list"):
        AnalogVideo(26.0).apply([[0, 0, 0]], 0)


def test_settings_out_of_range_are_refused():
    """One sentence each."""
    with pytest.raises(InputError, match="snr_db"):
        AnalogVideo(math.nan)
    with pytest.raises(InputError, match="frame_number"):
        AnalogVideo(26.0).apply(flat(64), -1)
    with pytest.raises(InputError, match="earlier"):
        AnalogVideo(26.0).apply(flat(64), 0, earlier=flat(128))
