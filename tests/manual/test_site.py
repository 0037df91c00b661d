"""The site: its sources are staged without a dead link, and the whole of it builds, small and
readable on a phone.

The pages in a browser are those of one build for all tests here; without Sphinx they are skipped,
and fail in CI.
"""

import base64
import importlib.util
import json
import os
import re
import resource
import struct
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from tests.chromium import headless_chromium
from tests.manual.book import MANUAL, ROOT, Page, script

sys.path.insert(0, str(MANUAL / "site"))
import conf
import render
import stage

NARROW, WIDE = {"width": 360, "height": 740}, {"width": 1280, "height": 900}
LABS = [path.name[:5] for path in sorted((ROOT / "labs").glob("lab[0-9]*"))]
# One page of each kind: tables, code, pictures, notebook, docstrings, the book's raw HTML.
KINDS = (
    *("index", "quick_start", "commands", "reproduced", "glossary", "paper_map", "concepts/frames"),
    *("howto/hall", "benchmarks/pilots", "labs/lab04", "builder/04", "builder/16", "api/aircraft"),
)
# Contrast of every visible text with the nearest opaque background [WCAG 2.2, 1.4.3 and its
# definitions of relative luminance and contrast ratio]; large text needs 3, any other 4.5.
CONTRAST = """() => {
  const number = text => (text.match(/[\\d.]+/g) || []).map(Number);
  const luminance = rgb => rgb.slice(0, 3).map(v => v / 255)
    .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const low = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; node = walker.nextNode();) {
    const element = node.parentElement;
    if (!node.data.trim() || !element.checkVisibility({visibilityProperty: true})) continue;
    const box = element.getBoundingClientRect(), style = getComputedStyle(element);
    if (box.width < 2 || box.height < 2) continue;
    if (["SCRIPT", "STYLE", "NOSCRIPT"].includes(element.tagName)) continue;
    let behind = element, back = null;
    for (; behind && !back; behind = behind.parentElement) {
      const colour = number(getComputedStyle(behind).backgroundColor);
      if (colour.length == 3 || colour[3] == 1) back = colour;
    }
    const [a, b] = [luminance(number(style.color)), luminance(back || [255, 255, 255])];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
    const place = `${element.tagName}.${element.className}: ${node.data.trim().slice(0, 30)}`;
    if (ratio < (large ? 3 : 4.5)) low.push(`${ratio.toFixed(2)} ${place}`);
  }
  return [...new Set(low)];
}"""


# A table of which a phone shows one column alone reads as if that were all.
ONE_COLUMN = """() => [...document.querySelectorAll("article tr > :nth-child(2)")].filter(
  cell => cell.getBoundingClientRect().width && cell.getBoundingClientRect().left > innerWidth - 90
).map(cell => `${cell.tagName}: ${cell.textContent.trim().slice(0, 30)}`)"""


# What sticks out of a page to the right, but for the inside of boxes that scroll by themselves.
STICKS_OUT = """() => [...document.querySelectorAll("article *")].filter(element => {
  if (element.getBoundingClientRect().right <= innerWidth + 1) return false;
  for (let box = element; box && box.tagName != "ARTICLE"; box = box.parentElement)
    if (["auto", "scroll"].includes(getComputedStyle(box.parentElement).overflowX)
        && box.parentElement.tagName != "ARTICLE"
        && box.parentElement.getBoundingClientRect().right <= innerWidth + 1) return false;
  return true;
}).map(element => `${element.tagName}: ${element.textContent.trim().slice(0, 30)}`)"""


def staged(out, settings=None, outputs=Path("nowhere"), root=ROOT):
    """A stage that is written."""
    written = stage.Stage(out, settings or stage.Settings(), outputs, root)
    written.write()
    return written


@cache
def built():
    """(the site's folder, CPU seconds of its build), by the command that people type."""
    missing = [name for name in ("sphinx", "myst_nb", "furo") if not importlib.util.find_spec(name)]
    if missing:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(f"expected {missing[0]}")
    out = Path(os.environ["FALCONWING_SITE_OUT"])
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [sys.executable, str(MANUAL / "build.py"), "site", "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert run.returncode == 0, run.stderr
    return out, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site's folder."""
    os.environ["FALCONWING_SITE_OUT"] = str(tmp_path_factory.mktemp("site") / "html")
    return built()[0]


@pytest.fixture(scope="module")
def pages(site):
    """Every page of the site but Sphinx's own indices, read."""
    own = ("genindex", "search", "py-modindex")
    return {
        path.relative_to(site).as_posix(): Page(path.read_text(encoding="utf-8"))
        for path in sorted(site.rglob("*.html"))
        if path.stem not in own
    }


def test_every_page_of_the_repository_is_on_the_site(tmp_path):
    """Manual, labs, hardware, firmware and the package's own pages; nothing is left out."""
    staged(tmp_path / "site")
    places = stage.page_places(ROOT)
    there = {p.relative_to(ROOT).as_posix() for p in (ROOT / "manual").glob("*.md")}
    there |= {p.relative_to(ROOT).as_posix() for p in (ROOT / "labs").glob("*.md")}
    there |= {"hardware/README.md", "firmware/README.md", "falconwing_kit/README.md"}
    assert there <= set(places)
    assert [p for p in places.values() if not (tmp_path / "site" / p).is_file()] == []
    assert len(list((tmp_path / "site" / "labs").glob("*.ipynb"))) == len(LABS) >= 12


def small_root(folder, text):
    """A repository with one page of the site, one lab's route, and a page in another place."""
    others = ("labs/README.md", "manual/gallery.md", "manual/site/howto/index.md")
    pages = {"manual/site/index.md": text, "manual/site/api/index.md": "# A\n"}
    pages |= dict.fromkeys(others, "# A page\n")
    for name, content in pages.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")
    (folder / "setup.py").write_text("")
    return folder


def test_a_planted_dead_link_is_refused_with_its_line(tmp_path):
    """Written here by hand; code and fenced blocks are no links."""
    root = small_root(
        tmp_path / "kit",
        "# P\n\n```text\n[no](nothing.md)\n```\n`[no](link.md)`\n\n[words\nbroken](missing.md)\n",
    )
    with pytest.raises(RuntimeError) as refusal:
        staged(tmp_path / "out", root=root)
    assert str(refusal.value) == (
        "manual/site/index.md:8: expected a link to a file of the repository, got missing.md"
    )


def test_links_go_to_pages_to_the_published_repository_or_nowhere(tmp_path):
    """Three links: a page elsewhere, a file that is no page, an address."""
    text = "# P\n\n[a](../gallery.md#x), [set-up](../../setup.py) and [b](https://mcap.dev)\n"
    root = small_root(tmp_path / "kit", text)
    staged(tmp_path / "out", root=root)
    plain = "# P\n\n[a](gallery.md#x), set-up (`setup.py`) and [b](https://mcap.dev)\n"
    assert (tmp_path / "out" / "index.md").read_text() == plain
    published = stage.Settings(repository_url="https://github.com/someone/kit")
    staged(tmp_path / "out", published, root=root)
    linked = plain.replace(
        "set-up (`setup.py`)", "[set-up](https://github.com/someone/kit/blob/main/setup.py)"
    )
    assert (tmp_path / "out" / "index.md").read_text() == linked


def test_launch_links_stand_only_where_a_repository_is_named(tmp_path):
    """Empty as shipped: no page links to a repository or a service that would run a notebook."""
    assert stage.Settings.load() == stage.Settings("", "")
    staged(tmp_path / "site")
    lab = (tmp_path / "site" / "labs" / "lab01.ipynb").read_text()
    assert "mybinder" not in lab and "blob/main" not in lab
    published = stage.Settings(repository_url="https://github.com/someone/kit")
    staged(tmp_path / "site", published)
    lab = (tmp_path / "site" / "labs" / "lab01.ipynb").read_text()
    name = "labs/lab01_sizing/lab01.ipynb"
    assert f"https://mybinder.org/v2/gh/someone/kit/main?labpath={name}" in lab
    assert f"https://github.com/someone/kit/blob/main/{name}" in lab
    assert stage.Settings(repository_url="https://example.org/kit").launch_url(name) == ""


@pytest.mark.parametrize(
    "text, words", [('site_url = "kit"', "got 'kit'"), ('repo_url = ""', "got repo_url")]
)
def test_wrong_settings_are_refused(tmp_path, text, words):
    """One sentence that names the key."""
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(RuntimeError, match=words):
        stage.Settings.load(tmp_path / "settings.toml")


@pytest.mark.parametrize("name", LABS)
def test_the_cell_of_a_film_is_the_same_for_students_and_in_the_solution(name):
    """A page finds an output by its cell's text; the first cell differs: no film may be there."""
    (folder,) = (ROOT / "labs").glob(f"{name}_*")
    texts = []
    for path in (folder / f"{name}.ipynb", folder / "solution" / f"{name}.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        texts.append([text for text in code if re.search(r"^(given\.)?moving_\w+\(", text, re.M)])
    assert len(texts[0]) == 1 and texts[0] == texts[1]


def test_a_film_on_a_page_has_its_own_words_and_width():
    """As the notebook's output says; a figure of matplotlib has none, so it is named."""
    film = {"metadata": {"image/gif": {"alt": "a turn in the wind", "width": 480}}}
    cell = {"metadata": {"figure": "turn"}, "outputs": [{"output_type": "stream"}, film]}
    assert stage.image_of(cell) == {"alt": "a turn in the wind", "width": "480px"}
    cell["outputs"] = [{"metadata": {}}]
    assert stage.image_of(cell)["alt"].endswith("figure turn")


def test_solutions_stay_hidden_and_outputs_come_from_the_cache(tmp_path):
    """A cache written by hand for every cell of lab 1: each gets its output, but for exercises."""
    source = ROOT / "labs" / "lab01_sizing" / "lab01.ipynb"
    cells = [c for c in json.loads(source.read_text())["cells"] if c["cell_type"] == "code"]
    known = [{"output_type": "stream", "name": "stdout", "text": "planted"}]
    cache_file = tmp_path / "cache" / "lab01_sizing.json"
    cache_file.parent.mkdir()
    cache_file.write_text(json.dumps({"".join(cell["source"]): known for cell in cells}))
    staged(tmp_path / "site", outputs=tmp_path / "cache")
    for name in LABS:
        page = json.loads((tmp_path / "site" / "labs" / f"{name}.ipynb").read_text())
        code = [cell for cell in page["cells"] if cell["cell_type"] == "code"]
        exercises = [cell for cell in code if "exercise" in cell["metadata"]]
        assert exercises and all("NotImplementedError" in "".join(c["source"]) for c in exercises)
        shown = [cell["outputs"] for cell in code if "exercise" not in cell["metadata"]]
        assert all(outputs == (known if name == "lab01" else []) for outputs in shown)
        assert all(cell["outputs"] == [] for cell in exercises)


def test_a_folder_with_other_files_is_not_replaced(tmp_path, capsys):
    """Exit code 1, one sentence, and the file is still there."""
    (tmp_path / "thesis.txt").write_text("years of work")
    assert script("build.py").main(["site", "--out", str(tmp_path)]) == 1
    assert "expected an empty folder or an older site" in capsys.readouterr().err
    assert (tmp_path / "thesis.txt").is_file()


def test_dead_links_of_pages_are_found(tmp_path):
    """Two pages by hand: a file and a place that are there, one of each that is not."""
    (tmp_path / "a.html").write_text(
        '<p id="here"><a href="b.html#there"></a><a href="#here"></a><a href="https://mcap.dev">'
        '</a><a href="b.html#nowhere"></a><img src="missing.png"></p>'
    )
    (tmp_path / "b.html").write_text('<p id="there"></p>')
    assert render.dead_links(tmp_path) == [
        "a.html: dead link b.html#nowhere",
        "a.html: dead link missing.png",
    ]


def test_docstrings_keep_their_equations_and_characters():
    """By hand: an equation keeps its line, a star is a star, `code` is code."""
    lines = ["Lift of `wing_area` * q.", "", "L = q S C   [paper]", "D = q S k", "", "v_ or |v|"]
    conf.plain_docstring(None, "function", "lift", len, None, lines)
    assert lines == [
        "Lift of ``wing_area`` \\* q.",
        "",
        ".. code-block:: text",
        "   :class: formula",
        "",
        "   L = q S C   [paper]",
        "   D = q S k",
        "",
        "v\\_ or \\|v\\|",
        "",
    ]
    array = "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.float64]]"
    assert conf.short(f"(mass: {array}, a: ~kit.Airframe)") == "(mass: Array, a: Airframe)"


def test_programs_of_docstrings_stay_programs_and_prose_stays_prose():
    """By hand: indented lines before the sections are code; a sentence with `=` is a sentence."""
    lines = ["What.", "", "    a = f(x)", "    b = g(a)", "", "The sum is 137 + 9 + 5 = 151 g."]
    conf.plain_docstring(None, "function", "f", len, None, lines)
    assert lines[2:7] == [
        ".. code-block:: text", "   :class: formula", "", "   a = f(x)", "   b = g(a)"
    ]  # fmt: skip
    assert lines[8:] == ["The sum is 137 + 9 + 5 = 151 g.", ""]


@pytest.mark.parametrize(
    ("what", "lines"),
    [
        ("property", ["Whether it is exact: of no assumed shape."]),
        ("function", ["Mean.", "", "Returns:", "    mean and slope: over the step."]),
    ],
)
def test_words_before_a_colon_are_not_taken_for_a_type(what, lines):
    """Napoleon would print them as "TYPE"; without a colon it cannot, and afterwards it is back."""
    words = list(lines)
    conf.plain_docstring(None, what, "f", len, None, lines)
    assert [line for line in lines if ": " in line] == []
    conf.colons_again(None, what, "f", len, None, lines)
    assert [line for line in lines if line] == [line for line in words if line]


def test_signatures_show_no_long_default():
    """By hand: commas and brackets within strings and lists do not end a parameter."""
    head = "(a: tuple[int, ...] = (), b: str = 'x, (y', "
    long = f"c: dict[str, int] = <factory>, d: X = X('a long text, {40 * 'z'}'), *, e=None)"
    shown = "c: dict[str, int] = ..., d: X = ..., *, e=None)"
    assert conf.short_defaults(head + long) == head + shown
    assert conf.short_defaults("()") == "()" and conf.short_defaults(None) is None


def test_lines_of_a_page_end_where_they_may():
    """By hand: after a slash of a path, not in an arrow, an option or a short name."""

    def code(text):
        return f'<code class="docutils literal"><span class="pre">{text}</span></code>'

    path = "falconwing_kit/core/frames.py"
    found = conf.with_line_ends(
        f"<p>in -&gt; out {code('lab.py')} {code(path)} {code('--out')}</p>"
    )
    assert '<span class="option">-&gt;</span> out' in found
    assert 'class="short docutils literal"><span class="pre">lab.py<' in found
    assert "falconwing_<wbr>kit/<wbr>core/<wbr>frames.py" in found
    assert re.sub(r"<[^>]+>", "", found) == f"in -&gt; out lab.py {path} --out"
    book = '<code data-lang="a_long_word_of_an_attribute">run case08_flight_of_a_day.csv</code>'
    assert conf.with_line_ends(book) == book.replace(
        "case08_flight_of_a_day", "case08_<wbr>flight_<wbr>of_<wbr>a_<wbr>day"
    )
    three = conf.with_line_ends(code("--camera-at=0.036,0,-0.075"))
    assert '<wbr><span class="option">-0.075</span>' in three


def test_wide_pictures_scroll_on_a_phone():
    """The first bytes of a PNG and of a GIF by their specifications, of sizes made up here."""

    def png(width, height):
        head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height)
        return base64.b64encode(head).decode()

    film = base64.b64encode(b"GIF89a" + struct.pack("<HH", 840, 360)).decode()
    assert (
        stage.is_wide(png(1111, 351)) and stage.is_wide(film) and not stage.is_wide(png(351, 1111))
    )
    assert not stage.is_wide(png(640, 480)) and not stage.is_wide(png(160, 20))
    output = {"output_type": "display_data", "data": {"image/png": png(1111, 351)}}
    assert stage.sized(output)["metadata"] == {"image/png": {"width": 736}}
    cell = {"metadata": {"figure": "gap"}, "outputs": [stage.sized(output)]}
    assert stage.image_of(cell) == {"alt": "Drawn by the cell above: figure gap", "classes": "wide"}


def test_packages_are_listed_and_none_has_an_empty_page(pages):
    """A phone shows no sidebar; the packages by their folders, and no default of pages' length."""
    packages = {p.parent.name for p in (ROOT / "falconwing_kit").glob("*/__init__.py")} - {"tools"}
    listed = {a.get("href", "") for a, parents in pages["api/index.html"].all("a")}
    assert {f"{name}.html" for name in packages} <= listed
    assert "its files; the reading path has a line" in " ".join(
        pages["api/learning.html"].text.split()
    )
    signatures = [pages[f"api/{name}.html"].text for name in packages]
    for text in signatures:
        for word in ("<factory>", "<function", "Alias for field number", "ndarray[tuple"):
            assert word not in text


def test_formulas_are_those_of_the_labs():
    """By hand: a half is 1 over 2 and not 12 over what follows; an accent's index is beside it."""

    def drawn(text):
        return re.sub(r"\s+", "", conf.mathml(text, block=False))

    assert "<mn>1</mn><mn>2</mn></mfrac><mi>ρ</mi>" in drawn(r"\tfrac12 \rho")
    assert "<mn>1</mn><mi>W</mi></mfrac>" in drawn(r"\tfrac1W \sum w_i")
    accent = '<mover><mi>u</mi><mostretchy="false">ˆ</mo></mover>'
    assert f"<msub>{accent}<mi>i</mi></msub>" in drawn(r"\hat u_i")
    assert "<mtext>PRIOR_SIGMA</mtext>" in drawn(r"\text{PRIOR\_SIGMA}")
    brace = drawn(r"\underbrace{x}_{\text{poses}}")
    assert brace.endswith('<mostretchy="true">⏟</mo></munder><mtext>poses</mtext></munder></math>')
    assert brace.count("<munder>") == 2 and "msub" not in brace
    assert "(</mo>" in drawn(r"\Big(x\Big)") and 'stretchy="false"' not in drawn(r"\Big(x\Big)")


def test_site_is_small_and_its_build_cheap(site):
    """The limits of the plan: 60 s of CPU, and 25 MB, with the labs' outputs where they are."""
    assert built()[1] < 60.0
    total = sum(path.stat().st_size for path in site.rglob("*") if path.is_file())
    assert total < 25e6 and (site / "searchindex.js").is_file()


def test_links_lead_somewhere_and_nothing_comes_from_the_network(site, pages):
    """Each page again, and what would be fetched while it opens: scripts, styles, pictures."""
    assert len(pages) > 60 and render.dead_links(site) == []
    for name, page in pages.items():
        fetched = [a.get("src", "") for tag in ("script", "img") for a, _ in page.all(tag)]
        fetched += [a["href"] for a, _ in page.all("link") if a.get("rel") != "canonical"]
        assert [address for address in fetched if re.match(r"(https?:)?//", address)] == [], name


def test_all_kinds_of_pages_are_there(pages):
    """What the plan lists; the labs' pages, the book's chapters and the rooms by the folders."""
    rooms = {p.parent.name for p in (ROOT / "falconwing_kit").glob("*/__init__.py")} - {"tools"}
    expected = {f"{kind}.html" for kind in KINDS} | {f"api/{room}.html" for room in rooms}
    expected |= {f"labs/{name}.html" for name in LABS}
    expected |= {"gallery.html", "status.html", "install.html", "teaching/instructors.html"}
    assert expected <= set(pages)
    assert sum(name.startswith("builder/") for name in pages) > 15
    assert "minimum_speed" in pages["api/aircraft.html"].text
    missing = pages["reproduced.html"].text
    assert all(
        words in missing
        for words in ("second real environment", "real aircraft", "digital camera that flies")
    )


def test_no_line_ends_inside_an_option(site):
    """Two hyphens and a word on two lines are typed as two words; the whole page of commands."""
    text = (site / "commands.html").read_text(encoding="utf-8")
    options = re.findall(r'<span class="([^"]+)">--[a-z][a-z0-9-]*', text)
    assert len(options) > 50 and set(options) == {"option"}


def test_pages_can_be_read_aloud(pages):
    """Language, one title, headings in order, and words for every picture [WCAG 2.2: 3.1.1, 2.4.6,
    1.3.1, 1.1.1].
    """
    for name, page in pages.items():
        ((attributes, _),) = page.all("html")
        assert attributes["lang"] == "en", name
        words = [a.get("alt", "") for a, _ in page.all("img")]
        assert [alt for alt in words if not alt.strip() or "_images/" in alt] == [], name
        levels = [int(tag[1]) for tag, _, _ in page.tags if re.fullmatch(r"h[1-6]", tag)]
        assert levels.count(1) == 1 and levels[0] == 1, name
        assert all(after <= before + 1 for before, after in pairwise(levels)), (name, levels)


def test_pages_fit_a_phone_and_have_contrast(site):
    """In Chromium: on no page does anything stick out at 360 px, every table begins with two
    columns in view, and text stands out in light and in dark, on a page of each kind.
    """
    wide, faint = [], []
    with headless_chromium() as browser:
        tab = browser.new_page(viewport=NARROW)
        for path in sorted(site.rglob("*.html")):
            tab.goto(path.as_uri())
            wide += [f"{path.name}: {element}" for element in tab.evaluate(STICKS_OUT)]
            wide += [f"{path.name}: one column, {cell}" for cell in tab.evaluate(ONE_COLUMN)]
            if tab.evaluate("document.documentElement.scrollWidth") > NARROW["width"]:
                wide.append(path.name)
        tab.add_style_tag(content="article p { min-width: 500px }")
        assert tab.evaluate(STICKS_OUT)  # the check sees a planted one
        tab.goto((site / "commands.html").as_uri())
        tab.add_style_tag(content="article td:first-child { min-width: 20rem }")
        assert tab.evaluate(ONE_COLUMN)
        for scheme in ("light", "dark"):
            tab = browser.new_page(viewport=NARROW, color_scheme=scheme)
            for name in KINDS:
                tab.goto((site / f"{name}.html").as_uri())
                faint += [f"{name} ({scheme}): {text}" for text in tab.evaluate(CONTRAST)]
        tab.set_viewport_size(WIDE)
        tab.goto((site / "search.html").as_uri() + "?q=ground+effect")
        tab.wait_for_selector("ul.search li")
        tab.set_content('<p style="color: #999; background: #fff">faint</p>')
        assert len(tab.evaluate(CONTRAST)) == 1  # the check sees 2.8
    assert wide == [] and faint == []
