"""The gap page in a browser: no scrolling sideways on a phone, no figure cut on A4."""

import re
import zlib

import pytest

from falconwing_kit.tools.reports.gap_report import PAGE
from falconwing_kit.tools.reports.page import figure, write_page
from tests.chromium import headless_chromium

LONG = "moment_throttle_and_aileron_x_with_a_name_that_does_not_end"
WORDS = "A sentence of some length that a narrow page has to break. " * 4
RECORD = {
    "headline": "Something is missing, and it is not in the catalogue",
    "flights": {"calm": f"{LONG}_calm.csv", "flight": f"{LONG}.csv"},
    "warnings": [f"calm flight: {LONG} is not excited"] * 12,
    "seconds": {"calm": 5.0},
    "threshold": 10.0,
}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page with long words in every place, and figures of the size of the report's."""
    folder = tmp_path_factory.mktemp("page")
    sizes = {"typical": 5.7, "worst": 5.7, "closed": 4.4, "ranking": 3.5, "map": 5.2, "where": 5.7}
    figures = {name: folder / f"{name}.png" for name in sizes}
    for name, height in sizes.items():
        with figure(figures[name], 1, 1, (4.4, height), dpi=170) as axes:
            axes[0, 0].set_title(name)  # no two are the same image
    equation = "dp/dt → dp/dt + 0.0123/m^2 V^2 rudder aileron throttle " * 3
    write_page(
        folder / "report.html", PAGE, figures=figures, record=RECORD, verdict="outside",
        traces={"typical": WORDS, "worst": WORDS}, sentence=WORDS, chosen=[], load=None,
        discrepancy={
            "equation": equation, "where": "with rudder", "resembles": None, "gap_closed": 0.7,
            "rows": [(LONG, "0.0123/m^2", "0.01 to 0.02")],
        },
        strained=WORDS, since=None, sizes=[(WORDS, LONG, "−0.0123/m^2", "−0.0134 to −0.0112")],
        gap=[("calm flight", "1.04", "4.4 cm", "0.57°")], before_after=WORDS, contest=WORDS,
        second_effect="", runner_up=WORDS, where=WORDS, next_flight=WORDS,
        additions=[(LONG, WORDS, "0.0123 rad/s^2")], noise=WORDS,
        detectable=[(LONG, WORDS, "0.0123 rad/s^2", "0.0101 rad/s^2")],
    )  # fmt: skip
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium."""
    with headless_chromium() as running:
        yield running


@pytest.mark.parametrize("width", [320, 360, 1280])
def test_nothing_reaches_beyond_the_screen(browser, page, width):
    """Phones of 320 and 360 px, and a desktop: no element ends right of the screen, figures scale,
    and only a phone folds the tables.
    """
    screen = browser.new_page(viewport={"width": width, "height": 740})
    screen.goto(page.as_uri())
    beyond = screen.evaluate(
        "[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right >"
        " innerWidth + 1).map(e => e.tagName)"
    )
    assert beyond == []
    assert screen.evaluate("document.documentElement.scrollWidth") == width
    widths = screen.evaluate("[...document.images].map(e => e.getBoundingClientRect().width)")
    assert len(widths) == 6 and all(250.0 < w <= 4.4 * 96.0 + 1.0 for w in widths)
    folded = screen.evaluate("getComputedStyle(document.querySelector('thead')).display")
    assert folded == ("none" if width < 500 else "table-header-group")
    screen.close()


def test_a4_prints_every_figure_whole(browser, page):
    """Printed to PDF: A4, at most eight sheets, and each of the six images is drawn once; a figure
    that a page break cuts is drawn on two sheets.
    """
    screen = browser.new_page()
    screen.goto(page.as_uri())
    pdf = screen.pdf(prefer_css_page_size=True)
    screen.close()
    boxes = re.findall(rb"/MediaBox \[([^\]]*)\]", pdf)
    assert 3 <= len(boxes) <= 8
    for box in boxes:
        width, height = list(map(float, box.split()))[2:]
        assert (width, height) == pytest.approx((595.0, 842.0), abs=1.0)  # 210 x 297 mm in points
    streams = [
        zlib.decompress(found)
        for found in re.findall(rb"/FlateDecode.*?stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
        if found[:1] == b"\x78"
    ]
    drawn = [name for s in streams for name in re.findall(rb"/(X\d+) Do", s)]
    assert len(drawn) == len(set(drawn)) == 6
