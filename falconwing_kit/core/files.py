"""Files: a path to write -> a handle whose content appears there whole, or not at all."""

import errno
import os
import secrets
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from falconwing_kit.core.checks import InputError

_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextmanager
def atomic_write(path: str | Path, *, text: bool = False) -> Iterator[IO[Any]]:
    """Open a file that takes its name only once it is complete and on the disk.

    What is written goes to a temporary name in the same folder. When the block ends well, the file
    is flushed to the disk and renamed; when it fails, the temporary file is removed and an older
    file at the path stays as it was.

    Args:
        path: where the finished file shall be; its folder must exist.
        text: True for a UTF-8 text handle with "\\n" line ends, False for bytes.

    Yields:
        The open handle.

    Raises:
        InputError: the path is a folder, may not be written, or the disk is full.
        FileNotFoundError: the folder of the path does not exist.
    """
    target = Path(path)
    require_writable_path(target)
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    how: dict[str, Any] = (
        {"mode": "x", "encoding": "utf-8", "newline": "\n"} if text else {"mode": "xb"}
    )
    try:
        with temporary.open(**how) as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise write_error(target, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_figures(folder: Path, drawings: Mapping[str, Callable[[Path], str]]) -> Iterator[str]:
    """Draw figures as SVG, each with a text beside it that says the same.

    Args:
        folder: to write to, made where it is missing.
        drawings: name -> what draws it into a path and returns it in words.

    Yields:
        Name and size of each when it is written, such as "filter.svg: 12 kB".
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in drawings.items():
        path = folder / f"{name}.svg"
        words = draw(path)
        with atomic_write(path.with_suffix(".txt"), text=True) as file:
            file.write(words + "\n")
        yield f"{path.name}: {path.stat().st_size / 1000:.0f} kB"


def short_name(path: str | Path) -> str:
    """A file's name with its folder's, such as "case00/calm.csv": enough to know it, the same on
    every machine.
    """
    path = Path(path)
    return f"{path.parent.name}/{path.name}" if path.parent.name else path.name


def require_writable_path(path: str | Path) -> Path:
    """Return the path if a file could be written there: its folder exists and it is not a folder
    itself.

    Raises:
        InputError: the path is a folder.
        FileNotFoundError: the folder of the path does not exist.
    """
    target = Path(path)
    if target.is_dir() or not target.name:
        raise InputError(
            f"{target}: expected the name of a file to write, got a folder; add a file name"
        )
    if not target.parent.is_dir():
        raise FileNotFoundError(
            f"{target}: expected a folder at {target.parent}, found none; make it first"
        )
    return target


def write_error(path: str | Path, error: OSError) -> Exception:
    """The error to raise when writing a file failed: one sentence for a full disk or a forbidden
    place.

    Args:
        path: the file that was being written.
        error: what the system said.

    Returns:
        An InputError where the reason is the disk or the rights; any other error as it came.
    """
    if error.errno in _DISK_FULL:
        return InputError(
            f"{path}: the disk is full and writing stopped; free some space or write elsewhere"
        )
    if error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
        return InputError(f"{path}: no right to write there; choose another folder")
    return error


def cache_folder() -> Path:
    """Where this system keeps what programs can make again; the folder need not exist."""
    home = Path.home()
    places = {
        "win32": ("LOCALAPPDATA", home / "AppData" / "Local"),
        "darwin": ("", home / "Library" / "Caches"),
    }
    variable, usual = places.get(sys.platform, ("XDG_CACHE_HOME", home / ".cache"))
    return Path(os.environ.get(variable) or usual) / "falconwing"


def shipped_path(relative: str, advice: str) -> Path:
    """Where a file outside the package is that ships with the kit: beside it in a checkout, else
    where pip put it.

    Args:
        relative: such as "hardware/airframe_umx.toml".
        advice: what to do where it is missing.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    places = [
        Path(__file__).parents[2] / relative,
        Path(sys.prefix) / "share" / "falconwing_kit" / relative,
    ]
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"no file at {' or '.join(map(str, places))}; {advice}")
