"""Notebooks that are slow to read: what each does to a collector that is not linear, and its bytes.

A code cell may hold 2 MB. Blanks and names are quadratic for a careless pattern or search, the
others for Python's own parser, or many objects for few letters.
"""

import json

from falconwing_kit.tools.grading.collect import MAX_CODE
from tests.tools.grading import toys


def _chain(size):
    count = size // 16
    names = "\n".join(f"a{number} = a{number + 1}" for number in range(count))
    return f"{names}\ndef stretch(x, gain): return a0"


TEXTS = {  # text of a code cell of a size [letters]
    "a line of blanks": lambda size: " " * size + "(",
    "words and blanks before no question mark": lambda size: "a b " * (size // 4) + "!",
    "tabulators in an open bracket": lambda size: "(" + "\t" * size,
    "question marks": lambda size: "a" + "?" * size,
    "a chain of names": _chain,
    "one name bound again and again": lambda size: "stretch = stretch\n" * (size // 18),
    "statements without end": lambda size: "a;" * (size // 2),
    "functions without end": lambda size: "def stretch():0\n" * (size // 16),
    "an f-string of many parts": lambda size: "stretch = f'" + "{a}" * (size // 3) + "'",
    "a list of lists": lambda size: "stretch = [" + "[]," * (size // 3) + "]",
    "a list of functions": lambda size: "stretch = [" + "lambda:0," * (size // 9) + "]",
    "a sum of calls": lambda size: "stretch = " + "+".join(["f()"] * (size // 4)),
    "a comparison of many": lambda size: "stretch = " + "<".join("a" * (size // 2)),
    "imports without end": lambda size: "import " + ",".join(["b"] * (size // 2)),
    "lines of IPython": lambda size: "%a\n" * (size // 3),
    "a deep block": lambda size: "".join(" " * n + "if a:\n" for n in range(98)) + " " * 98 + "a",
    "a long number": lambda size: "stretch = " + "9" * size,
}


def notebook_of(name, size=MAX_CODE - 400):
    """A notebook with that cell; a correct function stands in the next one."""
    return toys.notebook_bytes(toys.HEAD, TEXTS[name](size), toys.BRAKE)


NOTEBOOKS = {name: lambda name=name: notebook_of(name) for name in TEXTS} | {
    "millions of cells": lambda: b'{"cells": [' + b"{}," * 2_400_000 + b"{}]}",
    "millions of lists": lambda: b'{"cells": [], "x": [' + b"[]," * 2_400_000 + b"0]}",
    "ten thousand cells": lambda: toys.notebook_bytes(*["stretch = stretch"] * 10_000),
    "deep lists": lambda: b'{"cells": ' + b"[" * 5_000_000 + b"}",
    "millions of lines": lambda: json.dumps(
        {"cells": [{"cell_type": "code", "source": [""] * 4_900_000}]}, separators=(",", ":")
    ).encode(),
}
