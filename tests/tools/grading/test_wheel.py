"""The kit's wheel, made without build tools, is one that pip and a browser's Python take."""

import base64
import csv
import hashlib
import io
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.wheel import (
    WHEEL_NAME,
    write_installed_wheel,
    write_kit_wheel,
)

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The small one."""
    return write_kit_wheel(tmp_path_factory.mktemp("wheel"), for_browser=True)


def metadata(wheel):
    """Lines of METADATA."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(each for each in archive.namelist() if each.endswith("/METADATA"))
        return archive.read(name).decode().splitlines()


def test_record_lists_every_file_with_its_digest(wheel):
    """The wheel format's rule: sha256 without padding, size; the list itself has neither."""
    with zipfile.ZipFile(wheel) as archive:
        record = next(each for each in archive.namelist() if each.endswith("/RECORD"))
        rows = list(csv.reader(io.StringIO(archive.read(record).decode())))
        assert [row[0] for row in rows] == archive.namelist()
        assert rows[-1] == [record, "", ""]
        for name, digest, size in rows[:-1]:
            data = archive.read(name)
            plain = base64.urlsafe_b64decode(digest.removeprefix("sha256=") + "=")
            assert plain == hashlib.sha256(data).digest() and int(size) == len(data)


def test_a_browser_needs_four_libraries_and_another_system_all(wheel):
    """By packaging's own reading of the markers."""
    requirements = [
        Requirement(line.removeprefix("Requires-Dist: "))
        for line in metadata(wheel)
        if line.startswith("Requires-Dist: ")
    ]
    browser = {"sys_platform": "emscripten", "extra": ""}
    needed = {
        each.name for each in requirements if not each.marker or each.marker.evaluate(browser)
    }
    assert needed == {"numpy", "scipy", "matplotlib", "pillow"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    linux = {"sys_platform": "linux", "extra": ""}
    needed = [each.name for each in requirements if not each.marker or each.marker.evaluate(linux)]
    assert needed == [Requirement(each).name for each in project["dependencies"]]
    torch = {"sys_platform": "linux", "extra": "torch"}
    needed = [each.name for each in requirements if each.marker and each.marker.evaluate(torch)]
    assert "torch" in needed and "pycolmap" not in needed


def test_pip_installs_it_with_the_aircraft_and_without_solutions(wheel, tmp_path):
    """pip reads it; the installed kit finds its airframe; no lab is in it; it is small."""
    assert wheel.name == WHEEL_NAME and wheel.stat().st_size < 4e6
    assert not any("labs/" in name for name in zipfile.ZipFile(wheel).namelist())
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, "--target", str(tmp_path / "kit"), str(wheel)], check=True)
    code = (
        "import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in repr(f)]; "
        f"sys.path.insert(0, {str(tmp_path / 'kit')!r}); "
        "import falconwing_kit; from falconwing_kit.aircraft import load_airframe; "
        "print(falconwing_kit.__file__, load_airframe().mass)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    place, mass = done.stdout.split()
    assert place.startswith(str(tmp_path)) and 0.1 < float(mass) < 0.2  # the paper's 150 g


def test_an_installed_package_becomes_a_wheel_and_compiled_code_does_not(tmp_path):
    """`comm`, which the browser's kernel requires; NumPy is compiled, and one name is nothing."""
    made = write_installed_wheel("comm", tmp_path)
    names = zipfile.ZipFile(made).namelist()
    assert "comm/__init__.py" in names and "Name: comm" in metadata(made)
    with pytest.raises(InputError, match="got compiled code"):
        write_installed_wheel("numpy", tmp_path)
    with pytest.raises(InputError, match="found none"):
        write_installed_wheel("no-such-package-of-anyone", tmp_path)
