"""Similarity: disguised copies are found, other solutions not, and common code has no weight."""

import ast
import textwrap

from falconwing_kit.tools.grading.course.similar import (
    compare_class,
    fingerprints,
    kit_functions,
    similar_pairs,
)
from tests.tools.grading import toys
from tests.tools.grading.classes import LAB

LOOP = textwrap.dedent('''
    def path(points, limit):
        """The longest step."""
        best = 0.0
        for here, there in zip(points[:-1], points[1:]):
            step = np.hypot(there[0] - here[0], there[1] - here[1])
            if step > best and step < limit:
                best = step
        return best / limit
''')
RENAMED = textwrap.dedent("""
    def path(p: np.ndarray, most: float = 3) -> float:
        # my own work
        m = 7
        for a, b in zip(p[:-2],
                        p[2:]):
            d = np.hypot(b[1] - a[1], b[0] - a[0])
            if d > m and d < most: m = d
        return m / most
""")
ARRAYS = textwrap.dedent("""
    def path(points, limit):
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return steps[steps < limit].max(initial=0.0) / limit
""")


def share(a, b):
    return len(fingerprints(a) & fingerprints(b)) / min(len(fingerprints(a)), len(fingerprints(b)))


def test_names_numbers_and_layout_do_not_count():
    """The same function in disguise has nearly the same fingerprints.

    Another way to the same answer hardly any.
    """
    assert share(LOOP, RENAMED) > 0.6
    assert share(LOOP, LOOP.replace("best", "x").replace("0.0", "1.5")) == 1.0
    undocumented = LOOP.replace('    """The longest step."""\n', "")
    assert fingerprints(undocumented) == fingerprints(LOOP) and undocumented != LOOP
    assert share(LOOP, ARRAYS) < 0.2


def test_what_is_no_python_has_none():
    """Whatever a student hands in."""
    assert [fingerprints(text) for text in ("", "def (", "x = 1", "(" * 5000 + ")" * 5000)] == [
        frozenset()
    ] * 4


def test_common_code_weighs_less_than_rare_code():
    """Eight of ten share a loop, two another function: the two rank above the eight."""
    now = {f"s{n}": fingerprints(LOOP) for n in range(8)} | {
        f"copy{n}": fingerprints(ARRAYS) for n in range(2)
    }
    pairs = {(p.left, p.right): p for p in similar_pairs("path", now, {}, {})}
    assert pairs["copy0", "copy1"].share == 1.0
    assert len(pairs) == 28 + 1  # of eight, and of two
    pieces = {name: len(fingerprints(text)) for name, text in (("loop", LOOP), ("arrays", ARRAYS))}
    rare = pairs["copy0", "copy1"].weight / pieces["arrays"]
    common = pairs["s0", "s1"].weight / pieces["loop"]
    assert rare > 5.0 * common  # by hand log2(11 / 2) = 2.46 and log2(11 / 8) = 0.46


def test_copy_of_the_kit_and_of_an_earlier_class_is_found(tmp_path):
    """A kit function under another name, and last year's: both are listed, with both texts."""
    name, text = next(
        (n, t) for n, t in kit_functions().items() if n == "tools.grading.lab.course_constants"
    )
    copied = text.replace("course_constants", "stretch").replace("share", "d")
    (tmp_path / "old_dan.ipynb").write_bytes(toys.notebook_bytes(LOOP.replace("path", "brake")))
    now = {
        "eve": {"stretch": copied, "brake": RENAMED.replace("path", "brake")},
        "ada": {"stretch": ARRAYS, "brake": ""},
    }
    found, texts = compare_class(toys.LAB, LAB, now, tmp_path)
    listed = {(each.left, each.right): each.functions for each in found}
    assert listed["eve", f"kit: {name}"] == "stretch 100 %"
    assert listed["eve", "before: old_dan"].startswith("brake ")
    assert not [pair for pair in listed if pair[0] == "ada"]
    assert (
        "def brake(points" in texts["brake", "before: old_dan"]
        and texts["stretch", f"kit: {name}"] == text
    )


def test_texts_of_the_kit_are_those_of_its_files(tmp_path):
    """Python's own cut of a small file: letters of several bytes, a function inside another, on one
    line, with a decorator; a form feed ends no line.
    """
    text = (
        "# \N{GREEK SMALL LETTER ALPHA}\n@cache\ndef outer(x):\n    s = 'ä\x0c'; y = 'ö'\n"
        "    def inner(x): return 'ü' + x\n    return inner\ndef one(x): return 'ß'"
    )
    (tmp_path / "part.py").write_text(text, encoding="utf-8")
    functions = [each for each in ast.walk(ast.parse(text)) if isinstance(each, ast.FunctionDef)]
    expected = {f"part.{each.name}": ast.get_source_segment(text, each) for each in functions}
    assert kit_functions(tmp_path) == expected and len(expected) == 3


def test_huge_functions_are_not_compared():
    """A student's 2 MB would take minutes beside every classmate's; no function is so long."""
    short = "def f(x):\n" + "    x = x + 1\n" * 20
    assert fingerprints(short)
    assert fingerprints(short + "    x = x + 1\n" * 10_000) == frozenset()
