"""Every command that README and the site's pages ask to be typed runs; those that need the machine
to themselves are in test_readme.py, the demo in tests/tools/demo/test_recorded.py.
"""

import io

import pytest

from tests.stories.pages import OURS, make_folder, needs_the_machine, run_as_typed

TYPED_HERE = [line for line in OURS if not (needs_the_machine(line) or " demo" in line)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder as the reader has it, to type commands in."""
    make_folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    return tmp_path


@pytest.mark.parametrize("line", TYPED_HERE)
def test_command_runs(line, folder, capsys):
    """Typed as printed, in a folder with a flight and a log."""
    run_as_typed(line, folder, capsys)


def test_both_kinds_are_there():
    """Neither file's list may become empty by a change of the other's."""
    assert len(OURS) - len(TYPED_HERE) > 10 and len(TYPED_HERE) > 25
