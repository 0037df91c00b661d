"""falconwing report: a toy class graded and reported, for students, graders and other systems."""

import csv
import html
import json
import shutil

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli import grade as grading
from falconwing_kit.tools.cli.grade import Grade
from falconwing_kit.tools.cli.report import Report
from falconwing_kit.tools.grading.course import looks
from falconwing_kit.tools.grading.course.figures import missing_for_running
from falconwing_kit.tools.grading.sandbox import probe
from tests.chromium import headless_chromium
from tests.tools.grading import toys
from tests.tools.grading.test_figures import DRAW, b64, png

pytestmark = [
    toys.needs_sandbox,
    pytest.mark.skipif(bool(missing_for_running()), reason='pip install -e ".[labs]"'),
    pytest.mark.timeout(600),
]
WRONG = "def stretch(x, gain):\n    return gain * x - COHORT['offset']"
# What hidden cases ask is told by an error's words, a text in place of numbers, and whatever the
# function prints.
TELLS = (
    "def stretch(x, gain):\n"
    "    print('LEAK', gain, [round(float(each), 3) for each in np.atleast_1d(x)])\n"
    "    if gain > 1.5:\n        raise ValueError(f'LEAK {gain}')\n"
    "    return f'LEAK {gain}'"
)
MARKUP = "<img src=x onerror=alert(1)>"


def notebook(stretch, *more):
    return toys.notebook_bytes(
        toys.HEAD, stretch, toys.BRAKE, toys.cell(DRAW, figure="figure"), *more
    )


@pytest.fixture(scope="module")
def graded(tmp_path_factory):
    """Four students of the toy lab, graded: right, wrong sign, one who leaks cases, one empty."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grading, "_require_sandbox", lambda: None)
        patch.setattr(probe, "probe_sandbox", lambda: [])
        folder = tmp_path_factory.mktemp("course")
        folder.chmod(0o755)
        students = folder / "students"
        students.mkdir()
        stored = toys.cell("1", figure="figure") | {
            "outputs": [{"data": {"image/png": b64(png())}}]
        }
        class_ = {
            "ada": notebook(toys.STRETCH, toys.cell(MARKUP, "markdown", answer="q1")),
            f"bob {MARKUP[1:4]}": notebook(WRONG),
            "cleo": notebook(TELLS),
            "=dan": toys.notebook_bytes(stored),
        }
        for name, data in class_.items():
            (students / f"{name}.ipynb").write_bytes(data)
        assert Grade(str(toys.LAB), (students,), folder / "grades", json=True).run() == 0
        yield folder


@pytest.fixture(scope="module")
def report(graded):
    """The whole report, once."""
    words = dict(
        submissions=(graded / "students",), to=("gradescope", "csv"), before=graded / "students"
    )
    assert Report(str(toys.LAB), graded / "grades", graded / "report", **words).run() == 0
    return graded / "report"


def rows(path):
    with path.open(newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def feedback(report, student):
    (page,) = report.glob(f"feedback/{student}*.html")
    return page.read_text(encoding="utf-8")


def test_everybody_has_a_line_and_a_page(report):
    """By hand: 75, 25, 25 and 0 by the machine; nobody has a total before a person has graded."""
    book = rows(report / "gradebook.csv")
    assert {row["student"]: float(row["machine"]) for row in book} == {
        "'=dan": 0,
        "ada": 75,
        "bob img": 25,
        "cleo": 25,
    }
    assert {row["total"] for row in book} == {""}
    assert len(list((report / "feedback").glob("*.html"))) == 4
    assert rows(report / "platform.csv") == []
    score = {
        path.parent.name[:4]: json.loads(path.read_text())["score"]
        for path in report.glob("gradescope/*/*.json")
    }
    assert score == {"dan-": 0.0, "ada": 75.0, "bob_": 25.0, "cleo": 25.0}


def test_feedback_says_what_to_look_at(report):
    """The public claim and its hint, the state, and the function's output in this public case."""
    page = feedback(report, "bob")
    assert (
        "0 of 4 hidden cases right; it returned an answer of the right form with wrong numbers (4)"
        in page
    )
    assert "✓ passed:" in page and "a larger number gives a larger one" in page
    assert "consider limits, signs and shapes" in page
    assert "<h2>" not in feedback(report, "ada")
    assert "is not written yet" in feedback(
        report, "dan"
    ) or "was not found in the notebook" in feedback(report, "dan")


def test_feedback_gives_no_hidden_case_away(report):
    """The function tells what it is asked, in errors, answers and prints.

    Nothing of it reaches what students get.
    """
    assert "raised ValueError" in feedback(report, "cleo")
    given = [*report.glob("feedback/*"), *report.glob("gradescope/*/*"), report / "gradebook.csv"]
    assert len(given) == 9
    assert not [path for path in given if b"LEAK" in path.read_bytes()]


def test_nothing_of_a_student_is_markup(report):
    """Names and answers are shown as they are typed.

    No page loads anything or runs a student's script.
    """
    pages = [path.read_text(encoding="utf-8") for path in report.rglob("*.html")]
    assert not [page for page in pages if "onerror=" in page.replace("&lt;img src=x onerror=", "")]
    assert not [
        page for page in pages if "http://" in page or "https://" in page or 'src="//' in page
    ]


def test_class_is_compared(report):
    """The earlier class is this one, so the longer function has its twin there.

    One line is like any other one line.
    """
    pairs = {
        (row["this"], row["and this"]): row["functions and share"]
        for row in rows(report / "alike.csv")
    }
    assert pairs["cleo", "before: cleo"] == "stretch 100 %"
    assert not [pair for pair in pairs if "ada" in pair]
    assert "no proof, and no points depend on it" in (report / "report.html").read_text(
        encoding="utf-8"
    )
    assert "missing (1)" in (report / "report.html").read_text(encoding="utf-8")


def test_rubric_page_has_the_figures(report):
    """Drawn by running the notebook.

    The one who drew nothing shows what was stored, and it is said.
    """
    page = (report / "rubric.html").read_text(encoding="utf-8")
    assert page.count("from a run of the notebook in the sandbox") == 3
    assert page.count("as stored in the notebook; a new run drew no figure here") == 1
    assert len(list((report / "figures").glob("*.png"))) == 4


def test_report_goes_on_where_it_was(report, graded, monkeypatch):
    """Nothing is looked at twice, and the same comes out: the boxes are not even asked."""
    monkeypatch.setattr(probe, "probe_sandbox", lambda: [])
    monkeypatch.setattr(looks, "run_notebook", lambda *words: pytest.fail("looked again"))
    before = {path: path.read_bytes() for path in report.rglob("*") if path.is_file()}
    words = dict(
        submissions=(graded / "students",),
        to=("gradescope", "csv"),
        before=graded / "students",
        workers=1,
    )
    assert Report(str(toys.LAB), graded / "grades", report, **words).run() == 0
    assert {path: path.read_bytes() for path in report.rglob("*") if path.is_file()} == before


def test_without_a_box_nothing_is_run(graded, tmp_path, monkeypatch, capsys):
    """A note, stored figures, and the public claims without outcomes."""
    hole = probe.ProbeResult("network", False, "open")
    monkeypatch.setattr(probe, "probe_sandbox", lambda: [hole])
    for name in ("run_notebook", "run_checks"):
        monkeypatch.setattr(looks, name, lambda *words: pytest.fail("a student's code was run"))
    words = dict(submissions=(graded / "students",), workers=1)
    assert Report(str(toys.LAB), graded / "grades", tmp_path / "r", **words).run() == 0
    assert (
        "! network: open: public checks were not run, and figures are as stored"
        in capsys.readouterr().out
    )
    assert (tmp_path / "r" / "rubric.html").read_text(encoding="utf-8").count("no figure") == 3
    assert "as stored in the notebook, which was not run" in (
        tmp_path / "r" / "rubric.html"
    ).read_text(encoding="utf-8")
    assert "A correct function fulfils all of these:" in feedback(tmp_path / "r", "bob")


def test_changed_submission_is_not_taken_for_the_graded_one(graded, tmp_path, monkeypatch, capsys):
    """Feedback on what was never graded would be another's."""
    monkeypatch.setattr(probe, "probe_sandbox", lambda: [])
    shutil.copytree(graded / "students", tmp_path / "now")
    (tmp_path / "now" / "ada.ipynb").write_bytes(notebook(WRONG))
    (tmp_path / "now" / "cleo.ipynb").unlink()
    monkeypatch.setattr(looks, "run_notebook", lambda *words: None)
    assert (
        Report(
            str(toys.LAB),
            graded / "grades",
            tmp_path / "r",
            submissions=(tmp_path / "now",),
            workers=1,
        ).run()
        == 0
    )
    said = capsys.readouterr().out
    assert "! ada: changed since it was graded" in said and "! cleo: not found" in said


def test_wrong_records_are_refused(graded, tmp_path):
    """Another salt would draw other numbers; another folder has no records."""
    with pytest.raises(InputError, match="--course or --salt that this lab was graded with"):
        Report(
            str(toys.LAB), graded / "grades", tmp_path / "r", salt="another secret of a course"
        ).run()
    with pytest.raises(InputError, match="found no run in it"):
        Report(str(toys.LAB), graded / "students", tmp_path / "r").run()


@pytest.mark.alone
def test_points_typed_in_the_browser_reach_the_gradebook(report, graded, tmp_path):
    """In headless Chromium: typed, kept over a reload, saved, merged. By hand 75 + 20.5.

    Out of range is shown.
    """
    with headless_chromium() as browser:
        page = browser.new_page()
        page.set_default_timeout(120_000)
        asked, said = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("dialog", lambda dialog: said.append(dialog.message))
        page.goto((report / "rubric.html").as_uri())
        for wait_ms in (2_000, 8_000, 30_000):  # a busy browser keeps what is stored only later
            page.get_by_label("ada: figure, 0 to 25").fill("20.5")
            page.get_by_label("ada: comment for the student").fill('=well, "done"')
            page.get_by_label("=dan: figure, 0 to 25").fill("26")
            assert "2 of 4 students graded, 1 fields out of range" in page.inner_text("#count")
            page.wait_for_timeout(wait_ms)
            page.reload()
            if page.get_by_label("ada: figure, 0 to 25").input_value() == "20.5":
                break
        else:
            pytest.fail("expected 20.5 to be kept over a reload, found an empty field three times")
        page.get_by_label("=dan: figure, 0 to 25").fill("0")
        with page.expect_download() as saving:
            page.click("#save")
        saving.value.save_as(tmp_path / "points.csv")
    assert all(url.startswith(("file:", "blob:")) for url in asked) and said == []
    words = dict(rubric=tmp_path / "points.csv", to=("csv",))
    assert Report(str(toys.LAB), graded / "grades", tmp_path / "r", **words).run() == 0
    final = {row["student"]: row["total"] for row in rows(tmp_path / "r" / "gradebook.csv")}
    assert final == {"ada": "95.5", "'=dan": "0.0", "bob img": "", "cleo": ""}
    page = feedback(tmp_path / "r", "ada")
    assert "95.5 of 100 points" in page and '=well, "done"' in html.unescape(page)
    assert [row["student"] for row in rows(tmp_path / "r" / "platform.csv")] == ["'=dan", "ada"]


@pytest.mark.alone
def test_an_item_is_clicked_for_students_and_changed_for_all_who_have_it(report, graded, tmp_path):
    """In headless Chromium. By hand: 25 - 4 = 21, later 25 - 6.5 = 18.5; typed 20 stays 20.

    The saved file gives the items back to the page and to the students.
    """
    with headless_chromium() as browser:
        page = browser.new_page()
        page.set_default_timeout(120_000)
        page.goto((report / "rubric.html").as_uri())
        page.click("text=add an item to figure")
        page.get_by_label("figure, item 3: text").fill("no unit on $x$, =1+1")
        page.get_by_label("figure, item 3: points").fill("-4")
        value = {
            who: page.get_by_label(f"{who}: figure, 0 to 25") for who in ("ada", "cleo", "=dan")
        }
        for who in value:
            page.locator(
                f'section[data-student="{who}"], section[data-student="\'{who}"]'
            ).get_by_label("no unit on $x$, =1+1, -4").check()
        assert {who: each.input_value() for who, each in value.items()} == dict.fromkeys(
            value, "21"
        )
        value["cleo"].fill("20")
        page.get_by_label("figure, item 3: points").fill("-6.5")
        found = {who: each.input_value() for who, each in value.items()}
        assert found == {"ada": "18.5", "cleo": "20", "=dan": "18.5"}
        assert "4 of 4" not in page.inner_text("#count")
        with page.expect_download() as saving:
            page.click("#save")
        saving.value.save_as(tmp_path / "points.csv")
        words = dict(rubric=tmp_path / "points.csv", submissions=(graded / "students",))
        words |= dict(figures="stored")
        assert Report(str(toys.LAB), graded / "grades", tmp_path / "r", **words).run() == 0
        again = browser.new_page()
        again.goto((tmp_path / "r" / "rubric.html").as_uri())
        assert again.get_by_label("figure, item 1: points").input_value() == "-6.5"
        again.get_by_label("figure, item 1: points").fill("-5")
        assert again.get_by_label("ada: figure, 0 to 25").input_value() == "20"
    final = {row["student"]: row["figure"] for row in rows(tmp_path / "r" / "gradebook.csv")}
    assert final == {"ada": "18.5", "'=dan": "18.5", "bob img": "", "cleo": "20.0"}
    page = feedback(tmp_path / "r", "ada")
    assert "no unit on <math" in page and "(-6.5)" in page
