"""Wheels: the running kit, or an installed package -> a wheel file, pure Python, without network.

A browser's Python and a hosted one install the kit from such a file. No compiler and no build tool
is needed: a wheel is a zip of the package with a list of what it requires.
"""

import base64
import hashlib
import importlib.metadata
import re
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import falconwing_kit
from falconwing_kit import __version__
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, shipped_path

NAME, FILE_NAME = "falconwing-kit", "falconwing_kit"
WHEEL_NAME = f"{FILE_NAME}-{__version__}-py3-none-any.whl"
_NOT_IN_A_BROWSER = (".safetensors", ".npz", ".jpg", ".png")  # networks, scenes, pictures


def write_kit_wheel(folder: Path, *, for_browser: bool = False) -> Path:
    """Write the kit's wheel.

    Args:
        folder: where it goes.
        for_browser: without networks' weights, trained scenes and firmware: 2 MB in place of 20.

    Returns:
        The file, `falconwing_kit-VERSION-py3-none-any.whl`. The labs and their solutions are not in
        it.
    """
    path = folder / WHEEL_NAME
    members = [(name, file.read_bytes()) for file, name in _kit_files(for_browser)]
    _write_wheel(path, FILE_NAME, __version__, members, *_kit_metadata())
    return path


def write_installed_wheel(name: str, folder: Path) -> Path:
    """Write the wheel of an installed package of pure Python.

    Raises:
        InputError: it is not installed, or not pure Python.
    """
    try:
        found = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        raise InputError(
            f"{name}: expected it installed, found none; pip install 'falconwing-kit[web]'"
        ) from None
    if "Root-Is-Purelib: true" not in (found.read_text("WHEEL") or ""):
        raise InputError(f"{name}: expected a package of pure Python, got compiled code")
    file_name = re.sub(r"[-_.]+", "_", name)
    kept = [
        each
        for each in found.files or ()
        if each.parts[0] != ".." and ".dist-info" not in each.parts[0] and each.suffix != ".pyc"
    ]
    members = [(each.as_posix(), Path(str(found.locate_file(each))).read_bytes()) for each in kept]
    path = folder / f"{file_name}-{found.version}-py3-none-any.whl"
    _write_wheel(path, file_name, found.version, members, found.read_text("METADATA") or "", "")
    return path


def _kit_files(for_browser: bool) -> Iterator[tuple[Path, str]]:
    """Files of the kit and their names in the wheel."""
    package = Path(falconwing_kit.__file__).resolve().parent
    for file in _files(package):
        if not (for_browser and file.suffix in _NOT_IN_A_BROWSER):
            yield file, f"{FILE_NAME}/{file.relative_to(package).as_posix()}"
    shared = f"{FILE_NAME}-{__version__}.data/data/share/falconwing_kit"
    for first in ("hardware/airframe_umx.toml", "firmware/README.md"):
        top = shipped_path(first, "install the kit again").parent
        for file in _files(top):
            if not for_browser or file.suffix in (".toml", ".csv"):
                yield file, f"{shared}/{top.name}/{file.relative_to(top).as_posix()}"


def _files(folder: Path) -> list[Path]:
    made = {"__pycache__", ".ipynb_checkpoints", "build"}
    return sorted(
        file
        for file in folder.rglob("*")
        if file.is_file()
        and made.isdisjoint(file.relative_to(folder).parts)
        and file.suffix != ".pyc"
        and not file.name.startswith(".")
    )


def _kit_metadata() -> tuple[str, str]:
    """METADATA and entry points: a checkout's are those of its pyproject.toml as it is now."""
    source = Path(falconwing_kit.__file__).resolve().parents[1] / "pyproject.toml"
    if not source.is_file():
        found = importlib.metadata.distribution(NAME)
        return found.read_text("METADATA") or "", found.read_text("entry_points.txt") or ""
    project = tomllib.loads(source.read_text(encoding="utf-8"))["project"]
    lines = [
        "Metadata-Version: 2.1",
        f"Name: {NAME}",
        f"Version: {__version__}",
        f"Summary: {project['description']}",
        f"Requires-Python: {project['requires-python']}",
        *(f"Requires-Dist: {each}" for each in project["dependencies"]),
    ]
    for extra, requirements in project["optional-dependencies"].items():
        lines.append(f"Provides-Extra: {extra}")
        lines += [f"Requires-Dist: {_in_extra(each, extra)}" for each in requirements]
    return "\n".join(lines) + "\n", _entry_points(project)


def _in_extra(requirement: str, extra: str) -> str:
    what, _, marker = requirement.partition(";")
    condition = f"({marker.strip()}) and extra == '{extra}'" if marker else f"extra == '{extra}'"
    return f"{what.strip()}; {condition}"


def _entry_points(project: dict[str, Any]) -> str:
    groups = {"console_scripts": project.get("scripts", {}), **project.get("entry-points", {})}
    lines = []
    for group, entries in groups.items():
        lines += [f"[{group}]", *(f"{key} = {value}" for key, value in entries.items()), ""]
    return "\n".join(lines)


def _write_wheel(
    path: Path,
    name: str,
    version: str,
    members: Iterable[tuple[str, bytes]],
    metadata: str,
    entry_points: str,
) -> None:
    """A zip with the same bytes for the same content, and the list of its files last."""
    info = f"{name}-{version}.dist-info"
    kind = "Wheel-Version: 1.0\nGenerator: falconwing-kit\nRoot-Is-Purelib: true\n"
    whole = [
        *members,
        (f"{info}/METADATA", metadata.encode()),
        (f"{info}/WHEEL", f"{kind}Tag: py3-none-any\n".encode()),
        *([(f"{info}/entry_points.txt", entry_points.encode())] if entry_points else []),
    ]
    record = "".join(f"{each},sha256={_digest(data)},{len(data)}\n" for each, data in whole)
    whole.append((f"{info}/RECORD", f"{record}{info}/RECORD,,\n".encode()))
    with atomic_write(path) as handle, zipfile.ZipFile(handle, "w", zipfile.ZIP_DEFLATED) as wheel:
        for each, data in whole:
            entry = zipfile.ZipInfo(each, (1980, 1, 1, 0, 0, 0))
            entry.external_attr, entry.compress_type = 0o644 << 16, zipfile.ZIP_DEFLATED
            wheel.writestr(entry, data)


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
