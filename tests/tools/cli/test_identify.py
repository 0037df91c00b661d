"""`falconwing identify`: exit codes, tables, JSON, and files only where requested."""

import contextlib
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import default_airframe_path
from falconwing_kit.aircraft.model import paper_model, rates_model
from falconwing_kit.aircraft.user_file import load_terms
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import (
    FlightTable,
    read_flight_table,
    slice_time,
    write_flight_table,
)
from falconwing_kit.data import data_path
from falconwing_kit.sysid.model_file import KNOWN_TERMS, read_model
from falconwing_kit.tools.cli.identify import one_second_ahead
from falconwing_kit.tools.cli.main import main
from tests.sysid.simulated import example_flight, fly_figure_eights, measured

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Files written by mistake land in this folder, which the tests check."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The first 20 s of the simulated example, as a file."""
    path = tmp_path_factory.mktemp("flights") / "short.csv"
    write_flight_table(path, slice_time(example_flight()[2], 0.0, 20.0))
    return str(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """All outputs for a flight of the kit's data: exit code, printed record, folder."""
    folder = tmp_path_factory.mktemp("whole")
    words = ["identify", str(data_path("case02_calm.csv")), "--json", "--one-step"]
    words += ["--out", str(folder / "model.toml"), "--figures", str(folder / "new" / "figures")]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = main(words)
    return code, json.loads(printed.getvalue()), folder


# The record
# ----------


def test_a_recorded_flight_is_described(whole):
    """JSBSim's flight: exit 0, held-out chi2 per degree of freedom at most 1.3, the noise of its
    README.
    """
    code, record, _ = whole
    assert code == 0
    assert record["held_out"]["chi2_per_dof"] <= 1.3 and record["held_out"]["seconds_ahead"] == 2.0
    assert record["noise"]["px"]["unit"] == "m" and record["noise"]["px"]["used"] == pytest.approx(
        0.03, rel=0.15
    )
    assert record["noise"]["roll"]["unit"] == "deg" and record["noise"]["roll"][
        "used"
    ] == pytest.approx(0.6, rel=0.15)
    assert record["rows_without_pose"] > 10 and record["outliers"] > 3


def test_the_record_has_its_keys(whole):
    """What other programs read."""
    _, record, _ = whole
    assert set(record) >= {
        "flights", "form", "held_out", "train", "noise", "outliers", "rows_without_pose",
        "parameters", "warnings", "seconds", "one_step",
    }  # fmt: skip
    assert set(record["held_out"]) == {
        "chi2_per_dof",
        "position_m",
        "attitude_deg",
        "windows",
        "seconds_ahead",
        "describes_flight",
        "constant_turn",
    }
    assert len(record["parameters"]) == 29
    for name, parameter in record["parameters"].items():
        assert set(parameter) == {"value", "low95", "high95", "unit", "meaning", "excited"}, name
        assert parameter["low95"] < parameter["value"] < parameter["high95"], name
        assert isinstance(parameter["excited"], bool)
    assert (record["form"], record["flights"]) == ("rates", ["data/case02_calm.csv"])


def test_the_paper_fit_beside_it_is_far_worse(whole):
    """The one-step fit on differentiated poses, on the same held-out time: raw worse than smoothed
    worse than ours.
    """
    _, record, _ = whole
    ours = record["held_out"]["chi2_per_dof"]
    raw, smoothed = (record["one_step"][k]["held_out_chi2_per_dof"] for k in ("raw", "smoothed"))
    assert (raw is None or raw > smoothed) and smoothed > 3.0 * ours
    assert set(record["one_step"]["raw"]["values"]) == set(record["one_step"]["smoothed"]["values"])


def test_files_are_where_they_were_asked_for(whole):
    """A model file whose numbers are those of the record, three whole PNG files, nothing else."""
    _, record, folder = whole
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    figures = [f"new/figures/{name}.png" for name in ("intervals", "predicted", "residuals")]
    assert [f.replace("\\", "/") for f in files] == ["model.toml", *figures]
    read = read_model(folder / "model.toml")
    assert {n: p["value"] for n, p in record["parameters"].items()} == dict(read.model.values)
    for name in figures:
        content = (folder / name).read_bytes()
        assert content.startswith(PNG) and content[-8:-4] == b"IEND"


# The tables
# ----------


def test_tables_show_the_result_and_the_next_command(short, tmp_path, capsys):
    """Every parameter with its interval and unit, both scores, the noise in cm and deg, warnings,
    a last line; nothing is held out of a short flight, with a warning. No file is written.
    """
    assert main(["identify", short]) == 0
    printed = capsys.readouterr()
    rows = {line.split()[0]: line.split() for line in printed.out.splitlines() if line.strip()}
    for name in ("cL_alpha", "kT", "L_da", "delay"):
        value, low, high = map(float, rows[name][1:4])
        assert low <= value <= high and len(rows[name]) > 5
    assert rows["held-out"] == ["held-out", "time", "-", "-", "-", "0"]
    noise = r"pose noise 3\.\d cm and 0\.\d+ deg; \d+ outliers set aside, \d+ rows without a pose"
    assert re.search(noise, printed.out)
    assert "warning: the flight is too short to hold anything back" in printed.out
    assert printed.out.splitlines()[-1].startswith("next: --out model.toml")
    assert list(tmp_path.iterdir()) == []


def test_a_model_file_is_a_start(short, tmp_path, capsys):
    """Starting from the answer gives the answer: every value within a twentieth of its interval's
    width.
    """
    assert main(["identify", short, "--out", "first.toml"]) == 0
    assert main(["identify", short, "--start", "first.toml", "--out", "second.toml", "--json"]) == 0
    first, second = (read_model(tmp_path / f"{name}.toml") for name in ("first", "second"))
    sigma = np.sqrt(np.diag(first.covariance))
    moved = np.array([second.model.values[n] - first.model.values[n] for n in first.names])
    assert np.abs(moved / sigma).max() < 0.2
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["first.toml", "second.toml"]


def test_an_airframe_file_is_a_start(short, capsys):
    """The shipped airframe is the 150 g aircraft itself."""
    assert main(["identify", short, "--airframe", str(default_airframe_path()), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["train"]["chi2_per_dof"] < 1.2


def test_given_noise_is_used_and_too_small_noise_gives_exit_one(short, capsys):
    """By hand: a third of the true noise makes chi2 about nine, above the two that still count as
    described: exit 1.
    """
    assert (
        main(
            [
                "identify",
                short,
                "--sigma-position-m",
                "0.01",
                "--sigma-attitude-deg",
                "0.2",
                "--json",
            ]
        )
        == 1
    )
    record = json.loads(capsys.readouterr().out)
    assert record["noise"]["pz"]["used"] == pytest.approx(0.01) and record["noise"]["yaw"][
        "used"
    ] == pytest.approx(0.2)
    assert record["train"]["chi2_per_dof"] == pytest.approx(9.0, rel=0.3)
    assert any("does not describe" in sentence for sentence in record["warnings"])


def flown_by(truth, path):
    """Ten seconds of an aircraft as they truly were, with velocities and rates, in a file."""
    flown = fly_figure_eights([truth], 10.0, np.random.default_rng(77))
    x = flown.states[0]
    extra = dict(zip(("vx", "vy", "vz", "p", "q", "r"), x[:, 6:12].T, strict=True))
    write_flight_table(
        path, FlightTable("other", flown.t, x[:, :3], x[:, [5, 3, 4]], flown.sticks[0], extra)
    )
    return str(path)


def test_another_flight_is_predicted_better_than_by_the_start_model(short, tmp_path, capsys):
    """The aircraft was drawn 15 % off the start model; the fit does not use the other flight. A
    forecast by the true parameters would be exact, so the fit leaves less than a third of the start
    model's error.
    """
    other = flown_by(example_flight()[0], tmp_path / "other.csv")
    assert main(["identify", short, "--judge", other, "--json"]) == 0
    ahead = json.loads(capsys.readouterr().out)["one_second_ahead"]
    assert ahead["flight"].endswith("other.csv") and ahead["forecasts"] > 150
    for key in ("position_m", "attitude_deg"):
        assert ahead["fitted"][key] < ahead["start"][key] / 3.0
        assert ahead["fitted"][key] < ahead["constant_turn"][key]
    assert ahead["constant_turn"]["position_m"] < ahead["constant_velocity"]["position_m"]


def test_exit_one_where_the_start_model_predicts_as_well(short, tmp_path, capsys):
    """The other flight is the start model's own, which predicts it to a millimetre; no fit to
    another aircraft can.
    """
    other = flown_by(rates_model(), tmp_path / "other.csv")
    assert main(["identify", short, "--judge", other]) == 1
    printed = capsys.readouterr().out
    assert "other.csv, not fitted to" in printed and "constant turn" in printed
    ahead = one_second_ahead(rates_model(), rates_model(), read_flight_table(other))
    assert ahead["start"]["position_m"] < 0.01


def test_a_reversed_channel_gives_exit_one(tmp_path, capsys):
    """The elevator's column turned round: a clear sentence and exit 1, whatever chi2 says; the
    model file is written as it is for other bad fits.
    """
    table = slice_time(example_flight()[2], 0.0, 20.0)
    write_flight_table(
        tmp_path / "turned.csv", replace(table, commands=table.commands * [1.0, 1.0, -1.0, 1.0])
    )
    assert main(["identify", "turned.csv", "--out", "model.toml"]) == 1
    printed = capsys.readouterr().out
    sentence = "warning: elevator seems reversed: expected positive elevator = nose up"
    assert sum(line.startswith(sentence) for line in printed.splitlines()) == 1
    assert any(
        line.startswith("M_de ") and line.endswith("ON ITS BOUND") for line in printed.splitlines()
    )
    assert read_model(tmp_path / "model.toml").model.values["M_de"] == 0.0


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--out", "none/model.toml"], "expected a folder at none, found none"),
        (["--out", "."], "expected the name of a file to write, got a folder"),
        (
            ["--figures", "a_file"],
            "--figures a_file: expected a folder, but a_file is a file; choose another name",
        ),
        (["--figures", "a_file/figures"], "expected a folder, but a_file is a file"),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_before_the_fit(
    words, text, short, tmp_path, capsys, monkeypatch
):
    """A fit takes seconds to minutes; here it fails the test if it begins."""
    monkeypatch.setattr(
        "falconwing_kit.tools.cli.identify.identify", lambda *a, **k: pytest.fail("the fit began")
    )
    (tmp_path / "a_file").write_text("")
    assert main(["identify", short, *words]) == 2
    assert text in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["a_file"]


def test_two_flights_and_another_form(tmp_path, capsys):
    """Flights of a nine-state aircraft: both names are in the record, and the parameters are the
    paper's sixteen.
    """
    rng = np.random.default_rng(3)
    flown = fly_figure_eights([paper_model()], 12.0, rng)
    for name in ("a.csv", "b.csv"):
        write_flight_table(tmp_path / name, measured(flown, rng))
    assert main(["identify", "a.csv", "b.csv", "--form", "paper", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (
        record["flights"] == ["a.csv", "b.csv"]
        and record["form"] == "paper"
        and len(record["parameters"]) == 16
    )


# Wrong use
# ---------


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "expected at least one flight table, got none"),
        (["absent.csv"], "absent.csv"),
        (
            ["SHORT", "--sigma-position-m", "0.03"],
            "expected both --sigma-position-m and --sigma-attitude-deg, got one",
        ),
        (
            ["SHORT", "--sigma-attitude-deg", "0.6"],
            "expected both --sigma-position-m and --sigma-attitude-deg, got one",
        ),
        (
            ["SHORT", "--sigma-position-m", "0", "--sigma-attitude-deg", "0.6"],
            "--sigma-position-m: expected a finite",
        ),
        (
            ["SHORT", "--sigma-position-m", "0.1", "--sigma-attitude-deg", "nan"],
            "--sigma-attitude-deg: expected a finite",
        ),
        (["SHORT", "--start", "absent.toml"], "absent.toml"),
        (
            ["SHORT", "--start", "a.toml", "--airframe", "b.toml"],
            "expected --start or --airframe, got both",
        ),
        (["SHORT", "--airframe", "absent.toml"], "absent.toml"),
        (["SHORT", "--out", "none/model.toml"], "expected a folder at none, found none"),
        (["broken.csv"], "broken.csv"),
        (["standing.csv"], "expected an aircraft that flies"),
        (["SHORT", "--figures", "broken.csv"], "broken.csv"),
        (["SHORT", "--judge", "SHORT"], "expected logged columns vx, vy, vz"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_two(words, text, short, tmp_path, capsys):
    """The sentence names what was wrong; nothing is printed as a result and nothing is written."""
    (tmp_path / "broken.csv").write_text("t,px,py\n0,1,2\n")
    table = slice_time(example_flight()[2], 0.0, 10.0)
    still = type(table)(
        "s", table.t, 0.0 * table.p_world + 1.0, 0.0 * table.attitude, table.commands
    )
    write_flight_table(tmp_path / "standing.csv", still)
    assert main(["identify", *[short if word == "SHORT" else word for word in words]]) == 2
    printed = capsys.readouterr()
    sentence = printed.err.split("\r")[-1].strip()
    assert text in sentence and sentence.count("\n") == 0 and printed.out == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken.csv", "standing.csv"]


def test_an_unknown_form_is_refused_with_the_known_ones(short, capsys):
    """By the parser, before anything is read."""
    with pytest.raises(SystemExit) as ended:
        main(["identify", short, "--form", "glider"])
    printed = capsys.readouterr()
    assert ended.value.code == 2 and "paper" in printed.err + printed.out


# Terms of a user's own
# ---------------------

TERM = '''"""The thrust line passes below the centre of gravity."""

from falconwing_kit.aircraft import Parameter, Term


def thrust_line(air, K):
    """dq/dt = line T/m."""
    return 0.0, 0.0, 0.0, 0.0, K.line * (K.kT - K.kTV * air.airspeed) * air.throttle, 0.0


LINE = Parameter("line", 0.1, -5.0, 5.0, "1/m", "pitching moment per thrust")
TERMS = [Term("thrust_line", (LINE,), thrust_line)]
'''


def test_a_term_of_a_users_file_is_identified(tmp_path, capsys):
    """Simulated with 1.5 /m: the doubled 95 % interval holds it, and the model reads back."""
    file = tmp_path / "my_term.py"
    file.write_text(TERM)
    terms, rng = load_terms(file), np.random.default_rng(12)
    truth = rates_model().with_terms(*terms).with_values({"line": 1.5})
    write_flight_table("flight.csv", measured(fly_figure_eights([truth], 45.0, rng), rng))
    words = ["identify", "flight.csv", "--terms", str(file), "--out", "model.toml", "--json"]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "my_term.py is a program: it runs now, with all your rights" in printed.err
    line = json.loads(printed.out)["parameters"]["line"]
    assert line["value"] == pytest.approx(1.5, abs=line["high95"] - line["low95"])
    assert line["low95"] > 0.0 and line["high95"] - line["low95"] < 0.8
    model = read_model("model.toml", (*KNOWN_TERMS, *terms)).model
    assert model.values["line"] == pytest.approx(line["value"], rel=1e-6)
    with pytest.raises(InputError, match="thrust_line"):
        read_model("model.toml")


def test_a_wrong_file_of_terms_is_wrong_use(tmp_path, short, capsys):
    """Exit code 2, one sentence with file and line, nothing written."""
    file = tmp_path / "my_term.py"
    file.write_text(TERM.replace("air.throttle, 0.0", "air.throttle"))
    assert main(["identify", short, "--terms", str(file), "--out", "model.toml"]) == 2
    refusal = capsys.readouterr().err.strip().splitlines()[-1]
    assert refusal.startswith("falconwing: my_term.py, line 6: ") and "six loads" in refusal
    assert not (tmp_path / "model.toml").exists()
