"""Firmware builder: kept under what it was made from, whole or not at all, and one sentence where
it cannot be done.
"""

import os
import shutil
from pathlib import Path

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge import build
from falconwing_kit.tools.bridge.build import (
    build_firmware,
    build_simulator,
    firmware_folder,
    missing_tools,
)
from tests.firmware.chip import require_tools

ELF = b"\x7fELF"  # how every ELF file begins


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """An empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "falconwing"


def test_a_missing_tool_is_named_with_what_to_install(monkeypatch, cache):
    """The package's name is the whole way out; nothing is written."""
    monkeypatch.setitem(build.TOOLS, "gcc-of-nowhere", "no-such-compiler")
    assert "gcc-of-nowhere" in missing_tools()
    for attempt in (build_firmware, build_simulator):
        with pytest.raises(
            InputError, match="gcc-of-nowhere not found; install with: sudo apt install"
        ):
            attempt()
    assert not cache.exists()


def test_a_build_is_kept_and_not_made_twice(monkeypatch, cache):
    """The second time no tool runs, and the sources' folder is as it was."""
    require_tools()
    before = sorted(firmware_folder().rglob("*"))
    simulator = build_simulator()
    assert simulator.read_bytes()[:4] == ELF
    assert os.listdir(cache) == [simulator.name]
    monkeypatch.setattr(build, "_run", None)
    assert build_simulator() == simulator
    assert [path for path in sorted(firmware_folder().rglob("*")) if "build" not in path.parts] == [
        path for path in before if "build" not in path.parts
    ]


def test_another_setting_or_source_is_another_build(monkeypatch, tmp_path, cache):
    """The name holds a digest of what went in; the texts beside the sources do not count."""
    require_tools()
    sources = Path(
        shutil.copytree(
            firmware_folder(), tmp_path / "firmware", ignore=shutil.ignore_patterns("build")
        )
    )
    monkeypatch.setattr(build, "firmware_folder", lambda: sources)
    monkeypatch.setattr(build, "_run", lambda command: (tmp_path / "ran").touch())
    monkeypatch.setattr(
        build,
        "_store_product",
        lambda product, kept: (cache.mkdir(parents=True, exist_ok=True), kept.touch()),
    )
    plain, eight = build_firmware(), build_firmware(["CHANNELS=8"])
    (sources / "README.md").write_text("another text")
    assert build_firmware() == plain != eight
    with (sources / "trainer_bridge" / "config.h").open("a") as file:
        file.write("// another line\n")
    assert build_firmware() not in (plain, eight)


def test_what_the_compiler_refuses_is_one_sentence(cache):
    """A setting that cannot be: the firmware's own words reach the user, and nothing is kept."""
    require_tools()
    with pytest.raises(InputError, match="CHANNELS: 4 to 8 slots") as raised:
        build_firmware(["CHANNELS=9"])
    assert "\n" not in str(raised.value)
    assert not cache.exists()


def test_old_builds_are_thrown_away(monkeypatch, cache):
    """After a month; younger ones and other files stay."""
    require_tools()
    cache.mkdir(parents=True)
    for name, days in (
        ("simavr_shim-old.so", 40),
        ("simavr_shim-young.so", 3),
        ("arena-old.npz", 40),
    ):
        (cache / name).touch()
        seconds = (cache / name).stat().st_mtime - days * 86400
        os.utime(cache / name, (seconds, seconds))
    built = build_simulator()
    assert sorted(os.listdir(cache)) == sorted(
        ["arena-old.npz", "simavr_shim-young.so", built.name]
    )


def test_a_cache_that_cannot_be_is_said(monkeypatch, tmp_path):
    """A file where the folder should be."""
    require_tools()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(InputError, match="set XDG_CACHE_HOME"):
        build_simulator()
