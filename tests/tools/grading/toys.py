"""Notebooks for the toy lab, good and bad, and what a grader's run must not leave behind."""

import json
import os
import shutil
from pathlib import Path

import pytest

from falconwing_kit.tools.grading.sandbox import limits

LAB = Path(__file__).parent / "toy_lab"
HEAD = "import numpy as np\nfrom given import COHORT"
STRETCH = 'def stretch(x, gain):\n    return gain * x + COHORT["offset"]'
BRAKE = "def brake(position, speed):\n    return -4.0 * position - 4.0 * speed"

needs_sandbox = pytest.mark.skipif(
    shutil.which("bwrap") is None and not os.environ.get("CI"),
    reason="bubblewrap is missing: apt install bubblewrap",
)


def cell(text, kind="code", **metadata):
    """A notebook's cell."""
    ends = {"outputs": [], "execution_count": None} if kind == "code" else {}
    return {"cell_type": kind, "source": text, "metadata": metadata, **ends}


def notebook_bytes(*cells, **more):
    """A notebook of cells, or of the text of code cells."""
    made = [each if isinstance(each, dict) else cell(each) for each in cells]
    return json.dumps(
        {"cells": made, "metadata": {}, "nbformat": 4, "nbformat_minor": 5, **more}
    ).encode()


def groups_left():
    """Control groups of boxes whose grader has ended, or is this process."""
    folders = [
        folder for parent, _ in limits._parents() for folder in parent.glob("falconwing-*-*")
    ]
    owners = {folder: folder.name.split("-")[1] for folder in folders}
    return [
        folder
        for folder, pid in owners.items()
        if pid == str(os.getpid()) or not Path("/proc", pid).exists()
    ]


def processes_with(token):
    """Processes of this machine that carry a word in their command line or their environment."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if token.encode() in file.read_bytes():
                found.append(file.parent.name)
        except OSError:
            continue
    return found
