"""`falconwing reproduce`: the paper's numbers beside the kit's, verdicts by rule, gaps said.

Trials are replaced by records written here where their flights would take minutes; what they then
give is known by hand.
"""

import json
import shlex

import numpy as np
import pytest
import tyro

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli.main import VERBS, main
from falconwing_kit.tools.trials import reproduction
from falconwing_kit.tools.trials.paper_figures import PAPER
from falconwing_kit.tools.trials.reproduction import (
    LINKS,
    PARTS,
    QUICK,
    SHARES,
    Job,
    Part,
    evaluate_views,
    judge,
    judge_rate,
    reproduce,
)
from falconwing_kit.tools.trials.reproduction_page import write_reproduction

# The paper's Table II, its ten simulated runs [cm].
STATE_CM = (42, 1, 14, 1, 27, 37, 13, 14, 2, 2)
VISION_CM = (54, 4, 38, 12, 32, 74, 21, 79, 32, 23)


def flown(cells, trials, out, *, workers, progress, scale=1.0, failures=0):
    """Records as `fly_cells` gives them, with the errors of the paper's Table II."""
    records = []
    for cell in cells:
        runs = STATE_CM if cell.pilot == "expert" else VISION_CM
        for k in range(trials):
            error = 0.01 * scale * runs[k % 10]
            records.append({
                "key": cell.key, "trial": k, "success": k >= failures, "cpu_ms_median": 2.0,
                "cpu_ms_p95": 3.0, "supervisor": {"reason": ""}, "ald_m": error, "ate_m": error,
                "past_threshold_m": 3.0, "sink_rate_m_s": 0.3, "bank_deg": 1.0,
                "path_m": [[-19.0, -2.0, 1.5], [0.0, -2.0, 0.8], [3.0, -2.0 + error, 0.1]],
            })  # fmt: skip
            progress(len(records), trials * len(cells), records[-1])
    return records


@pytest.fixture
def job(tmp_path):
    return Job(QUICK, tmp_path)


def found_rows(part, words):
    return [row for row in part.rows if words in row.quantity]


@pytest.mark.parametrize(
    ("paper", "kit", "low", "high", "verdict"),
    [
        (72.0, 60.0, 50.0, 75.0, "same"),
        (72.0, 60.0, 50.0, 70.0, "differs"),
        (40.0, 60.0, 50.0, 70.0, "differs"),
        (7.0, 7.04, np.nan, 0.05, "same"),
        (7.0, 7.06, np.nan, 0.05, "differs"),
    ],
)
def test_a_verdict_follows_the_interval(paper, kit, low, high, verdict):
    """By hand: inside or outside, and by digits where there is no interval."""
    assert judge(paper, kit, low, high) == verdict


@pytest.mark.parametrize(
    ("paper", "of", "successes", "trials", "verdict"),
    [
        (1.0, 30, 8, 9, "same"),  # p = 9/39: one failure among 39, which was the kit's
        (1.0, 30, 5, 9, "differs"),  # p = C(9,4) / C(39,4) = 126 / 82251
        (0.3, 30, 30, 30, "differs"),
        (1.0, 10, 10, 10, "same"),
    ],
)
def test_rates_with_both_counts_by_fishers_test(paper, of, successes, trials, verdict):
    """p of the hypergeometric distribution by hand."""
    assert judge_rate(paper, of, {"successes": successes, "trials": trials}) == verdict


def test_sizing_is_the_papers(job):
    """Appendix by hand: V = sqrt(2 m g / (rho S C)) = 7.042 m/s, R = V^2 / (g tan 30) = 8.764 m."""
    part = reproduction.sizing(job)
    assert [row.kit for row in part.rows[:2]] == ["7.04 m/s", "8.77 m"]
    assert [row.verdict for row in part.rows] == ["same"] * 4
    assert (job.out / part.figures[0].file).stat().st_size > 10_000


def test_table_two_of_the_papers_own_runs_is_the_same(job, monkeypatch):
    """Its runs, averaged here: 15.3 and 36.9 cm, ten of ten."""
    monkeypatch.setattr(reproduction, "fly_cells", flown)
    part = reproduction.table_two(job)
    expert = found_rows(part, "simulated, expert")
    assert [row.kit for row in expert] == ["100 %", "15 cm"]
    rgb = found_rows(part, "simulated, rgb:")
    assert [row.kit for row in rgb] == ["100 %", "37 cm"]
    assert {row.verdict for row in (*expert, *rgb)} == {"same"}
    assert all(row.n == "10" and row.mark == "simulated" for row in (*expert, *rgb))


def test_planted_errors_and_failures_differ(job, monkeypatch):
    """Ten times the error and six failures of ten: Fisher's p = 0.011 by hand."""

    def worse(*words, **more):
        return flown(*words, **more, scale=10.0, failures=6)

    monkeypatch.setattr(reproduction, "fly_cells", worse)
    rows = found_rows(reproduction.table_two(job), "simulated, expert")
    assert [row.verdict for row in rows] == ["differs", "differs"]
    assert rows[0].kit == "40 %" and "larger" in rows[1].why


def test_what_cannot_be_made_is_a_row_that_says_so(job, monkeypatch):
    """The brief's list: a second real environment, the real aircraft's parameters, a digital camera
    that flies, real flights, pilots by images that do not ship; and each says why.
    """
    monkeypatch.setattr(reproduction, "fly_cells", flown)
    monkeypatch.delitem(reproduction.PILOTS, "rgb_mask")
    rows = [*reproduction.table_one(job).rows, *reproduction.robustness(job).rows]
    rows += reproduction.table_two(job).rows
    missing = {row.quantity: row for row in rows if row.verdict == "not reproduced"}
    for words in ("real flights", "digital camera that flies", "unseen, rgb_mask", "replay of the"):
        (row,) = [row for name, row in missing.items() if words in name]
        assert row.why and not row.kit and row.mark == "-"
    numbers = " ".join(row.paper for row in rows)
    for (task, scenario, pilot), figure in PAPER.items():
        assert f"{figure.error_cm:.0f} cm" in numbers, (task, scenario, pilot)


def test_a_pilot_that_ships_later_is_flown(job, monkeypatch):
    """With an entry in the table of pilots, its row has the kit's number, without other changes."""
    entry = reproduction.PILOTS["rgb"]
    monkeypatch.setattr(reproduction, "fly_cells", flown)
    monkeypatch.delitem(reproduction.PILOTS, "rgb")
    assert found_rows(reproduction.table_one(job), "unseen, rgb: success")[0].verdict == (
        "not reproduced"
    )
    monkeypatch.setitem(reproduction.PILOTS, "rgb", entry)
    assert found_rows(reproduction.table_one(job), "unseen, rgb: success")[0].kit == "100 %"


def test_pose_network_is_judged_by_its_mean(job, monkeypatch):
    """By hand: nine errors of 0.1 m and one of 3.3 m in ten have the mean 0.42; every other flight
    has half of them, the others half more, so the median is 0.15. The paper's 0.42 m is a mean.
    """
    chunk = np.array([[0.1, 1.0]] * 9 + [[3.3, 14.7]])

    def known(function, items, workers, out):
        for item in items:
            yield item, dict.fromkeys(LINKS[item[0]], ((0.5 + item[1] % 2) * chunk).tolist())

    monkeypatch.setattr("falconwing_kit.tools.jobs.run.parallel_map", known)
    rows = reproduction.pose_network(job).rows
    assert [row.kit for row in rows[:2]] == ["0.42 m", "2.37 deg"]
    assert rows[0].n == "200" and rows[0].verdict == "same" and "median 0.15 m" in rows[0].why


def test_views_of_the_pose_network_are_the_same_each_time():
    """A view is drawn by its number alone, so that workers and a second run give the same; the
    analog link changes it.
    """
    first, again = (evaluate_views(("flown", 0, "")) for _ in range(2))
    digital, analog = first["digital"], first["analog"]
    assert first == again and np.shape(digital) == (10, 2) and np.isfinite(digital).all()
    assert analog != digital and np.median(digital, axis=0)[0] < 2.0


def test_parts_are_kept_and_computed_again_for_other_weights(job, monkeypatch):
    """A second call computes nothing; another version of the kit, or a lost figure, does."""
    calls = []

    def part(_):
        calls.append(1)
        return Part(())

    monkeypatch.setitem(PARTS, "sizing", ("Sizing", part))
    for count in (1, 1):
        reproduce(["sizing"], job)
        assert len(calls) == count
    monkeypatch.setattr(reproduction, "__version__", "9.9.9")
    reproduce(["sizing"], job)
    assert len(calls) == 2
    file = job.out / "parts" / "sizing_quick.json"
    file.write_text(file.read_text()[:40])  # cut as by a full disk
    reproduce(["sizing"], job)
    assert len(calls) == 3


def test_page_has_every_row_with_its_command(job, monkeypatch):
    """Numbers, verdicts, commands; pictures are inside the page; JSON has the same."""
    monkeypatch.setattr(reproduction, "fly_cells", flown)
    parts = {name: PARTS[name][1](job) for name in ("sizing", "table_two")}
    files = write_reproduction(parts, QUICK, job.out)
    page, record = files["page"].read_text(), json.loads(files["rows"].read_text())
    rows = [row for part in parts.values() for row in part.rows]
    assert sum(record["counts"].values()) == len(rows)
    assert page.count('<tr class="row">') == len(rows) and page.count("data:image/png") == 2
    for row in rows:
        assert f">{row.verdict}</span>" in page and (row.command in page)
    assert "http" not in page.split("<body>")[1]


def test_commands_of_the_rows_are_accepted(job, monkeypatch):
    """Each `falconwing` command of a row is parsed by the verb itself; nothing is run."""
    import importlib

    monkeypatch.setattr(reproduction, "fly_cells", flown)
    rows = [row for name in ("sizing", "table_one", "robustness", "table_two")
            for row in PARTS[name][1](job).rows]  # fmt: skip
    commands = {row.command for row in rows if row.command.startswith("falconwing ")}
    assert len(commands) > 8
    modules = {verb.name: (verb.module, verb.class_name) for verb in VERBS}
    for command in commands:
        _, verb, *words = shlex.split(command)
        module, name = modules[verb]
        file = importlib.import_module(f"falconwing_kit.tools.cli.{module}")
        settings = tyro.cli(getattr(file, name), args=words)
        if verb == "eval":
            settings._cells()  # refuses pilots, tasks and worlds that are not there


def test_shares_are_of_all_parts():
    """Progress ends at 100 %."""
    assert list(SHARES) == list(PARTS) and sum(SHARES.values()) == pytest.approx(1.0)


def test_the_verb_writes_the_page(tmp_path, capsys):
    """One part, by the command line."""
    assert main(["reproduce", "--only", "sizing", "--json", "--out", str(tmp_path / "x")]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["counts"]["same"] == 4 and (tmp_path / "x" / "index.html").is_file()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--only", "table_three"), "--only: expected parts of sizing"),
        (("--quick", "--full"), "expected one of them, got both"),
        (("--workers", "0"), "--workers"),
    ],
)
def test_a_wrong_option_is_one_sentence(tmp_path, capsys, words, sentence):
    """What was expected, what came."""
    assert main(["reproduce", *words, "--out", str(tmp_path / "x")]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.strip().count("\n") == 0
    assert not (tmp_path / "x" / "index.html").exists()


def test_out_that_is_a_file_is_refused(tmp_path, capsys):
    """A folder is expected."""
    (tmp_path / "x").write_text("")
    assert main(["reproduce", "--out", str(tmp_path / "x")]) == 2
    assert "expected a folder" in capsys.readouterr().err


def test_unknown_part_is_refused_in_python_too(job):
    with pytest.raises(InputError, match="--only"):
        reproduce(["nothing"], job)
