"""The page is one file that needs no network, can be read without seeing, and shows text as it was written."""

import base64
from html.parser import HTMLParser

import pytest

from falconwing_kit.tools.reports.page import Picture, paragraph, picture, table, write_page

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
        "a style fetches something" for style in page.text_in("style") if "url(" in style or "@import" in style
    ]
    return problems


@pytest.fixture
def png(tmp_path):
    """The smallest thing that calls itself a PNG; the page must carry it to the byte."""
    path = tmp_path / "picture.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    return path


def test_page_needs_nothing_but_itself(png, tmp_path):
    """Every element stands in a page of each kind; the rules are those of a file that is opened without a network."""
    shown = Picture(png, "A caption with <em>words</em>.", "what it shows")
    parts = ["<h1>Title</h1>", paragraph("Text", "lead"), table("T", ("a", "b"), [("1", "2")], best=0), picture(shown)]
    write_page(tmp_path / "page.html", "A title", parts)
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


def test_picture_carries_its_file_to_the_byte(png):
    """Base64 is undone with the standard library."""
    ((_, attributes),) = [each for each in Reader(picture(Picture(png, "caption", "alt"))).tags if each[0] == "img"]
    kind, data = attributes["src"].split(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data, validate=True) == png.read_bytes()


def test_words_come_out_as_they_went_in(png, tmp_path):
    """HTML's own signs in every place that takes plain text; a parser must give them back and see no new element."""
    words = """<b>"5 < 6" & 'more'</b>"""
    html = table(words, (words, words), [(words, words)]) + picture(Picture(png, "caption", words))
    write_page(tmp_path / "page.html", words, [html])
    page = Reader((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert "b" not in [tag for tag, _ in page.tags]
    for place, count in (("caption", 1), ("th", 2), ("td", 2), ("title", 1)):
        assert page.text_in(place) == [words] * count, place
    assert [attributes["alt"] for tag, attributes in page.tags if tag == "img"] == [words]


def test_table_keeps_its_order_and_marks_one_row():
    """Two by two cells, read row by row; the second row is the best."""
    page = Reader(table("T", ("fit", "error"), [("one", "1.0"), ("two", "0.5")], best=1))
    assert page.text_in("th") == ["fit", "error"]
    assert page.text_in("td") == ["one", "1.0", "two", "0.5"]
    assert [attributes.get("class") for tag, attributes in page.tags if tag == "tr"] == [None, None, "best"]


def test_page_is_written_whole_or_not_at_all(tmp_path):
    """A part that is no text stops the page; the page of before stays and nothing lies beside it."""
    path = tmp_path / "page.html"
    write_page(path, "old", ["<p>old</p>"])
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_page(path, "new", ["<p>new</p>", None])
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
