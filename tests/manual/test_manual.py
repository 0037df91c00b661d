"""The manual builds, has the same contents in both forms, and claims nothing untested."""

import csv
import math
import re
import tomllib

import pytest

from falconwing_kit.tools.hardware.parts import load_parts, roll_up
from falconwing_kit.trainer_port.safety import SafetyConfig
from tests.manual.book import (
    MANUAL,
    ROOT,
    Page,
    commands,
    cost_s,
    elements,
    html,
    page,
    pdf,
    pdf_objects,
    script,
)

FIGURES = MANUAL / "figures"
CHAPTERS = [
    "What you get",
    "Safety",
    "Parts and tools",
    "Assembly",
    "wiring",
    "bench test",
    "transmitter",
    "frame monitor",
    "simulator",
    "manual flight",
    "Identification",
    "autonomous approach",
    "Repairs",
    "Teaching",
    "Troubleshooting",
    "Transmitter and receiver menus",
    "Video transmitter",
    "Batteries",
    "indoor venue",
    "Trim flights",
    "Trim flights with the computer",
    "map of the paper",
    "Limits",
]


def steps():
    """The steps of the assembly."""
    return tomllib.loads((MANUAL / "assembly.toml").read_text(encoding="utf-8"))["steps"]


def in_lists():
    """Numbered items of the source, by typst's own count."""
    return sum(len(found["children"]) for found in elements("enum"))


def test_one_command_writes_both(tmp_path, capsys):
    """The files begin as the formats' specifications say, and the program names them."""
    assert script("build.py").main(["--out", str(tmp_path / "new")]) == 0
    assert (tmp_path / "new" / "manual.pdf").read_bytes().startswith(b"%PDF-")
    assert (
        (tmp_path / "new" / "manual.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    )
    assert "manual.html" in capsys.readouterr().out


def test_mistake_in_the_source_says_where(tmp_path, monkeypatch, capsys):
    """A broken copy: exit code 1, one message, and no file is left behind."""
    build = script("build.py")
    (tmp_path / "manual.typ").write_text("#no_such_function()", encoding="utf-8")
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    monkeypatch.setattr(build, "ROOT", tmp_path)
    assert build.main(["--out", str(tmp_path / "out")]) == 1
    assert "no_such_function" in capsys.readouterr().err
    assert not any((tmp_path / "out").iterdir())


@pytest.mark.alone
def test_building_takes_seconds():
    """Ten seconds were promised; CPU time, of both forms."""
    assert cost_s() < 10.0


def test_length_is_that_of_a_workshop_book():
    """The paper says 15 pages for assembly and use. This one has bench and flight of a real
    aircraft too, and a dozen pages of tables for radio, power, batteries, venue and trim flights:
    at most three times as long, and the assembly's pictured steps, at least three on a page.
    Counted in the PDF itself; the book's first and last page are typst's own count.
    """
    pages = len(re.findall(r"/Type\s*/Page\b(?!s)", pdf_objects()))
    first, last = (found["value"] for found in elements("<book_page>"))
    assert 20 <= pages - (last - first) <= 45
    assert 2 <= last - first <= math.ceil(len(steps()) / 3)


def test_steps_are_the_same_in_both_forms():
    """List items of the HTML and tagged ones of the PDF, terms with their text among these, against
    the source; nothing may vanish from one.
    """
    items = [parents for _, parents in page().all("li") if "nav" not in parents]
    numbered = [parents for parents in items if parents[-1] == "ol"]
    assert len(numbered) == in_lists() > 80
    assert len(re.findall(r"/S\s*/LI\b", pdf_objects())) == len(items) + len(page().all("dt"))


def test_steps_from_data_are_all_there():
    """Assembly and both checklists, item by item, in their order, by words."""
    wanted = [step["see"] for step in steps()]
    with (ROOT / "hardware" / "checklists.toml").open("rb") as file:
        lists = tomllib.load(file)
    wanted += [step["see"] for name in ("bench", "preflight") for step in lists[name]["steps"]]
    text = page().text.replace("’", "'").replace("‘", "'")
    at = 0
    for see in wanted:
        begin = re.split(r"[`'\"]", see)[0].strip()
        at = text.index(begin, at) + 1


def test_minutes_stay_under_the_papers_ten_hours():
    """Added by hand here; the page says the same, and the checklists' lengths that other steps
    speak of.
    """
    minutes = [step["minutes"] for step in steps()]
    assert sum(minutes) < 600
    assert f"{sum(minutes) / 60.0:.1f} hours together" in page().text
    at = {step["id"]: str(number) for number, step in enumerate(steps(), 1)}
    for words in (  # where chapters speak of steps
        f"Propeller off from step {at['propeller_off']} to step {at['propeller_on']}.",
        f"(assembly, step {at['install']})",
        f"measure again (assembly steps {at['lead']} and {at['measuring_lead']})",
        f"Step {at['balance']} of the assembly measures it",
    ):
        assert words in " ".join(page().text.split())
    with (ROOT / "hardware" / "checklists.toml").open("rb") as file:
        lists = tomllib.load(file)
    ids = [step["id"] for step in lists["preflight"]["steps"]]
    assert len(lists["bench"]["steps"]) == 14 and ids.index("propeller") + 1 == 9
    assert "all fourteen steps passed" in page().text and "checklist item 9" in page().text


def test_every_figure_has_words_and_is_in_both():
    """Twelve or more, each with its file's words as text alternative, a picture in the HTML and
    tagged in the PDF.
    """
    images, figures = page().all("img"), elements("image")
    assert len(images) == len(figures) >= 12
    named = re.findall(r'#fig\("([^"]+)"', all_chapters())
    here = named.index("steps/exploded.png") + 1  # the steps' pictures follow it
    figures_named = len(named)
    named[here:here] = [f"steps/{step['id']}.png" for step in steps()]
    assert len(named) == len(set(named)) == len(images)
    for (attributes, _), name in zip(images, named, strict=True):
        assert (
            attributes["alt"]
            == (FIGURES / name).with_suffix(".txt").read_text(encoding="utf-8").strip()
        )
        assert len(attributes["alt"]) > 80 and attributes["src"].startswith("data:image/")
    assert len(re.findall(r"/S\s*/Figure\b", pdf_objects())) == len(images)
    assert len(re.findall(r"/Alt\s*[(<]", pdf_objects())) >= len(images)
    captions = re.findall(r"Figure \d+: ", page().text)
    assert [int(re.sub(r"\D", "", text)) for text in captions] == list(range(1, figures_named + 1))


def test_chapters_are_all_there_and_say_what_comes_next():
    """The list of the issue, in its order; all chapters of work end in a next thing to do."""
    titles = re.findall(r"<h2[^>]*>(\d+) (.*?)</h2>", html())
    assert [int(number) for number, _ in titles] == list(range(1, len(CHAPTERS) + 1))
    assert all(wanted in title for wanted, (_, title) in zip(CHAPTERS, titles, strict=True))
    bodies = re.split(r"<h2", html().split("</nav>")[-1])[1:]
    without = [titles[k][1] for k, body in enumerate(bodies) if "Next:" not in body]
    assert without == [
        "Repairs",
        "Troubleshooting by symptom",
        "Conventions and map of the paper",
        "Limits and status",
    ]


def test_tables_of_parts_are_the_list():
    """Every row of the CSV, each once, and the sum that the kit works out by itself."""
    with (ROOT / "hardware" / "parts.csv").open(encoding="utf-8", newline="") as file:
        parts = [row["part"] for row in csv.DictReader(file)]
    assert [name for name in parts if name.replace("'", "’") not in page().text] == []
    assert f"about {math.floor(roll_up(load_parts()).cost + 0.5)} in all" in page().text


def test_the_boards_rules_are_the_firmwares():
    """The chapter's numbers are the settings, which test_safety compares with config.h."""
    text = " ".join((ROOT / "manual" / "chapters" / "3_bench.typ").read_text("utf-8").split())
    c = SafetyConfig()
    for words in (
        f"so do {c.host_timeout_ms} ms without a command",
        f"a frame of them is at most {c.pilot_fresh_ms} ms old",
        f"every slot is within {c.engage_near_us} µs of the pilot's",
        f"idle (within {c.engage_idle_us} µs) and the others within {c.engage_near_us} µs",
        f"A stick more than {c.pilot_moved_us} µs, {c.pilot_moved_us // 10} % of its travel",
    ):
        assert words in text


def test_map_of_the_paper_is_printed_as_it_stands():
    """Every cell of its tables, code marks and subscripts taken off, stands in the HTML."""
    rows = [
        line
        for line in (MANUAL / "03_paper_map.md").read_text("utf-8").splitlines()
        if line.startswith("| ")
    ]
    squeezed = re.sub(r"[\s_{}]", "", page().text)
    cells = [cell.strip() for row in rows for cell in row.strip("|").split("|")]
    missing = [
        c
        for c in cells
        if re.sub(r"[\s_{}`]", "", c.replace('"', "")) not in re.sub('[“”"]', "", squeezed)
    ]
    assert len(cells) > 150 and missing == []


def test_paths_in_the_manual_lead_somewhere():
    """Files and folders of the repository, in code and in words."""
    path = re.compile(r"\b(?:falconwing_kit|firmware|hardware|labs|manual|tests)/[\w./]*\w")
    named = set(path.findall(page().text))
    assert len(named) > 15 and [name for name in named if not (ROOT / name).exists()] == []


def test_no_sentence_claims_a_photograph():
    """Figures and captions say drawn, computed or simulated; none says that it was taken with a
    camera.
    """
    words = [path.read_text("utf-8") for path in FIGURES.glob("*.txt")]
    words += re.findall(r"<figcaption>(.*?)</figcaption>", html(), re.DOTALL)
    claim = re.compile(
        r"\b(photograph|photo of|snapshot|taken with|shot (?:of|by|with))", re.IGNORECASE
    )
    assert len(words) > 30 and [text for text in words if claim.search(text)] == []
    renders = re.findall(r'#fig\("([^"]+\.(?:jpg|png))"[^\[]*\[(.*?)\]', all_chapters(), re.DOTALL)
    assert len(renders) >= 5
    assert [
        name for name, text in renders if not re.search(r"[Ss]imulated|[Cc]omputed", text)
    ] == []


def test_nothing_is_fetched_when_it_is_read_or_built():
    """The HTML asks no other machine; the source imports no package."""
    assert [a for a, _ in page().all("script") + page().all("link")] == []
    assert not re.search(r'(?:src|href)="https?:', html())
    sources = [
        path.read_text("utf-8") for path in [*MANUAL.glob("*.typ"), *MANUAL.glob("chapters/*.typ")]
    ]
    assert len(sources) == 14 and not any("@preview" in text for text in sources)


def test_honest_status_is_said_before_anything_is_bought():
    """On the first chapter's page, and again at the end."""
    first = page().text[: page().text.index("2 Safety", 1500)]
    assert (
        "No aircraft has been built with this manual" in first
        and "pilot has flown an aircraft by camera" in first
    )


def test_counter_sees_what_is_missing():
    """The reader of HTML by a page written by hand: two steps, one image without words."""
    small = Page("<nav><ol><li>a</li></ol></nav><ol><li>b<img src='x'></li><li>c</li></ol>")
    assert [parents[-1] for _, parents in small.all("li")] == ["ol", "ol", "ol"]
    assert [a.get("alt") for a, _ in small.all("img")] == [None] and small.text.split() == [
        "a",
        "b",
        "c",
    ]
    assert pdf().startswith(b"%PDF-") and commands()


def all_chapters():
    """The sources of all chapters."""
    return "".join(path.read_text("utf-8") for path in sorted(MANUAL.glob("chapters/*.typ")))


@pytest.mark.parametrize(
    "name",
    ["loop", "aircraft", "hours", "ppm", "safety", "surfaces", "photo_lanes", "sticks", "venue"],
)
def test_drawings_are_what_the_command_makes(name, tmp_path):
    """Letter by letter; numbers to a hundredth of a point, since machines round differently."""
    assert script("figures/make_figures.py").main([name, "--out", str(tmp_path)]) == 0
    number = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
    for kind in ("svg", "txt"):
        ours, again = (
            (folder / f"{name}.{kind}").read_text("utf-8") for folder in (FIGURES, tmp_path)
        )
        assert number.sub("#", ours) == number.sub("#", again)
        values = [[float(text) for text in number.findall(content)] for content in (ours, again)]
        assert values[0] == pytest.approx(values[1], abs=1e-2)


def test_monitor_says_of_the_pictures_what_the_caption_says(tmp_path):
    """Drawn again: clean no alarm, the other three an alarm, in the pictures that the caption
    counts.
    """
    assert script("figures/make_figures.py").main(["pictures", "--out", str(tmp_path)]) == 0
    said = (tmp_path / "pictures.txt").read_text("utf-8")
    alarms = re.findall(r"alarm in image (\d+)", said)
    assert "clean: no alarm" in said and len(alarms) == 3
    assert f"The alarms came in image {alarms[0]}, {alarms[1]} and {alarms[2]}." in page().text


def test_a_wrong_figure_is_refused(capsys):
    """One sentence and exit code 2, argparse's own."""
    with pytest.raises(SystemExit) as end:
        script("figures/make_figures.py").main(["nothing"])
    assert end.value.code == 2 and "expected names of" in capsys.readouterr().err
