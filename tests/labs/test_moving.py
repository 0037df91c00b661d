"""Films of the labs: small enough, every picture in it, its lines in their colours; sliders."""

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading import (
    figure_with_sliders,
    moving,
    moving_figure,
    moving_pictures,
    plan_view,
    side_view,
)
from falconwing_kit.tools.grading.find import load_module

ROOT = Path(__file__).resolve().parents[2]


def test_a_film_has_every_picture_for_its_time_and_never_ends():
    """Twelve different grey levels, 0.05 s each: read back by Pillow."""
    film = Image.open(io.BytesIO(moving.gif([np.full((8, 8), 20 * k) for k in range(12)], 0.05)))
    assert film.n_frames == 12 and film.info["duration"] == 50 and film.info["loop"] == 0
    film.seek(5)
    assert abs(int(np.asarray(film.convert("L"))[4, 4]) - 100) <= 20


def test_a_film_of_noise_fits_into_its_limit(monkeypatch):
    """Noise does not compress: 16 pictures of 24 x 32 px are more than 8 kB at 16 colours."""
    monkeypatch.setattr(moving, "LARGEST", 4_000)
    pictures = np.random.default_rng(0).integers(0, 256, (16, 24, 32, 3), dtype=np.uint8)
    data = moving.gif(pictures, 0.1)
    film = Image.open(io.BytesIO(data))
    assert len(data) <= 4_000 and 2 <= film.n_frames < 16
    assert film.n_frames * film.info["duration"] == 1600  # the film lasts as long as before


def test_no_picture_and_two_sizes_are_refused():
    """A film of nothing, and one whose pictures do not fit each other."""
    with pytest.raises(InputError, match="at least one"):
        moving.gif([], 0.1)
    with pytest.raises(InputError, match=r"one size, got \(4, 6\) and \(5, 6\)"):
        moving.gif([np.zeros((4, 6)), np.zeros((5, 6, 3))], 0.1)


def test_a_thin_line_keeps_its_colour_beside_a_photograph():
    """Green #009E73 beside 100,000 brown pixels; a palette by area alone would drop it."""
    figure = Figure(figsize=(4.0, 3.0))
    photo, lines = figure.subplots(1, 2)
    photo.imshow(np.random.default_rng(0).integers(90, 160, (40, 40, 3), dtype=np.uint8))
    (line,) = lines.plot([0, 1], [0, 1], color="#009E73")
    shown = moving_figure(figure, lambda k: line.set_data([0, 1], [0, k]), 3, 0.1, "a line")
    film = Image.open(io.BytesIO(shown.data))
    film.seek(2)
    pixels = np.asarray(film.convert("RGB")).reshape(-1, 3).astype(int)
    assert (np.abs(pixels - [0x00, 0x9E, 0x73]).max(axis=1) < 24).sum() > 50


def test_lamps_of_a_photograph_do_not_turn_violet():
    """Lab 13's first flight: no line is in it, so none of the 64 colours is lost to one.

    With all colours of lines in the palette 1536 pixels of lamps were violet, 421 in the source,
    and colours were 7.1 levels of 255 off; half of both would be seen by nobody.
    """
    given = load_module(ROOT / "labs" / "lab13_fly_your_own", "given")
    flights = given.load_flights()
    source = flights["images"][: flights["starts"][1]].astype(int)
    film = Image.open(io.BytesIO(moving.gif(source.astype(np.uint8), 0.1)))
    shown = np.array([_frame(film, number) for number in range(len(source))])
    assert _violet(shown).sum() < 1000 and np.abs(shown - source).max(axis=3).mean() < 5.0


def _frame(film, number):
    film.seek(number)
    return np.asarray(film.convert("RGB")).astype(int)


def _violet(pixels):
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return (red - green > 30) & (blue - green > 15)


def test_a_film_has_words_and_its_width():
    """What a screen reader says, and the size on the page."""
    shown = moving_pictures([np.zeros((10, 20, 3))], 0.1, "nothing to see", 300)
    html = shown._repr_mimebundle_()
    assert "image/gif" in (html[0] if isinstance(html, tuple) else html)
    assert shown.alt == "nothing to see" and shown.width == 300


def test_outlines_turn_and_climb_as_the_kit_counts_angles():
    """Yaw to the right from +x leads to -y (y is left); pitch up lifts the nose."""
    nose = plan_view(1.0, 2.0, np.pi / 2.0, span=1.0)[:, 0]
    assert nose == pytest.approx([1.0, 2.0 - 0.45])
    right_wing = plan_view(0.0, 0.0, 0.0, span=1.0)
    assert right_wing[1].min() == -0.5 and right_wing[1].max() == 0.5
    assert side_view(0.0, 3.0, np.pi / 2.0, length=1.0)[:, 0] == pytest.approx([0.0, 3.5])


def slope(figure, bank_deg, hall_m):
    """A figure of two numbers: a line whose slope is the first, as wide as the second."""
    figure.subplots().plot([0.0, hall_m], [0.0, bank_deg * hall_m])


SLIDERS = {
    "bank_deg": moving.Slider("bank [deg]", 10.0, 70.0, 30.0),
    "hall_m": moving.Slider("hall [m]", 10.0, 40.0, 20.0, 2.0),
}


def shown_by(monkeypatch, draw=slope):
    """What a notebook gets of a figure with sliders: each thing displayed or put in its place."""
    shown = []
    handle = SimpleNamespace(update=lambda each: shown.append(each))
    display = lambda each, **_: shown.append(each) or handle  # noqa: E731
    monkeypatch.setattr("IPython.display.display", display)
    figure_with_sliders(draw, "a line", (3.0, 2.0), **SLIDERS)
    return shown


def test_without_sliders_the_figure_stands_still_and_says_at_which_numbers(monkeypatch, capsys):
    """ipywidgets is made unimportable; the picture is a PNG with words."""
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    (picture,) = shown_by(monkeypatch)
    assert picture.data[:8] == b"\x89PNG\r\n\x1a\n" and picture.alt == "a line"
    said = capsys.readouterr().out
    assert "bank [deg] = 30" in said and "hall [m] = 20" in said and "ipywidgets" in said


def test_a_moved_slider_draws_the_figure_anew(monkeypatch):
    """The drawing function gets the moved number and the others as they stand."""
    widgets = pytest.importorskip("ipywidgets")
    drawn, parts = [], []

    class Taken(widgets.FloatSlider):
        def __init__(self, **given):
            super().__init__(**given)
            parts.append(self)

    monkeypatch.setattr(widgets, "FloatSlider", Taken)

    def draw(figure, **values):
        drawn.append(values.copy())
        slope(figure, **values)

    box, first = shown_by(monkeypatch, draw)
    assert "Sliders, in a running notebook. a line" in box["text/plain"]  # where no widget is shown
    assert "application/vnd.jupyter.widget-view+json" in box
    assert [each.description for each in parts] == ["bank [deg]", "hall [m]"]
    assert parts[1].min == 10.0 and parts[1].max == 40.0 and parts[1].step == 2.0
    parts[0].value = 45.0
    parts[1].value = 30.0
    wanted = [(30.0, 20.0), (45.0, 20.0), (45.0, 30.0)]
    assert drawn == [{"bank_deg": bank, "hall_m": hall} for bank, hall in wanted]
    assert first.data[:4] == b"\x89PNG"


def test_a_figure_that_stops_leaves_no_sliders(monkeypatch):
    """As where a function is not written: the cell says so, and nothing is shown."""
    shown = []
    monkeypatch.setattr("IPython.display.display", lambda each, **_: shown.append(each))
    with pytest.raises(ZeroDivisionError):
        figure_with_sliders(lambda figure, **_: 1 / 0, "nothing", (3.0, 2.0), **SLIDERS)
    assert shown == []
