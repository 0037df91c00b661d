"""The manual, built once for all tests, and what is in it."""

import importlib.util
import json
import re
import time
import zlib
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MANUAL = ROOT / "manual"


def script(name):
    """A program of manual/ as a module."""
    spec = importlib.util.spec_from_file_location(Path(name).stem, MANUAL / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def pdf():
    """The PDF's bytes."""
    return script("build.py").compiled("pdf")


@cache
def html():
    """The HTML as text."""
    return script("build.py").compiled("html").decode("utf-8")


@cache
def cost_s():
    """CPU seconds of building both anew."""
    begin = time.process_time()
    script("build.py").compiled("pdf")
    script("build.py").compiled("html")
    return time.process_time() - begin


@cache
def elements(selector):
    """What typst finds in the source: a label such as "<command>", or a kind of element such as
    "enum".
    """
    import typst

    return json.loads(
        typst.query(str(MANUAL / "manual.typ"), selector, **script("build.py").where())
    )


def commands():
    """(kind, line) of every command that is printed, in order."""
    return [(found["value"]["kind"], found["value"]["line"]) for found in elements("<command>")]


@cache
def pdf_objects():
    """Everything in the PDF that can be read: its own bytes and every compressed stream of objects,
    as text.
    """
    parts = [pdf()]
    for stream in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf(), re.DOTALL):
        try:
            parts.append(zlib.decompress(stream))
        except zlib.error:
            continue  # a picture
    return b"\n".join(parts).decode("latin-1")


INLINE = {"code", "span", "em", "strong", "a", "sub", "sup", "b", "i"}


class Page(HTMLParser):
    """What the browser would be given: tags with attributes, and the text that is read."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self._open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in INLINE:
            self.words.append(" ")
        self.tags.append((tag, dict(attrs), tuple(self._open)))
        if tag not in ("img", "meta", "br", "link"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        if "style" not in self._open:
            self.words.append(data)

    def all(self, tag):
        """Attributes and parents of every element of a kind."""
        return [(attributes, parents) for name, attributes, parents in self.tags if name == tag]

    @property
    def text(self):
        """All words, spaces put right."""
        return re.sub(r"\s+", " ", "".join(self.words))


@cache
def page():
    """The HTML, read."""
    return Page(html())
