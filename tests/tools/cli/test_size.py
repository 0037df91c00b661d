"""`falconwing size` prints the appendix, answers with its exit code and writes only under --out."""

import json

import pytest

from falconwing_kit.aircraft.airframe import default_airframe_path
from falconwing_kit.core.files import shipped_path
from falconwing_kit.tools.cli.main import main


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Whatever a verb writes by mistake lands here and is seen."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ([], 0),  # 150 g: 2 * 8.77 m fits 20 m
        (["--mass-g", "171"], 0),  # the largest mass by hand is 171.1 g
        (["--mass-g", "172"], 1),
        (["--mass-g", "324"], 1),  # 2 * 18.9 m
        (["--mass-g", "324", "--hall-width-m", "38"], 0),
        (["--margin-m", "2.4"], 0),  # 2 * 8.765 = 17.53 m
        (["--margin-m", "2.5"], 1),
        (["--hold-height"], 1),  # 2 * 10.12 m
        (["--hold-height", "--bank-deg", "31"], 0),  # by hand the bank must be 30.4 deg
    ],
)
def test_exit_code_says_whether_the_circle_fits(words, code, capsys):
    """By hand from the appendix: radius 8.77 m at 150 g, linear in mass, 1.155 times that with
    height held.
    """
    assert main(["size", *words]) == code
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: ")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--mass-g", "-150"], "--mass-g"),
        (["--mass-g", "nan"], "--mass-g"),
        (["--hall-width-m", "0"], "--hall-width-m"),
        (["--bank-deg", "90"], "--bank-deg"),
        (["--margin-m", "20"], "margin"),
        (["--margin-m", "-1"], "margin"),
        (["--airframe", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_two(words, text, capsys, tmp_path):
    """The sentence names what was wrong; nothing is printed as a result and nothing is written."""
    assert main(["size", *words, "--out", "report"]) == 2
    printed = capsys.readouterr()
    assert text in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("mass_g", "speed", "radius"),
    [(150, "7.042", "8.765"), (300, "9.959", "17.53"), (324, "10.35", "18.93")],
)
def test_table_shows_the_appendix_values(mass_g, speed, radius, capsys):
    """Paper, appendix, by hand to four digits."""
    main(["size", "--mass-g", str(mass_g)])
    lines = capsys.readouterr().out.splitlines()
    assert speed in next(line for line in lines if line.startswith("minimum speed")).split()
    assert radius in next(line for line in lines if line.startswith("turn radius")).split()


def test_json_has_the_numbers_and_nothing_else(capsys, tmp_path):
    """By hand: 8.765 m, 10.12 m with height held, 171.1 g and 148.2 g, parts 151 g; asin(5.061 /
    10) = 30.40 deg.
    """
    assert main(["size", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["minimum_speed_m_per_s"] == pytest.approx(7.042, abs=5e-4)
    assert record["paper_turn"]["radius_m"] == pytest.approx(8.765, abs=5e-4)
    assert record["level_turn"]["radius_m"] == pytest.approx(10.12, abs=5e-3)
    assert record["paper_turn"]["largest_mass_g"] == pytest.approx(171.1, abs=0.05)
    assert record["level_turn"]["largest_mass_g"] == pytest.approx(148.2, abs=0.05)
    assert record["level_turn"]["bank_needed_deg"] == pytest.approx(30.40, abs=5e-3)
    assert (record["parts_mass_g"], record["unlisted_mass_g"]) == (151.0, -1.0)
    assert record["fits"] is True
    assert list(tmp_path.iterdir()) == []


def test_out_writes_the_figure_and_the_same_json(capsys, tmp_path):
    """A PNG starts with its eight signature bytes; the file and the printed JSON are one record."""
    assert main(["size", "--json", "--out", "deep/report"]) == 0
    report = tmp_path / "deep" / "report"
    assert sorted(path.name for path in report.iterdir()) == ["size.json", "size.png"]
    assert (report / "size.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert json.loads((report / "size.json").read_text()) == json.loads(capsys.readouterr().out)


def test_a_figure_that_fails_half_way_leaves_the_old_one(tmp_path, monkeypatch):
    """Half a picture is written and then the disk fails: the name keeps the old bytes and no scrap
    is left.
    """
    from matplotlib.figure import Figure

    def fail(figure, handle, **options):
        handle.write(b"half a picture")
        raise OSError(5, "disk failed")

    main(["size", "--out", "report"])
    before = (tmp_path / "report" / "size.png").read_bytes()
    monkeypatch.setattr(Figure, "savefig", fail)
    assert main(["size", "--mass-g", "200", "--out", "report"]) == 2
    assert (tmp_path / "report" / "size.png").read_bytes() == before
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == [
        "size.json",
        "size.png",
    ]


def test_another_airframe_file_is_used(capsys, tmp_path):
    """By hand: twice the wing area at the same mass is half the radius, 4.383 m."""
    text = (
        default_airframe_path()
        .read_text(encoding="utf-8")
        .replace("wing_area_m2 = 0.076", "wing_area_m2 = 0.152")
    )
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    assert main(["size", "--airframe", "mine.toml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["paper_turn"]["radius_m"] == pytest.approx(
        4.383, abs=5e-4
    )


def test_options_replace_what_the_file_says(capsys):
    """By hand: V ~ 1 / sqrt(S C), so four times S C halves 7.042 m/s."""
    main(["size", "--wing-area-m2", "0.152", "--cl-max", "1.2", "--json"])
    assert json.loads(capsys.readouterr().out)["minimum_speed_m_per_s"] == pytest.approx(
        3.521, abs=5e-4
    )


def test_list_of_parts_gives_mass_balance_and_cost(capsys):
    """By hand (tests/tools/hardware/test_parts.py): 152.7 g; 5031.9 / 152.7 = 32.95 mm, of a chord
    of 0.076 / 0.70 = 108.6 mm 30.4 %; the battery of 18 g goes 152.7 * (36 - 32.95) / 18 = 26 mm
    back; V ~ sqrt(m / rho): 7.042 * sqrt(152.7 / 150 * 1.3 / 1.2).
    """
    assert main(["size", "--parts", "kit", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["mass_g"] == pytest.approx(152.7) and record["unlisted_mass_g"] == 0.0
    assert record["minimum_speed_m_per_s"] == pytest.approx(7.3954, abs=1e-3)
    balance = record["balance"]
    assert balance["cg_mm"] == pytest.approx(32.953, abs=1e-3)
    assert balance["cg_percent_chord"] == pytest.approx(30.35, abs=0.01)
    assert balance["battery_move_mm"] == pytest.approx(25.8, abs=0.1)
    assert record["costs_usd"]["sum"] == pytest.approx(1058.4)
    assert record["paper_sums"][0]["over_stated_g"] == pytest.approx(1.0)


def test_tables_of_parts_say_where_the_paper_does_not_close(capsys):
    """Paper: 137 + 9 + 5 g are 1 g over 150 g; what has no price is named."""
    assert main(["size", "--parts", "kit"]) == 0
    printed = capsys.readouterr().out
    (line,) = [line for line in printed.splitlines() if line.startswith("137 + 9 + 5 g")]
    assert line.split()[-2:] == ["151", "1"]
    assert "not included: computer, pad, printer" in printed and "26 mm back" in printed


def test_own_list_of_parts_is_read_and_a_wrong_one_refused(capsys, tmp_path):
    """Twice the mass of the shipped camera's row is 9 g more, 4 g over the 158 g of the hall by the
    paper's formula, and named; a list that is not there is named.
    """
    text = shipped_path("hardware/parts.csv", "").read_text(encoding="utf-8")
    (tmp_path / "mine.csv").write_text(text.replace(",1,9,paper,", ",2,9,paper,"), encoding="utf-8")
    assert main(["size", "--parts", "mine.csv", "--json"]) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["mass_g"] == pytest.approx(161.7)
    (problem,) = record["problems"]
    assert "got 161.7 g" in problem and "camera_analog weighs 18.0 g, 9.0 g more" in problem
    assert main(["size", "--parts", "none.csv"]) == 2
    assert "none.csv" in capsys.readouterr().err


def test_what_was_scaled_is_printed_as_one_line(capsys, tmp_path):
    """A file with the three required keys: everything else is named, and no parts are listed."""
    path = tmp_path / "mine.toml"
    path.write_text("mass_g = 1200\nwing_area_m2 = 0.304\nspan_m = 1.4\n")
    main(["size", "--airframe", str(path)])
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith("mine: scaled from the kit's own airframe") and "wheels_m" in first
    assert not any("sum of the parts" in line for line in others)
    main(["size", "--airframe", str(path), "--json"])
    assert "inertia_kg_m2" in json.loads(capsys.readouterr().out)["scaled"]
