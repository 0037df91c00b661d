"""falconwing demo from its words to its files: page, figures, models and numbers, whole or not at
all; the failure of an engine is found in time, and README and the quick start show what it says.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import webbrowser
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.gap.close import Onset
from falconwing_kit.sysid.model_file import read_model
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.demo import approach, recorded
from tests.demo_run import WORDS, demo_run
from tests.stories.pages import OURS, ROOT, fenced, figures_of_the_manual, page
from tests.tools.reports.test_page import page_problems

pytestmark = pytest.mark.timeout(900)  # the whole demo, while a neighbour may take half the machine
FIGURES = (
    "flight_film",
    "flight_fpv",
    "flight_path",
    "flight_seen",
    "flight_sticks",
    "predicted",
    "residuals",
    "intervals",
    "gap_map",
    "gap_ranking",
    "gap_closed",
    "sport_cub_traces",
    "sport_cub_errors",
    "alfa_track",
    "alfa_predicted",
    "alfa_forecasts",
    "alfa_failure",
    "alfa_suspects",
)
OTHERS = (
    "approach.mcap",
    "index.html",
    "demo.json",
    "model_150g.toml",
    "model_sport_cub.toml",
    "model_alfa.toml",
)

ENGINE_OFF = 116.166  # s: the log's first "engine off" message, data/README.md


@pytest.fixture(scope="module")
def run():
    """The verb as it is typed, once for all tests."""
    return demo_run()


@pytest.fixture
def gap(run):
    """Its answer on the real flight's engine failure."""
    return run.found.alfa_gap


@pytest.fixture
def studied(run, monkeypatch):
    """The verb without the minute it takes: what was flown and found is handed over as it is."""
    monkeypatch.setattr(approach, "fly_approach", lambda *how, **more: run.approach)
    monkeypatch.setattr(recorded, "study_recorded_flights", lambda progress: run.found)


def complaint(capsys) -> str:
    """Standard error without the lines of progress, which a slow machine prints."""
    lines = capsys.readouterr().err.splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith("demo: "))


@contextlib.contextmanager
def small_disk(size):
    """A disk that refuses files above a size, by the kernel's own limit.

    Only around the call: the limit is the whole process's, and the runner's own report may go to a
        longer file.
    """
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_it_ends_well_and_writes_what_it_says(run):
    """Exactly these files, none of them half-written, in a folder that was not there before."""
    assert run.code == 0
    assert sorted(os.listdir(run.out)) == sorted([*OTHERS, *(f"{name}.png" for name in FIGURES)])
    for name in FIGURES:
        content = (run.out / f"{name}.png").read_bytes()
        assert content.startswith(b"\x89PNG\r\n\x1a\n") and content[-8:-4] == b"IEND", name


def test_terminal_says_what_is_simulated_and_what_is_real(run):
    """A number says what it rests on; the last line says what to type next."""
    lines = run.printed.splitlines()
    labels = [word for line in lines for word in ("SIMULATED", "REAL") if word in line]
    assert labels == ["SIMULATED", "SIMULATED", "REAL", "REAL"]
    indoor, outdoor = (
        next(k for k, line in enumerate(lines) if name in line) for name in ("Sport Cub", "ALFA")
    )
    assert indoor < outdoor and "Apache-2.0" in run.printed
    assert str((run.out / "index.html").resolve()) in run.printed
    assert lines[-1].startswith("next: falconwing identify")


def test_it_complains_of_nothing(run):
    """Both flights are fine, so a warning would only frighten a newcomer."""
    assert all(line.startswith("demo: ") for line in run.complained.splitlines())  # its progress


def test_demo_says_what_the_quick_start_shows(run):
    """The block of that page against a fresh run, line by line.

    Words must be the same. Numbers may differ by a quarter: another processor rounds differently,
    which the one-step fit on raw differences makes large; a change of the answer is larger than
    that.
    """
    (line,) = [line for line in OURS if " demo " in line]
    assert shlex.split(line)[1:] == list(WORDS) and run.code == 0
    (shown,) = fenced("text", page("quick_start.md"))
    number = re.compile(r"\d+\.?\d*")
    for ours, theirs in zip(run.printed.splitlines(), shown.splitlines(), strict=False):
        assert number.sub("#", ours).split() == number.sub("#", theirs).split()
        values, expected = ([float(x) for x in number.findall(text)] for text in (ours, theirs))
        assert values == pytest.approx(expected, rel=0.25)


def test_picture_is_small_and_can_be_made_again(run, tmp_path):
    """From what the demo found, to the same size in pixels; 300 kB are a second on a slow
    connection.
    """
    make = figures_of_the_manual()
    make.draw_identify_demo(run.found, tmp_path / "again.png")
    ours = ROOT / "manual" / "figures" / "identify_demo.png"
    assert ours.stat().st_size < 300_000
    size = slice(16, 24)  # width and height in a PNG's header
    assert ours.read_bytes()[size] == (tmp_path / "again.png").read_bytes()[size]


def test_numbers_tell_the_story_of_the_release(run):
    """Goals set before it was written: chi2 at most 1.3 held out; the real flight better than both
    guesses.
    """
    record = json.loads((run.out / "demo.json").read_text())
    small, real = record["simulated_flight"], record["real_flight"]
    assert list(record) == ["approach", "simulated_flight", "real_indoor_flight", "real_flight"]
    assert record["approach"]["success"] and "SIMULATED" in record["approach"]["made_by"]
    assert 0.7 < small["held_out_chi2_per_dof"] < 1.3
    assert small["one_step_chi2_per_dof"]["raw"] > small["one_step_chi2_per_dof"]["smoothed"] > 2.0
    errors = real["one_second_ahead_before_failure"]
    for guess in ("constant turn", "constant velocity"):
        for error in ("position_m", "attitude_deg"):
            assert errors["model"][error] < errors[guess][error]
    assert real["failure_time_s"] == 116.166  # the log's first "engine off", data/README.md
    assert real["parts_from_measurement_s"] > real["failure_time_s"]


def test_indoor_flight_is_forecast_and_its_source_named(run):
    """The kit's own limit: at most half of a constant turn's errors; the source as data/README.md
    has it, on the page before the outdoor flight and under the tag of measured data.
    """
    cub = json.loads((run.out / "demo.json").read_text())["real_indoor_flight"]
    errors = cub["two_seconds_ahead"]
    for guess in ("constant turn", "constant turn, corrected roll", "constant velocity"):
        for error in ("position_m", "attitude_deg"):
            assert errors["model"][error] < 0.5 * errors[guess][error]
    assert cub["describes_flight"] and cub["licence"] == "Apache-2.0"
    page = (run.out / "index.html").read_text(encoding="utf-8")
    title = '<span class="tag measured">measured</span>A real aircraft of 65 g, indoors'
    assert page.index("A 150 g aircraft") < page.index(title) < page.index("Engine failure")
    for words in ("https://github.com/CogniPilot/cubs2", "Apache-2.0", "CogniPilot Foundation"):
        assert words in page
    assert "<strong>describes this\nflight</strong>" in page


def test_page_is_whole_in_itself_and_shows_every_figure(run):
    """Read with the standard library's parser; all figures, each embedded and with words for who
    cannot see it.
    """
    text = (run.out / "index.html").read_text(encoding="utf-8")
    assert page_problems(text) == []
    assert text.count("<img ") == len(FIGURES)


def test_page_and_json_hold_the_same_numbers(run):
    """The page's tables, cell by cell, against the record beside it."""
    cells = _cells((run.out / "index.html").read_text(encoding="utf-8"))
    record = json.loads((run.out / "demo.json").read_text())
    small, real = record["simulated_flight"], record["real_flight"]
    assert ["multiple shooting", f"{small['held_out_chi2_per_dof']:.3g}"] == cells[0][:2]
    assert [row[1] for row in cells[1:3]] == [
        f"{chi2:.3g}" for chi2 in small["one_step_chi2_per_dof"].values()
    ]
    sizes = small["gap"]["parameters"]
    assert [row[1] for row in cells[3:5]] == [f"{size['value']:.3f}" for size in sizes.values()]
    forecasts = [
        *record["real_indoor_flight"]["two_seconds_ahead"].values(),
        *real["one_second_ahead_before_failure"].values(),
    ]
    for row, errors in zip(cells[5:], forecasts, strict=True):
        assert row[1:] == [
            f"{errors['position_m']:.2f}",
            f"{errors['attitude_deg']:.1f}",
            str(errors["forecasts"]),
        ]


def test_hidden_wind_is_named_and_its_truth_told_after(run):
    """The simulator's wind was 0.0924 and 0.4370 m/s; the goal of the kit is 0.05 m/s, and 90 % of
    the gap.
    """
    gap = json.loads((run.out / "demo.json").read_text())["simulated_flight"]["gap"]
    assert (gap["verdict"], gap["effects"], gap["truth"]["effects"]) == (
        "named",
        ["wind"],
        ["wind"],
    )
    assert gap["since"] is None
    for name, truth in (("wind_x", 0.0924), ("wind_y", 0.4370)):
        assert gap["truth"]["parameters"][name] == truth
        assert gap["parameters"][name]["value"] == pytest.approx(truth, abs=0.05)
    assert gap["gap"]["after"] - gap["gap"]["calm"] < 0.1 * (
        gap["gap"]["before"] - gap["gap"]["calm"]
    )
    page = (run.out / "index.html").read_text()
    assert page.index("Missing: wind") < page.index("The truth, which no fit used")


def test_page_owns_up_to_the_attitude_after_the_failure(run):
    """Worked out here from the forecasts on the logged throttle that lie after the failure: tens of
    degrees.
    """
    alfa = run.found.alfa
    after = alfa.logged.t > alfa.failure_time + 1.0
    rms = np.degrees(np.sqrt(np.mean(np.sum(alfa.logged.error_attitude[after] ** 2, axis=1))))
    assert rms > 20.0
    assert f"{rms:.0f}° rms at a 1 s horizon" in (run.out / "index.html").read_text(
        encoding="utf-8"
    )


def test_failure_shows_without_the_throttle(gap):
    """Recorded data: the engine is off, and the loss of thrust has far more evidence than chance
    finds before it.
    """
    assert gap.verdict != "none"
    assert gap.thrust_loss.delta_bic > 3.0 * gap.threshold
    assert "thrust_loss" in [s.effect.name for s in gap.chosen]


def test_failure_is_dated_within_two_seconds(gap):
    """The log's engine-off message, which the fit has not read, is the truth; two seconds are the
    goal of the kit.
    """
    loss = gap.thrust_loss
    assert loss.time == pytest.approx(ENGINE_OFF, abs=2.0)
    assert loss.earliest < ENGINE_OFF < loss.latest


def test_all_of_the_thrust_is_gone(gap):
    """The engine is off, so the share lost is one; half of it gone would not do."""
    loss = gap.thrust_loss
    assert loss.low95 < 1.0 < loss.high95
    assert loss.value == pytest.approx(1.0, abs=0.3)


def test_what_the_poses_do_not_tell_is_not_told(gap):
    """Drag and thrust slow the aircraft alike at one throttle: while both are within 10 of each
    other none is named.
    """
    gains = {s.effect.name: s.delta_bic for s in gap.hypotheses}
    rivals = [name for name, delta_bic in gains.items() if delta_bic > max(gains.values()) - 10.0]
    assert (gap.verdict == "named") == (len(rivals) == 1)
    assert [s.effect.name for s in gap.chosen] == rivals


def test_logged_throttle_explains_as_much_as_any_effect_with_nothing_fitted(gap):
    """The throttle's servo closes with the engine; each effect had a size and a time to choose, the
    log had none.
    """
    best = gap.hypotheses[0].delta_bic
    assert gap.logged_throttle_gain == pytest.approx(best, abs=0.25 * best)
    assert gap.after < gap.before


def test_stretch_ends_where_a_stick_leaves_its_healthy_range(run, gap):
    """Worked out here from the table: elevator above its largest value before the failure, 0.185,
    at 125.55 s.
    """
    table = run.found.alfa.table
    healthy = table.t < ENGINE_OFF
    high = table.commands[healthy, 2].max()
    assert gap.end == table.t[~healthy & (table.commands[:, 2] > high)][0]
    assert np.all(table.commands[(table.t < gap.end), 2] <= high)


def test_warnings_are_text_and_no_markup(run, tmp_path):
    """A flight's name may hold anything; it must not become part of the page's markup."""
    small = replace(run.found.small, warnings=("<b>a.csv</b>: 3 < 4 & so on",))
    recorded.write_recorded_flights(replace(run.found, small=small), tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert "&lt;b&gt;a.csv&lt;/b&gt;: 3 &lt; 4 &amp; so on" in page and "<b>a.csv" not in page


@pytest.mark.parametrize(
    ("verdict", "detection_time", "words"),
    [
        (
            "named",
            None,
            ("<strong>Missing: NAME.</strong>", "stay within the errors before the failure"),
        ),
        ("none", 120.0, ("No effect is significant", "At 120.0 s")),
        (
            "ambiguous",
            120.0,
            ("Missing: NAME or NAME; ambiguous", "their error exceeds the maximum before it"),
        ),
    ],
)
def test_page_has_words_for_every_outcome(run, tmp_path, verdict, detection_time, words):
    """The same findings under each verdict of the real flight, with an onset of the wind and
    without a landing.
    """
    first, *others = run.found.alfa_gap.hypotheses
    hypotheses = (
        first,
        *([first] if verdict == "ambiguous" else []),
        *(replace(s, delta_bic=-1e6) for s in others),
    )
    wind = run.found.small_gap.naming.chosen[0].effect
    found = replace(
        run.found,
        small_gap=replace(run.found.small_gap, since=Onset(wind, 12.3, 11.0, 13.0, 40.0, None)),
        alfa=replace(run.found.alfa, detection_time=detection_time),
        alfa_gap=replace(run.found.alfa_gap, verdict=verdict, hypotheses=hypotheses),
    )
    recorded.write_recorded_flights(found, tmp_path)
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    name = first.effect.name.replace("_", " ")
    assert all(each.replace("NAME", name) in page for each in (*words, "It set in at 12.3 s"))
    assert "splat hall" not in page and page_problems(page) == []


@pytest.mark.parametrize(
    ("name", "flight"),
    [
        ("150g", "case08_calm.csv"),
        ("sport_cub", "sport_cub.csv"),
        ("alfa", "alfa_engine_failure.csv"),
    ],
)
def test_models_can_be_read_back(run, name, flight):
    """To the last bit of every value; the file names the flight that it rests on."""
    found = {
        "150g": run.found.small,
        "sport_cub": run.found.cub.found,
        "alfa": run.found.alfa.found,
    }[name]
    file = read_model(run.out / f"model_{name}.toml")
    assert file.model.form == found.model.form
    assert dict(file.model.values) == dict(found.model.values)
    assert file.names == found.uncertainty.names
    assert np.allclose(
        file.covariance, found.uncertainty.covariance, rtol=1e-5, atol=0.0
    )  # six digits are kept
    assert [Path(each).name for each in file.flights] == [flight]


@pytest.fixture
def opened(monkeypatch):
    """The pages that the browser was asked to open; none opens."""
    pages = []
    monkeypatch.setattr(webbrowser, "open", pages.append)
    return pages


def test_json_is_the_record_and_nothing_else(run, studied, opened, capsys, tmp_path):
    """What goes to another program is one JSON value, and headless opens no browser."""
    assert main(["demo", "--headless", "--json", "--out", str(tmp_path)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert Path(printed.pop("page")) == tmp_path.resolve() / "index.html"
    assert printed == json.loads((run.out / "demo.json").read_text())
    assert opened == []


def test_newcomer_sees_the_page(studied, opened, tmp_path):
    """Without --headless the browser opens the live page and, at the end, the one that stays."""
    assert main(["demo", "--out", str(tmp_path), "--port", "18432"]) == 0
    live, page = opened
    assert (
        live.startswith("http://127.0.0.1:")
        and page == (tmp_path / "index.html").resolve().as_uri()
    )


def test_ctrl_c_in_the_approach_ends_the_demo(monkeypatch, capsys, tmp_path):
    """While its third image is made: exit 130 as for every verb, no fits after it, and nothing is
    written.
    """

    class Interrupted(approach.RenderedView):
        def next_image(self, t):
            image = super().next_image(t)
            if image.sequence == 2:
                signal.raise_signal(signal.SIGINT)
            return image

    monkeypatch.setattr(approach, "RenderedView", Interrupted)
    monkeypatch.setattr(
        recorded, "study_recorded_flights", lambda progress: pytest.fail("it went on")
    )
    assert main(["demo", "--headless", "--out", str(tmp_path / "out")]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert os.listdir(tmp_path / "out") == []


def test_full_disk_leaves_nothing_half_written(studied, capsys, tmp_path):
    """No figure fits on this disk: one sentence with the way out, exit code 2, and the folder is
    empty.
    """
    with small_disk(20_000):
        code = main(["demo", "--headless", "--out", str(tmp_path / "out")])
    error = complaint(capsys)
    assert code == 2
    assert "the disk is full" in error and "free some space" in error and error.count("\n") == 1
    assert os.listdir(tmp_path / "out") == []


def test_disk_that_fills_up_before_the_page_keeps_the_page_of_before(studied, capsys, tmp_path):
    """Every figure fits, the page does not: what is there is whole, the older page stays to the
    byte.
    """
    (tmp_path / "index.html").write_text("the page of yesterday")
    with small_disk(2_500_000):
        code = main(["demo", "--headless", "--out", str(tmp_path)])
    assert code == 2
    assert "index.html: the disk is full" in capsys.readouterr().err
    assert (tmp_path / "index.html").read_text() == "the page of yesterday"
    assert [name for name in os.listdir(tmp_path) if name.endswith(".part")] == []
    json.loads((tmp_path / "demo.json").read_text())
    read_model(tmp_path / "model_150g.toml")


def test_no_right_to_write_is_one_sentence(studied, monkeypatch, capsys, tmp_path):
    """The system's refusal is simulated, since the tests may run as a privileged user."""

    def refuse(source, target):
        raise PermissionError(13, "Permission denied", str(target))

    monkeypatch.setattr(os, "replace", refuse)
    assert main(["demo", "--headless", "--out", str(tmp_path)]) == 2
    error = complaint(capsys)
    assert "no right to write" in error and error.count("\n") == 1
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("below", ["", "deeper"])
def test_file_in_place_of_the_folder_is_one_sentence(capsys, tmp_path, below):
    """Said before the work begins, so nobody waits for it; the file stays as it is."""
    (tmp_path / "taken").write_text("mine")
    assert main(["demo", "--headless", "--out", str(tmp_path / "taken" / below)]) == 2
    error = complaint(capsys)
    assert "taken" in error and error.count("\n") == 1
    assert (tmp_path / "taken").read_text() == "mine"


def _cells(text: str) -> list[list[str]]:
    """The rows of all tables of a page, headers left out."""
    rows: list[list[str]] = []

    class Cells(HTMLParser):
        inside = False

        def handle_starttag(self, tag, attributes):
            if tag == "tr":
                rows.append([])
            self.inside = tag == "td"
            if self.inside:
                rows[-1].append("")

        def handle_endtag(self, tag):
            self.inside = self.inside and tag != "td"

        def handle_data(self, data):
            if self.inside:
                rows[-1][-1] += data

    Cells().feed(text)
    return [row for row in rows if row]
