"""Figures: notebooks run in a sandbox without leaks; stored pictures are checked."""

import base64
import json
import struct
import time
import zlib

import pytest

from falconwing_kit.tools.grading.course import figures
from falconwing_kit.tools.grading.course.figures import (
    figures_in,
    missing_for_running,
    run_notebook,
)
from falconwing_kit.tools.grading.sandbox import limits
from tests.tools.grading import toys

DRAW = "import matplotlib.pyplot as plt\nplt.plot([1, 2])\nplt.show()"
FILES = {toys.LAB / "given.py": "given.py", toys.LAB / "checks.py": "checks.py"}
needs_kernel = pytest.mark.skipif(bool(missing_for_running()), reason='pip install -e ".[labs]"')


def png(width=2, height=1):
    """A picture of one grey, by the format's own rules."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    rows = b"".join(b"\0" + b"\x80" * width for _ in range(height))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def stored(data, **metadata):
    """A notebook's cell with a picture in it."""
    return {"metadata": metadata, "outputs": [{"data": {"image/png": data}}]}


def b64(data):
    return base64.b64encode(data).decode()


def test_stored_picture_comes_out_as_it_is():
    """By name, or all; a picture may stand in lines, as some programs save it."""
    text = b64(png())
    content = {
        "cells": [stored(text, figure="a"), stored([text[:20] + "\n", text[20:]]), {"metadata": {}}]
    }
    assert figures_in(content, "a") == [text]
    assert figures_in(content) == [text, text]
    assert figures_in(content, "b") == []


@pytest.mark.parametrize(
    "content",
    [
        None,
        [],
        {"cells": 3},
        {"cells": [1, {"outputs": [2, {"data": 3}, {"data": {"image/png": 4}}]}]},
        {"cells": [stored("<script>alert(1)</script>")]},
        {"cells": [stored(b64(b"GIF89a\0\0" + b"\0\0\0\x02" * 9))]},
        {"cells": [stored(b64(png()[:18]))]},
        {"cells": [stored(b64(png(60_000, 1)))]},
        {"cells": [stored("A" * 9_000_000)]},
        {"cells": [stored(b64(png()) + '" onerror="x')]},
    ],
)
def test_what_is_no_picture_stays_out(content):
    """Damaged notebooks, markup, other formats, truncated and oversized pictures."""
    assert figures_in(content) == []


@pytest.fixture(scope="module")
def ran():
    """A notebook that draws between escape attempts, run in a sandbox: pictures and findings."""
    tries = {
        "network": "import socket\nsocket.create_connection(('127.0.0.1', 22), 1)",
        "any network": "import socket\nsocket.create_connection(('1.1.1.1', 80), 1)",
        "home": "import os\nassert os.listdir(os.path.expanduser('~/..')) and open('/etc/shadow')",
        "secrets": "import os\nassert [n for n in os.environ if 'SECRET' in n]",
        "hidden cases": "import os\n"
        f"tops = ('/sandbox/work', '/tmp', '/home', '/root', {str(toys.LAB.parents[2])!r})\n"
        "assert [f for top in tops for *_, files in os.walk(top) for f in files if f in "
        "('hidden.py', 'notes.md')]",
        "kit changed": "import falconwing_kit\nopen(falconwing_kit.__file__, 'a').write('#')",
        "lab changed": "open('/sandbox/work/given.py', 'a').write('#')",
        "disk": "open('/tmp/x', 'wb').write(b'0' * (100 << 20))",
        "not written": "raise NotImplementedError",
    }
    cells = [
        toys.cell(DRAW, figure="first"),
        toys.cell("import falconwing_kit\nfrom given import COHORT"),
    ]
    guarded = "try:\n    exec({!r})\nexcept BaseException:\n    pass\nelse:\n    exec({!r})"
    cells += [toys.cell(guarded.format(text, DRAW), figure=name) for name, text in tries.items()]
    cells += [
        toys.cell("1 / 0"),
        toys.cell("if COHORT['offset'] == 2.25:\n    exec(" + repr(DRAW) + ")", figure="last"),
    ]
    return tries, run_notebook(toys.notebook_bytes(*cells), FILES, {"offset": 2.25})


@toys.needs_sandbox
@needs_kernel
def test_figures_come_back_and_nothing_else_does(ran):
    """A cell that got out of the box would have drawn; an error in the middle stops nothing.

    The course's number is there, and so is the kit.
    """
    tries, content = ran
    assert [name for name in tries if figures_in(content, name)] == []
    assert len(figures_in(content, "first")) == 1 and len(figures_in(content, "last")) == 1
    assert {key for cell in content["cells"] for output in cell["outputs"] for key in output} == {
        "data"
    }


@toys.needs_sandbox
@needs_kernel
@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("import os, signal\nos.kill(os.getppid(), signal.SIGKILL)", 0),
        ("import os\nos._exit(0)", 1),
        ("while True: pass", 0),
        ("x = bytearray(20 << 30)", 1),
    ],
)
def test_notebook_that_ends_badly_harms_nobody(text, drawn, monkeypatch):
    """It ends in time, leaves no process or group, and returns its earlier pictures or none."""
    monkeypatch.setattr(figures, "SECONDS", 25.0)
    begun = time.monotonic()
    content = run_notebook(
        toys.notebook_bytes(toys.cell(DRAW, figure="a"), text), FILES, {"offset": 2.5}
    )
    assert time.monotonic() - begun < 60.0  # 25 s and a loaded machine's start
    assert len(figures_in(content, "a")) == drawn
    assert toys.groups_left() == [] and toys.processes_with("notebook_runner.py") == []


@toys.needs_sandbox
@needs_kernel
def test_children_that_fill_the_memory_end_the_run_without_control_groups(monkeypatch):
    """As for a plain user: four children of 300 MiB are more than 1 GiB together, none alone is."""
    text = """import os, time
for _ in range(4):
    if os.fork() == 0:
        kept = bytearray(b"x") * (300 << 20)
        time.sleep(60)
        os._exit(0)
time.sleep(60)"""
    monkeypatch.setattr(limits, "_parents", lambda: ())
    monkeypatch.setattr(figures, "MEMORY", 1 << 30)
    begun = time.monotonic()
    assert run_notebook(toys.notebook_bytes(text), FILES, {"offset": 2.5}) is None
    assert time.monotonic() - begun < 40.0
    assert toys.processes_with("notebook_runner.py") == []


@toys.needs_sandbox
@needs_kernel
def test_what_is_no_notebook_does_not_run():
    """Bytes that nobody can read give nothing."""
    assert run_notebook(b"\xff\x00", {}, {}) is None
    assert run_notebook(json.dumps({"cells": 5}).encode(), {}, {}) is None
