"""Figures of an identification: whole PNG files that show what was found, or none at all."""

import struct

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import slice_time
from falconwing_kit.sysid.identify import identify
from falconwing_kit.tools.demo import figures
from falconwing_kit.tools.demo.figures import (
    LABELS,
    draw_identification,
    draw_intervals,
    draw_predictions,
    draw_residuals,
)
from falconwing_kit.tools.reports import gap_plots as plots
from tests.sysid.simulated import example_flight, example_found

NAMES = ("predicted.png", "residuals.png", "intervals.png")


def png_size(path):
    """Width and height from the header, after checking the first and the last chunk: the PNG
    standard.
    """
    content = path.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n" and content[12:16] == b"IHDR"
    assert content[-8:-4] == b"IEND"
    return struct.unpack(">II", content[16:24])


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """The three files, drawn once."""
    folder = tmp_path_factory.mktemp("figures")
    return draw_identification(example_found(), folder), folder


@pytest.fixture
def shown(monkeypatch):
    """What a figure shows: its axes are kept when it is written."""
    import matplotlib.figure

    kept = []
    save = matplotlib.figure.Figure.savefig
    monkeypatch.setattr(
        matplotlib.figure.Figure,
        "savefig",
        lambda self, *a, **k: (kept.append(self), save(self, *a, **k))[1],
    )
    return kept


def test_three_whole_files_and_nothing_else(drawn):
    """The paths that are returned, in their order; no temporary file is left."""
    paths, folder = drawn
    assert tuple(p.name for p in paths) == NAMES
    assert sorted(p.name for p in folder.iterdir()) == sorted(NAMES)


def test_files_are_as_large_as_they_say(drawn):
    """Inches times 130 dots per inch, legible in a page and below half a megabyte each."""
    (predicted, residuals, intervals), _ = drawn
    assert png_size(predicted) == (1430, 858)  # 11 x 6.6 inch
    assert png_size(residuals) == (1430, 442)  # 11 x 3.4 inch
    width, height = png_size(intervals)
    assert width == 988 and 800 < height < 1200  # 7.6 inch, 0.24 inch a parameter
    assert all(10_000 < p.stat().st_size < 500_000 for p in drawn[0])


def test_the_same_answer_is_the_same_picture(drawn, tmp_path):
    """No clock and no chance in a picture."""
    again = draw_identification(example_found(), tmp_path)
    assert [p.read_bytes() for p in again] == [p.read_bytes() for p in drawn[0]]


def test_every_axis_has_its_unit(shown, tmp_path):
    """Position in metres, angles in degrees, time in seconds, residuals in sigmas."""
    draw_identification(example_found(), tmp_path)
    predicted, residuals, intervals = shown
    texts = [
        [ax.get_xlabel() + "|" + ax.get_ylabel() for ax in f.axes if ax.axison]
        for f in (predicted, residuals)
    ]
    for label in LABELS:
        assert any(label in text for text in texts[0])
    assert sum("time [s]" in text for text in texts[0]) == 2
    assert all("[" in text for text in texts[1]) and any(
        "[sigma of the pose noise]" in text for text in texts[1]
    )
    assert "[%" in intervals.axes[0].get_xlabel()


def test_measured_points_are_the_table_and_the_line_goes_through_them(shown, tmp_path):
    """Heights drawn as points are those measured in the held-out time; the drawn line is within 0.2
    m of all but the outliers, two seconds ahead.
    """
    found = example_found()
    draw_predictions(found, tmp_path / "predicted.png")
    height = next(ax for ax in shown[0].axes if ax.get_ylabel() == "height [m]")
    points = np.concatenate(
        [line.get_xydata() for line in height.lines if line.get_marker() == "."]
    )
    lines = np.concatenate(
        [line.get_xydata() for line in height.lines if line.get_linestyle() == "-"]
    )
    windows = found.windows
    kept = found.held_out_index
    measured = np.where(windows.weight > 0, windows.pose, np.nan)[kept][..., 2].ravel()
    assert points[:, 1] == pytest.approx(measured, nan_ok=True)
    assert points[:, 0] == pytest.approx(windows.nodes[kept].ravel())
    off = np.abs(points[:, 1] - np.interp(points[:, 0], lines[:, 0], lines[:, 1]))
    assert np.nanquantile(off, 0.98) < 0.2


def test_intervals_are_those_found(shown, tmp_path):
    """Half widths in percent of an ordinary value, by hand for kT; what was not excited is marked
    as such.
    """
    found = example_found()
    draw_intervals(found, tmp_path / "intervals.png")
    ax = shown[0].axes[0]
    names = [label.get_text() for label in ax.get_yticklabels()]
    ends = {line.get_ydata()[0]: line for line in ax.lines if line.get_marker() in ("o", "s")}
    row = names.index("kT")
    low, high = found.interval("kT")
    assert ends[row].get_xdata()[0] == pytest.approx(
        50.0 * (high - low) / max(found.model.values["kT"], 9.0), rel=1e-6
    )
    weak = {names[int(y)] for y, line in ends.items() if line.get_marker() == "s"}
    assert weak == set(found.uncertainty.not_excited) - set(found.uncertainty.at_bound)
    assert set(names) == set(found.uncertainty.names) - set(found.uncertainty.at_bound)


def test_without_held_out_time_the_fitted_time_is_shown_and_said(shown, tmp_path):
    """A flight of 12 s: the same three files, and the titles tell."""
    found = identify([slice_time(example_flight()[2], 0.0, 12.0)])
    assert found.held_out is None
    draw_identification(found, tmp_path)
    titles = [ax.get_title(loc="left") for f in shown[:2] for ax in f.axes]
    assert sum("fitted data" in title for title in titles) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(NAMES)


def test_a_failure_while_drawing_leaves_nothing_behind(tmp_path, monkeypatch):
    """The second picture fails: the first is whole, of the second there is no trace, an older third
    stays.
    """
    (tmp_path / "intervals.png").write_bytes(b"older")
    monkeypatch.setattr(figures, "_autocorrelation", lambda *arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        draw_identification(example_found(), tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["intervals.png", "predicted.png"]
    assert (tmp_path / "intervals.png").read_bytes() == b"older"
    png_size(tmp_path / "predicted.png")


def test_a_failure_while_writing_keeps_the_older_picture(tmp_path, monkeypatch):
    """Half of a file was written when the disk was full: the old one is still there, and nothing
    half-written.
    """
    import matplotlib.figure

    def half(self, handle, **kind):
        handle.write(b"\x89PNG half")
        raise OSError(28, "No space left on device")

    path = tmp_path / "residuals.png"
    draw_residuals(example_found(), path)
    before = path.read_bytes()
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", half)
    with pytest.raises(InputError, match="disk is full"):
        draw_residuals(example_found(), path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["residuals.png"]


def test_a_missing_folder_is_said(tmp_path):
    """Figures do not make folders by themselves."""
    with pytest.raises(FileNotFoundError, match="expected a folder"):
        draw_intervals(example_found(), tmp_path / "none" / "intervals.png")


def test_drawing_changes_no_settings_of_the_caller(tmp_path):
    """A notebook's own matplotlib settings are as before, and no window is opened."""
    import matplotlib
    import matplotlib.pyplot

    before = dict(matplotlib.rcParams)
    with plots.figure(tmp_path / "a.png", 1, 2, (4.0, 2.0)) as axes:
        assert axes.shape == (1, 2)
        axes[0, 0].plot([0, 1], [0, 1])
    assert dict(matplotlib.rcParams) == before
    assert png_size(tmp_path / "a.png") == (520, 260)
    assert matplotlib.pyplot.get_fignums() == []
