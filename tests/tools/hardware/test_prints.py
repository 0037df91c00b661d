"""Prints have their true size: the PDF's vectors are read, joined, and found by OpenCV."""

import json

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.hardware import prints
from falconwing_kit.tools.hardware.prints import (
    CARD_MM,
    MARGIN_MM,
    PAPERS,
    checkerboard_poster,
    lay_out,
    marker_poster,
    pad_poster,
)
from falconwing_kit.vision.marker import Marker
from tests.tools.hardware.pdf_shapes import read_sheets

PX = 2  # pixels per millimetre of a joined poster
WIDE_MM = {"A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "Letter": (215.9, 279.4)}


def printed(tmp_path, *words):
    """The sheets behind the first page, and the record, of falconwing print."""
    assert main(["print", *words, "--out", str(tmp_path)]) == 0
    return read_sheets(next(tmp_path.glob("*.pdf")).read_bytes())


def joined(sheets, layout, poster):
    """Grey image of all sheets cut and laid together as the first page says: windows side by side,
    each over its left and upper neighbour's overlap of 10 mm.
    """
    w, h = layout.window
    step = np.array([w - 10.0, h - 10.0]) * PX
    whole = np.full(np.ceil((step * (layout.columns, layout.rows))[::-1] + 20 * PX).astype(int), 99)
    whole = whole.astype(np.uint8)
    edge = round(MARGIN_MM * PX)
    for sheet, page in zip(sheets, layout.pages, strict=True):
        image = sheet.picture(PX)[edge : edge + round(h * PX), edge : edge + round(w * PX)]
        y, x = round((page.row - 1) * step[1]), round((page.column - 1) * step[0])
        part = whole[y : y + image.shape[0], x : x + image.shape[1]]
        part[:] = image[: part.shape[0], : part.shape[1]]
    return whole


def detected(image):
    """Corners (4, 2) [mm] by OpenCV's detector of marker 7, which must be alone; nan for none."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(image)
    if ids is None:
        return np.full((4, 2), np.nan)
    assert ids.ravel().tolist() == [7]
    return (corners[0].reshape(4, 2) + 0.5) / PX


@pytest.mark.parametrize("paper", PAPERS)
def test_joined_marker_is_800_mm_wide(tmp_path, paper):
    """The paper's 80 cm: sides and diagonals of what OpenCV finds, within half a millimetre; 1:1
    pages have the paper's size [ISO 216].
    """
    sheets = printed(tmp_path, "marker", "--paper", paper)[1:]
    poster = marker_poster()
    layout = lay_out(poster, paper)
    for sheet in sheets:
        assert sorted((sheet.width, sheet.height)) == pytest.approx(WIDE_MM[paper], abs=0.01)
    corners = detected(joined(sheets, layout, poster))
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    assert sides == pytest.approx(np.full(4, 800.0), abs=0.5)
    diagonals = [np.linalg.norm(corners[k] - corners[k + 2]) for k in (0, 1)]
    assert diagonals == pytest.approx([800.0 * 2**0.5] * 2, abs=0.7)
    assert poster.width == pytest.approx(800.0 * 8 / 6)  # one cell of 800 / 6 on either side


def test_planted_scale_and_overlap_are_seen(tmp_path, monkeypatch):
    """Pages shrunk to 97 % as by a printer's "fit to page", or joined with another overlap than the
    one printed, miss the half millimetre: the test above can fail.
    """
    sheets = printed(tmp_path, "marker", "--paper", "A3")[1:]
    poster = marker_poster()
    layout = lay_out(poster, "A3")
    for sheet in sheets:
        sheet.shapes = [([0.97 * p for p in polygons], rgb) for polygons, rgb in sheet.shapes]
    corners = detected(joined(sheets, layout, poster))
    assert not abs(np.linalg.norm(corners[0] - corners[1]) - 800.0) <= 2.0
    monkeypatch.setattr(prints, "OVERLAP_MM", 14.0)
    other = lay_out(poster, "A3")
    corners = detected(joined(printed(tmp_path, "marker", "--paper", "A3")[1:], other, poster))
    assert not abs(np.linalg.norm(corners[0] - corners[1]) - 800.0) <= 2.0


@pytest.mark.parametrize("paper", PAPERS)
def test_checkerboard_is_found_with_its_squares(tmp_path, paper):
    """By OpenCV on the page as it is printed, at the corners that `falconwing bench` looks for."""
    (sheet,) = printed(tmp_path, "checkerboard", "--paper", paper)[1:]
    image = sheet.picture(4)
    found, corners = cv2.findChessboardCornersSB(image, (9, 6))
    assert found
    grid = corners.reshape(6, 9, 2) / 4
    square = checkerboard_poster((9, 6), paper).width / 10
    steps = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    assert steps == pytest.approx(np.full((6, 8), square), abs=0.2)
    assert steps.mean() == pytest.approx(square, rel=2e-3) and square == int(square) >= 23
    shrunk = cv2.resize(image, (fpv_camera().width, fpv_camera().height))
    assert cv2.findChessboardCorners(shrunk, (9, 6))[0]


def test_pad_has_the_scenes_size_colour_and_seams(tmp_path):
    """arena.toml, by hand: 13 x 2 m of (0.09, 0.27, 0.76), 12 seams 20 mm wide, one a metre. The
    area on all pages, counted once where they overlap, is the pad's.
    """
    sheets = printed(tmp_path, "pad", "--paper", "A2")[1:]
    poster = pad_poster()
    layout = lay_out(poster, "A2")
    blue = [rgb for sheet in sheets for _, rgb in sheet.shapes]
    assert set(blue) == {(0.09, 0.27, 0.76), (0.05, 0.15, 0.46)}
    image = joined(sheets, layout, poster)
    assert np.sum(image < 90) / PX**2 == pytest.approx(13000.0 * 2000.0, rel=1e-3)
    middle = image[image.shape[0] // 2]
    dark = int(0.299 * 12.75 + 0.587 * 38.25 + 0.114 * 117.3)  # of the seam, by hand
    assert np.sum(np.abs(middle.astype(int) - dark) <= 1) / PX == pytest.approx(12 * 20.0, abs=6.0)


@pytest.mark.parametrize("paper", ["A4", "A2"])
def test_check_lines_and_card_have_their_length(tmp_path, paper):
    """100 mm across and up on every page, ISO/IEC 7810's 85.60 x 53.98 mm on the first."""
    sheets = printed(tmp_path, "marker", "--paper", paper)
    for sheet in sheets:
        spans = [np.ptp(line, axis=0) for line in sheet.lines]
        for wanted in ((100.0, 0.0), (0.0, 100.0)):
            assert any(np.allclose(span, wanted, atol=0.02) for span in spans)
    assert any(np.allclose(np.ptp(line, axis=0), CARD_MM, atol=0.02) for line in sheets[0].lines)


def test_margins_hold_nothing_of_the_poster(tmp_path):
    """Filled shapes stay inside the window, so cutting at the marks loses nothing."""
    for sheet in printed(tmp_path, "marker")[1:]:
        for polygons, _ in sheet.shapes:
            low, high = np.min(np.concatenate(polygons), 0), np.max(np.concatenate(polygons), 0)
            assert (low >= MARGIN_MM - 0.01).all()
            assert (high <= np.array([sheet.width, sheet.height]) - MARGIN_MM + 0.01).all()


def test_another_marker_is_printed_as_asked(tmp_path, capsys):
    """By hand: 120 mm of 6 cells and a cell on either side are 160 mm, which fit on one A4 page."""
    assert main(["print", "marker", "--size-mm", "120", "--id", "3", "--json", "--out",
                 str(tmp_path)]) == 0  # fmt: skip
    record = json.loads(capsys.readouterr().out)
    assert record["pages"] == 2 and record["width_mm"] == pytest.approx(160.0)
    assert "id 3" in record["notes"][0]
    assert marker_poster(Marker(size=0.15)).width == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("marker", "--size-mm", "0.8"), "--size-mm: expected"),
        (("marker", "--id", "50"), "id from 0 to 49"),
        (("marker", "--size-mm", "nan"), "--size-mm: expected"),
        (("pad", "--size-mm", "800"), "expected it with `print marker`"),
        (("pad", "--length-mm", "90000"), "at most 1000 pages"),
        (("checkerboard", "--checkerboard", "9"), "inner corners such as 9x6"),
        (("checkerboard", "--checkerboard", "8x6"), "one even and one odd"),
        (("checkerboard", "--square-mm", "40"), "take larger paper"),
        (("checkerboard", "--checkerboard", "99x6"), "checkerboard corners in a row"),
    ],
)
def test_a_wrong_option_is_one_sentence(tmp_path, capsys, words, sentence):
    """What was expected, what came, what to do; nothing is written."""
    assert main(["print", *words, "--out", str(tmp_path / "x")]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1
    assert not list(tmp_path.rglob("*.pdf"))


def test_out_that_is_a_file_is_refused(tmp_path, capsys):
    """A folder is expected."""
    (tmp_path / "x").write_text("")
    assert main(["print", "marker", "--out", str(tmp_path / "x")]) == 2
    assert "expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize(("length", "passes"), [(100.0, True), (99.5, True), (99.0, False),
                                                (101.0, False), (97.0, False)])  # fmt: skip
def test_scale_of_a_print_is_judged(length, passes):
    """Half a millimetre of 100 by a tape; 97 % is a printer's "fit to page"."""
    fault = prints.print_scale_fault(length)
    assert (fault == "") == passes
    if not passes:
        assert f"{length - 100.0:+.1f} %" in fault and "100 %" in fault


@pytest.mark.parametrize("length", [float("nan"), -5.0, 0.0, 1e9])
def test_no_length_is_refused(length):
    """A length is a positive number of millimetres."""
    with pytest.raises(InputError, match="print check length"):
        prints.print_scale_fault(length)
