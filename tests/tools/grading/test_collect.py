"""Collector: a function's dependencies are collected, whatever happened to the cells."""

import json
import resource
import sys
import time

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading import collect
from falconwing_kit.tools.grading.bounded import TooMuchError, call_bounded
from falconwing_kit.tools.grading.collect import (
    MAX_CELLS,
    MAX_CODE,
    MAX_FILE,
    MAX_PIECES,
    Source,
    collect_source,
    collect_sources,
    parse_notebook,
    read_notebook,
    require_notebook_of,
)
from tests.tools.grading import toys
from tests.tools.grading.hostile import NOTEBOOKS, notebook_of


def source_of(*cells, name="f", packages=("numpy",)):
    return collect_source(parse_notebook(toys.notebook_bytes(*cells), "a.ipynb"), name, packages)


def result_of(*cells, arguments=(1.0,)):
    """What f gives when only what was collected is run."""
    space = {}
    exec(source_of(*cells).text, space)
    return space["f"](*arguments)


def test_function_brings_what_it_names_and_nothing_else():
    """By hand: f needs g, g needs A, A needs np; h, B and the call at the end are not run."""
    cells = (
        "import numpy as np",
        "A = np.ones(2)\nB = 1 / 0",
        "def g(x):\n    return x + A[0]",
        "def h(): pass",
        "def f(x):\n    return g(x)",
        "print(f(1), 1 / 0)",
    )
    source = source_of(*cells)
    assert [line.split("(")[0] for line in source.text.splitlines() if line[0] != " "] == [
        "import numpy as np",
        "A = np.ones",
        "def g",
        "def f",
    ]
    assert source.problems == ()
    assert result_of(*cells) == 2.0


def test_local_names_do_not_drag_cells_along():
    """x, i and total are f's own; the notebook's of the same name would fail."""
    cells = (
        "x = 1 / 0\ni = 1 / 0\ntotal = 1 / 0",
        "def f(x):\n    total = sum(i for i in range(int(x)))\n    return total",
    )
    assert result_of(*cells, arguments=(4.0,)) == 6


@pytest.mark.parametrize(
    "cells",
    [
        ("C = 2.0", "D = 3.0", "C = D * C", "def f(x):\n    return C * x"),
        ("T = {}\nT['a'] = 6.0", "def f(x):\n    return T['a'] * x"),
        ("a, (b, *c) = 1.0, (6.0, 2.0)", "def f(x):\n    return b * x"),
        ("k: float = 6.0", "def f(x, k=k):\n    return k * x"),
        ("def scale(g):\n    return lambda x: 6.0 * g(x)", "@scale\ndef f(x):\n    return x"),
        ("class Gain:\n    value = 6.0", "def f(x):\n    return Gain.value * x"),
        ("f = lambda x: 6.0 * x",),
        ("%matplotlib inline\nK = 6.0\n!ls\nK?", "def f(x):\n    return K * x"),
        ("%%time\nK = 6.0", "def f(x):\n    return K * x"),
        ("%%bash\nrm -rf", "def f(x):\n    return 6.0 * x"),
        ("def f(x):\n    return 6.0 * x", "def f(x):\n    raise NotImplementedError('write f')"),
        ("def f(x):\n    return 1.0 * x", "def f(x):\n    return 6.0 * x"),
        ("def f(x):\n    return 6.0 * x", "this is (no Python"),
        ("from math import *\ndef f(x):\n    return floor(6.5) * x",),
        (
            "def even(n):\n    return n == 0 or odd(n - 1)",
            "def odd(n):\n    return n > 0 and even(n - 1)",
            "def f(x):\n    return 6.0 * x if even(4) else 0.0",
        ),
        (
            "from __future__ import annotations\nimport os, math",
            "def f(x: Undefined) -> Undefined:\n    return 6.0 * x",
        ),
    ],
    ids=range(16),
)
def test_python_as_students_write_it_is_collected(cells):
    """By hand: each f is six times x."""
    assert result_of(*cells, arguments=(2.0,)) == 12.0


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        (("x = 1",), "no code cell defines f"),
        (("def f(x) return x",), "code cell 1 is not Python: line 1"),
        (
            ("from falconwing_kit.scene import render\ndef f(x):\n    return render(x)",),
            "uses falconwing_kit, which",
        ),
        (
            ("import scipy.optimize as so, numpy\ndef f(x):\n    return so.brentq(x)",),
            "uses scipy, which",
        ),
        (("def f(x):\n    import torch\n    return torch.ones(x)",), "uses torch, which"),
        (("for k in range(3): pass", "def f(x):\n    return k"), "inside an if, for, with or try"),
        (("def f(x):\n    return speed",), "uses speed, which is defined nowhere"),
        (("def f(x): return 1", "def f(x): return 2"), "written 2 times; the last one counts"),
    ],
)
def test_problems_are_said_in_words(cells, words):
    """What a student must change, named."""
    assert any(words in problem for problem in source_of(*cells).problems)


def test_allowed_packages_are_no_problem():
    """The lab says which; the standard library and given always are."""
    cells = (
        "import scipy.optimize as so\nimport math, given\ndef f(x):\n    return so, math, given",
    )
    assert source_of(*cells, packages=("numpy", "scipy")).problems == ()


def test_nothing_is_executed(tmp_path):
    """A cell that would leave a file behind leaves none."""
    mark = tmp_path / "mark"
    source_of(f"K = open({str(mark)!r}, 'w')", "def f(x):\n    return K")
    assert not mark.exists()


@pytest.mark.parametrize(
    "text",
    [
        "-" * 60000 + "1",
        "a" + ".a" * 60000,
        "(" * 60000,
        "not " * 30000 + "1",
        "a" + "()" * 60000,
        "x\0y",
        "\ud800",
    ],
    ids=["minus", "dots", "brackets", "not", "calls", "nul", "surrogate"],
)
def test_code_that_breaks_parsers_is_a_problem_in_words(text):
    """Python's own parser gives up on these in several ways; the other cells still count."""
    source = source_of("def f(x):\n    return x", text)
    assert "def f" in source.text
    assert any("code cell 2 is not Python" in problem for problem in source.problems)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[]",
        b"null",
        b"{}",
        b'{"cells": 1}',
        b'{"worksheets": []}',
        b"[" * 100_000,
        b'{"cells": [' + b"1," * 5_100_000 + b"1]}",
        b" " * (MAX_FILE + 1),
    ],
    ids=range(11),
)
def test_other_files_are_refused_in_one_sentence(data):
    """Whatever a student uploads."""
    with pytest.raises(InputError, match=r"^a\.ipynb: "):
        parse_notebook(data, "a.ipynb")


def test_odd_cells_are_passed_over():
    """Cells that are no cells, and sources that are no text; the good one counts.

    A byte order mark is no harm.
    """
    cells = [
        1,
        None,
        {},
        {"cell_type": "code"},
        {"cell_type": "code", "source": 5, "metadata": 7},
        {"cell_type": "code", "source": ["def f(x):\r\n", 3, "    return x\r\n"]},
    ]
    data = b"\xef\xbb\xbf" + json.dumps({"cells": cells}).encode()
    assert "return x" in collect_source(parse_notebook(data, "a.ipynb"), "f").text


@pytest.mark.parametrize(
    ("metadata", "line", "kit"),
    [
        ({"falconwing_kit": "0.2"}, "", "0.2"),
        ({"falconwing_kit": "0.10"}, "*Notebook of falconwing-kit 0.2.*", "0.10"),
        ({}, "*Notebook of falconwing-kit 0.2.*", "0.2"),
        (None, "*Notebook of falconwing-kit 0.2.*", "0.2"),
        ({"falconwing_kit": 2}, "", "0.1"),
        ({"falconwing_kit": "0.2; rm"}, "", "0.1"),
        ({"falconwing_kit": "9" * 9999 + ".0"}, "", "0.1"),
        ({}, "", "0.1"),
        ([], "Notebook of falconwing-kit 0.2", "0.1"),
    ],
)
def test_a_notebook_says_which_kit_made_it(metadata, line, kit):
    """By its metadata, else by the line below the title; 0.1 wrote neither."""
    data = toys.notebook_bytes(
        toys.cell(f"# Lab\n\n{line}", "markdown"), "x = 1", metadata=metadata
    )
    assert parse_notebook(data, "a.ipynb").kit == kit


@pytest.mark.parametrize(
    ("kit", "fits"), [("0.1", False), ("0.2", True), ("0.10", True), ("1.0", True)]
)
def test_a_notebook_of_an_older_kit_is_refused_in_one_sentence(kit, fits):
    """Versions are numbers, not texts: 0.10 is newer than 0.2.

    A lab that names no version takes any notebook.
    """
    notebook = parse_notebook(
        toys.notebook_bytes("x = 1", metadata={"falconwing_kit": kit}), "lab04.ipynb"
    )
    require_notebook_of(notebook, "", "lab04.ipynb")
    if fits:
        require_notebook_of(notebook, "0.2", "lab04.ipynb")
        return
    with pytest.raises(InputError) as refusal:
        require_notebook_of(notebook, "0.2", "lab04.ipynb")
    assert str(refusal.value) == (
        "lab04.ipynb: expected a notebook of falconwing-kit 0.2, got one of 0.1: "
        "download the new notebook and copy your answers over"
    )


def test_cells_know_their_role(tmp_path):
    """What a report shows: figures and answers, by the names in their metadata."""
    file = tmp_path / "a.ipynb"
    file.write_bytes(
        toys.notebook_bytes(
            toys.cell("words", "markdown", answer="q1"), toys.cell("plot()", figure="radius")
        )
    )
    cells = read_notebook(file).cells
    assert [(cell.code, cell.role, cell.name) for cell in cells] == [
        (False, "answer", "q1"),
        (True, "figure", "radius"),
    ]


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (lambda: b" " * (MAX_FILE + 1), "32 MiB"),
        (lambda: b"[" + b"1," * MAX_PIECES + b"1]", "millions of values"),
        (lambda: toys.notebook_bytes("#" * (MAX_CODE + 1)), "2 MiB of text"),
    ],
    ids=["a large file", "millions of values", "much code"],
)
def test_a_notebook_that_is_too_large_is_refused_before_it_is_read(data, word):
    """Before the parser, whose memory is many times the text's, sees it."""
    with pytest.raises(InputError, match=word):
        parse_notebook(data(), "a.ipynb")


@pytest.mark.parametrize(
    ("name", "size"), [("a line of blanks", 40_000), ("a chain of names", 60_000)]
)
def test_collecting_is_linear(name, size):
    """Eight times the text takes about eight times as long; earlier versions took 64 times."""

    def processor_s(size):
        notebook = parse_notebook(notebook_of(name, size), "a.ipynb")
        begin = time.process_time()
        collect_source(notebook, "stretch")
        return time.process_time() - begin

    small, large = (  # each text is new, since the last one read is kept
        min(processor_s(n + more) for more in range(3)) for n in (size, 8 * size)
    )
    assert large < 24.0 * small


@pytest.mark.skipif(sys.platform != "linux", reason="the grader's limits are Linux's")
@pytest.mark.parametrize("name", ["a line of blanks", "functions without end", "millions of cells"])
def test_the_slowest_notebooks_are_read_within_ten_seconds(name):
    """Of processor time, children's included; all of them: bench_attacks.py."""
    begin = _processor_s()
    try:
        notebook = parse_notebook(NOTEBOOKS[name](), "a.ipynb")
        found = collect_sources(notebook, ["stretch", "brake"])
        assert found["brake"].text
    except InputError as error:
        assert "expected" in str(error)
    assert _processor_s() - begin < 10.0


def _processor_s():
    own, children = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


@pytest.mark.skipif(sys.platform != "linux", reason="the grader's limits are Linux's")
@pytest.mark.parametrize("how", ["time", "memory"])
def test_code_that_python_itself_cannot_read_is_the_students_problem(monkeypatch, how):
    """Whatever input makes the parser slow or large: 8 s and 1 GiB stand for it."""

    def endless(*_):
        kept = []
        while how == "time" and time.process_time() < 8.0:
            pass
        while how == "memory" and len(kept) < 1024:
            kept.append(bytearray(1 << 20))
        return Source("")

    monkeypatch.setattr(collect, "COLLECT_S", 1.0 if how == "time" else 60.0)
    monkeypatch.setattr(collect, "COLLECT_MIB", 100)
    monkeypatch.setattr(collect, "collect_source", endless)
    begin = _processor_s()
    with pytest.raises(InputError, match="expected code that is read within"):
        collect_sources(parse_notebook(toys.notebook_bytes("f = 1"), "a.ipynb"), ["f"])
    assert _processor_s() - begin < 5.0


def test_several_functions_are_those_collected_one_by_one():
    """The bounded child's answers are the same."""
    notebook = parse_notebook(toys.notebook_bytes("A = 1\ndef f(): return A", "g = B"), "a.ipynb")
    names = ["f", "g", "h"]
    found = collect_sources(notebook, names)
    assert found == {name: collect_source(notebook, name) for name in names}
    assert all(isinstance(each, Source) for each in found.values())


@pytest.mark.skipif(sys.platform != "linux", reason="processes fork there")
def test_bounded_calls_answer_or_fail():
    """A result passes whole, larger than a pipe holds; an error of the kit's gives none."""
    assert call_bounded(lambda: ["x" * 200_000, {"a": 1.5}], 1.0, 64) == ["x" * 200_000, {"a": 1.5}]
    with pytest.raises(TooMuchError):
        call_bounded(lambda: 1 / 0, 1.0, 64)


def test_too_many_cells_are_refused():
    """One more than the limit."""
    data = b'{"cells": [' + b"{}," * MAX_CELLS + b"{}]}"
    with pytest.raises(InputError, match=f"at most {MAX_CELLS} cells"):
        parse_notebook(data, "a.ipynb")
