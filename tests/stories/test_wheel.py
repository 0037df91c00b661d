"""The kit as a wheel, installed without a checkout: everything that runs is in it, and verbs start.

tests/benchmarks/bench_install.py runs the long ones, such as the demo.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.firmware.chip import require_tools
from tests.house.test_public import tracked_files

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ("falconwing_kit", "firmware", "hardware", "labs")


def built_wheel(folder: Path) -> Path:
    """The wheel of the files that git tracks, built in a copy: a build leaves folders behind."""
    pytest.importorskip("setuptools", minversion="77")
    for path in tracked_files(ROOT):
        name = path.relative_to(ROOT)
        if name.parts[0] in SHIPPED or len(name.parts) == 1:
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, folder / "source" / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(folder), str(folder / "source")], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def installed_programs(wheel: Path, folder: Path) -> Path:
    """The programs' folder of an environment with the wheel and with this one's libraries.

    The libraries are a folder on the path; what its .pth files add, such as an editable kit, is
    not read.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python"), "install", "--quiet"]
    subprocess.run([*pip, "--no-deps", "--no-index", str(wheel)], env=outside(), check=True)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    words = [str(programs / "python"), "-c", where]
    done = subprocess.run(words, env=outside(), capture_output=True, text=True, check=True)
    (Path(done.stdout.strip()) / "zz_libraries.pth").write_text(
        sysconfig.get_path("purelib") + "\n"
    )
    return programs


def outside() -> dict[str, str]:
    """The environment's variables without a path to this checkout."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return built_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def programs(wheel, tmp_path_factory):
    return installed_programs(wheel, tmp_path_factory.mktemp("environment") / "venv")


def test_everything_tracked_is_in_the_wheel(wheel):
    """A page, a data set or a lab that is left out is missed by users only: names against git's."""
    inside = {
        name.split("/share/falconwing_kit/")[-1] for name in zipfile.ZipFile(wheel).namelist()
    }
    names = [path.relative_to(ROOT) for path in tracked_files(ROOT)]
    wanted = {name.as_posix() for name in names if name.parts[0] in SHIPPED}
    assert len(wanted) > 300
    assert sorted(wanted - inside) == []


def test_wheel_states_its_pythons_and_no_address(wheel):
    """The metadata: 3.11 to 3.13, and no index in any requirement."""
    with zipfile.ZipFile(wheel) as file:
        (name,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = file.read(name).decode().split("\n\n")[0].splitlines()
    python = "Classifier: Programming Language :: Python :: 3."
    assert [line for line in metadata if line.startswith(python)] == [
        f"{python}{minor}" for minor in (11, 12, 13)
    ]
    assert "Requires-Python: >=3.11" in metadata
    assert [line for line in metadata if "://" in line and "Requires-Dist" in line] == []


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        (("size",), "bank"),
        (("labs", "release", "handed_out", "lab01"), "lab01_sizing"),
        (("gap", "--help"), "--flight"),
        (("firmware", "build", "--out", "built"), "flash"),
    ],
)
def test_verbs_start_in_an_empty_folder(programs, words, printed, tmp_path):
    """The package that runs is the wheel's, and each verb finds its files."""
    if words[0] == "firmware":
        require_tools()
    environment = outside() | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    (tmp_path / "empty").mkdir()
    done = subprocess.run(
        [str(programs / "falconwing"), *words], cwd=tmp_path / "empty", env=environment,
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert printed in done.stdout
    if words[1:2] == ("release",):
        assert (tmp_path / "empty" / "handed_out" / "lab01_sizing" / "lab01.ipynb").is_file()


def test_package_is_the_wheels(programs, tmp_path):
    """And its libraries are this environment's."""
    where = (
        "import falconwing_kit, numpy; print(falconwing_kit.__file__, numpy.__file__, sep='\\n')"
    )
    done = subprocess.run(
        [str(programs / "python"), "-c", where], cwd=tmp_path, env=outside(),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    kit, library = done.stdout.splitlines()
    assert Path(kit).is_relative_to(programs.parent)
    assert Path(library).is_relative_to(sysconfig.get_path("purelib"))
