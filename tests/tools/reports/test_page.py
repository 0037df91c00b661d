"""The page is one file that needs no network, can be read without seeing, and shows text as it was
written.
"""

import base64
import itertools
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import pytest
from jinja2 import UndefinedError

import falconwing_kit
from falconwing_kit.tools.reports.page import figure, render, write_page

PAGE = """{% extends "page.html.j2" %}{% from "parts.html.j2" import picture, table %}
{% block title %}{{ words }}{% endblock %}
{% block main %}
<h1>Title</h1><p class="lead">Text</p>
{{ table(words, (words, words), [(words, words)], best=0) }}
{% call picture(png, alt=words) %}A caption with <em>words</em>.{% endcall %}
{% endblock %}
"""
TABLE = '{% from "parts.html.j2" import table %}{{ table("T", ("fit", "error"), rows, best=1) }}'
FETCHING = ("src", "srcset", "data", "poster", "action", "background", "manifest")
NEVER_CLOSED = ("meta", "img", "br")


class Reader(HTMLParser):
    """What a browser would find in a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.words, self.open, self.crossed = [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in NEVER_CLOSED:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.crossed.append(tag)

    def handle_data(self, data):
        self.words.append((self.open[-1] if self.open else "", data))

    def text_in(self, tag: str) -> list[str]:
        """The text that stands directly in elements of this kind."""
        return [words for inside, words in self.words if inside == tag]


def page_problems(text: str) -> list[str]:
    """Why a page is not whole in itself, one line each; a plain link to follow is allowed."""
    page = Reader(text)
    problems = [f"{tag} is not closed in its order" for tag in page.crossed + page.open]
    for tag, attributes in page.tags:
        if tag in ("script", "link", "iframe", "object", "embed", "base"):
            problems.append(f"<{tag}> brings something from outside")
        for name, value in attributes.items():
            if name in FETCHING and not (value or "").startswith("data:"):
                problems.append(f"{tag} fetches {value}")
            if name == "href" and tag != "a":
                problems.append(f"{tag} fetches {value}")
        if tag == "img" and not (attributes.get("alt") or "").strip():
            problems.append("an image has no text for who cannot see it")
    problems += [
        "a style fetches something"
        for style in page.text_in("style")
        if "url(" in style or "@import" in style
    ]
    return problems


@pytest.fixture
def png(tmp_path):
    """The smallest thing that calls itself a PNG; the page must carry it to the byte."""
    path = tmp_path / "picture.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    return path


@pytest.fixture
def template(tmp_path):
    """A file with a template's text, in a folder of its own."""
    names = (tmp_path / f"template{number}.html.j2" for number in itertools.count())

    def write(text):
        path = next(names)
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_page_needs_nothing_but_itself(png, template, tmp_path):
    """Every element stands in a page of each kind; the rules are those of a file that is opened
    without a network.
    """
    write_page(tmp_path / "page.html", template(PAGE), png=png, words="words")
    assert page_problems((tmp_path / "page.html").read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("planted", "problem"),
    [
        ('<img alt="a" src="https://example.org/a.png">', "img fetches"),
        ('<img alt="a" src="a.png">', "img fetches"),
        ('<link rel="stylesheet" href="https://example.org/a.css">', "from outside"),
        ("<script>fetch('x')</script>", "from outside"),
        ("<style>@import 'a.css';</style>", "style fetches"),
        ('<img src="data:image/png;base64,AA==">', "no text"),
        ("<p><em>text</p></em>", "not closed"),
    ],
)
def test_planted_fault_is_seen(planted, problem):
    """The check itself, on one page a fault; a plain link is none."""
    assert any(problem in line for line in page_problems(planted))
    assert page_problems('<p>see <a href="https://example.org">there</a></p>') == []


def test_picture_carries_its_file_to_the_byte(png, template):
    """Base64 is undone with the standard library."""
    page = Reader(render(template(PAGE), png=png, words="words"))
    ((_, attributes),) = [each for each in page.tags if each[0] == "img"]
    kind, data = attributes["src"].split(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data, validate=True) == png.read_bytes()


def test_words_come_out_as_they_went_in(png, template, tmp_path):
    """HTML's own signs in every place that takes plain text; a parser must give them back and see
    no new element.
    """
    words = """<b>"5 < 6" & 'more'</b>"""
    write_page(tmp_path / "page.html", template(PAGE), png=png, words=words)
    page = Reader((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert "b" not in [tag for tag, _ in page.tags] and "em" in [tag for tag, _ in page.tags]
    for place, count in (("caption", 1), ("th", 2), ("td", 2), ("title", 1)):
        assert page.text_in(place) == [words] * count, place
    assert [attributes["alt"] for tag, attributes in page.tags if tag == "img"] == [words]


def test_part_of_a_page_is_escaped_once(template):
    """What `render` gives may stand in another template as it is; a text beside it may not."""
    part = render(template("<em>{{ words }}</em>"), words="a < b")
    both = render(template("{{ part }} {{ text }}"), part=part, text="<em>")
    assert both == "<em>a &lt; b</em> &lt;em&gt;"


def test_table_keeps_its_order_and_marks_one_row(template):
    """Two by two cells, read row by row; the second row is the best."""
    page = Reader(render(template(TABLE), rows=[("one", "1.0"), ("two", "0.5")]))
    assert page.text_in("th") == ["fit", "error"]
    assert page.text_in("td") == ["one", "1.0", "two", "0.5"]
    assert [attributes.get("class") for tag, attributes in page.tags if tag == "tr"] == [
        None,
        None,
        "best",
    ]


def test_cells_carry_their_column_for_a_phone(template):
    """Where the head is hidden, each cell begins with the name of its column."""
    page = Reader(render(template(TABLE), rows=[("one", "1.0")]))
    labels = [attributes["data-label"] for tag, attributes in page.tags if tag == "td"]
    assert labels == ["fit", "error"]


def test_picture_is_never_larger_than_it_was_drawn(png, template, tmp_path):
    """4.4 inch at 170 pixels per inch, rounded to whole pixels and to whole pixels per metre; a
    file that does not say has no limit.
    """
    with figure(tmp_path / "drawn.png", 1, 1, (4.4, 1.0), dpi=170) as axes:
        axes[0, 0].plot([0.0, 1.0])
    for path, width in ((tmp_path / "drawn.png", "4.40in"), (png, "none")):
        page = Reader(render(template(PAGE), png=path, words="words"))
        (style,) = [attributes["style"] for tag, attributes in page.tags if tag == "img"]
        assert style == f"max-width: {width}"


def test_page_is_written_whole_or_not_at_all(png, template, tmp_path):
    """A value that is not given stops the page; the page of before stays and nothing lies beside
    it.
    """
    path = tmp_path / "pages" / "page.html"
    path.parent.mkdir()
    write_page(path, template(PAGE), png=png, words="old")
    before = path.read_bytes()
    with pytest.raises(UndefinedError, match="words"):
        write_page(path, template(PAGE), png=png)
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]


def test_every_template_of_the_kit_ships_with_it():
    """The build's pattern for package data covers them, and each is named by the code beside it or
    by another one.
    """
    package = Path(falconwing_kit.__file__).parent
    shipped = tomllib.loads((package.parent / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]["*"]
    templates = sorted(package.rglob("*.j2"))
    assert templates and "*.j2" in shipped
    for template in templates:
        assert (template.parent / "__init__.py").is_file(), (
            f"{template}: not in a package, so it would not ship"
        )
        beside = [
            path
            for kind in ("*.py", "*.j2")
            for path in template.parent.glob(kind)
            if path != template
        ]
        assert any(template.name in path.read_text(encoding="utf-8") for path in beside), (
            f"{template}: nobody uses it"
        )
