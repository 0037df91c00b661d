"""Writing files: whole or not at all."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, cache_folder, shipped_path, write_figures


def test_nothing_has_the_name_before_the_end(tmp_path):
    """While the block runs the old content stands; afterwards the new one, and nothing else is in
    the folder.
    """
    target = tmp_path / "a.txt"
    target.write_text("old")
    with atomic_write(target, text=True) as file:
        file.write("new\n")
        assert target.read_text() == "old"
    assert target.read_bytes() == b"new\n"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path):
    """The error comes through, the folder is as before."""
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), atomic_write(target) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_folder_as_target_and_missing_folder_are_said(tmp_path):
    """Both are the user's mistakes and get a sentence each."""
    with pytest.raises(InputError, match="got a folder"), atomic_write(tmp_path):
        pass
    with (
        pytest.raises(FileNotFoundError, match="expected a folder"),
        atomic_write(tmp_path / "none" / "a.txt"),
    ):
        pass


def run_with_full_disk(program: str, folder) -> subprocess.CompletedProcess[str]:
    """Run a program whose files the system lets grow to 20,000 bytes only: a disk that fills up."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
    command = [sys.executable, "-c", limit + textwrap.dedent(program)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=60
    )


@pytest.mark.skipif(
    sys.platform == "win32", reason="the system's file size limit exists on POSIX only"
)
def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path):
    """The kernel itself refuses the write; the user sees the path and what to do, the folder stays
    empty.
    """
    result = run_with_full_disk(
        """
        from falconwing_kit.core.files import atomic_write
        try:
            with atomic_write("big.bin") as file:
                for _ in range(100):
                    file.write(bytes(1000))
        except ValueError as error:
            print(type(error).__name__, error)
        """,
        tmp_path,
    )
    assert "InputError big.bin: the disk is full" in result.stdout, result.stderr
    assert os.listdir(tmp_path) == []


def test_figures_are_written_with_their_words(tmp_path):
    """By hand: 1600 bytes round to 2 kB; each figure exists when reported, the next one not yet."""
    drawings = {
        name: lambda path: path.write_bytes(b"x" * 1600) and "In words." for name in ("one", "two")
    }
    lines = write_figures(tmp_path / "new", drawings)
    assert next(lines) == "one.svg: 2 kB"
    assert sorted(os.listdir(tmp_path / "new")) == ["one.svg", "one.txt"]
    assert list(lines) == ["two.svg: 2 kB"]
    assert (tmp_path / "new" / "two.txt").read_text() == "In words.\n"


def test_no_right_to_write_is_one_sentence(tmp_path, monkeypatch):
    """The system's error is simulated, because the tests may run with permission for everything."""

    def refuse(source, target):
        raise PermissionError(13, "Permission denied", str(target))

    monkeypatch.setattr(os, "replace", refuse)
    with (
        pytest.raises(InputError, match="no right to write"),
        atomic_write(tmp_path / "a.txt", text=True) as file,
    ):
        file.write("x")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("platform", "variable", "path"),
    [
        ("linux", "XDG_CACHE_HOME", "{home}/.cache/falconwing"),
        ("linux", "", "{set}/falconwing"),
        ("win32", "LOCALAPPDATA", "{home}/AppData/Local/falconwing"),
        ("darwin", "XDG_CACHE_HOME", "{home}/Library/Caches/falconwing"),
    ],
)
def test_cache_folder_is_the_systems_own(platform, variable, path, monkeypatch, tmp_path):
    """The XDG base directory specification, Windows' and Apple's guidelines."""
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", os.fspath(tmp_path / "set"))
    monkeypatch.delenv(variable or "LOCALAPPDATA", raising=False)
    assert cache_folder() == Path(path.format(home=tmp_path, set=tmp_path / "set"))


def test_what_ships_is_found_beside_the_package_or_under_the_prefix(monkeypatch, tmp_path):
    """In a checkout, or under <prefix>/share; else the message has both paths and the advice."""
    assert shipped_path("hardware/airframe_umx.toml", "").name == "airframe_umx.toml"
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    there = tmp_path / "share" / "falconwing_kit" / "hardware" / "own.toml"
    with pytest.raises(FileNotFoundError, match=r"own\.toml.* or .*share.*; name one"):
        shipped_path("hardware/own.toml", "name one")
    there.parent.mkdir(parents=True)
    there.touch()
    assert shipped_path("hardware/own.toml", "name one") == there
