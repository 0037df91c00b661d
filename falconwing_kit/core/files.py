"""Files: a path -> a handle whose content appears there complete or not at all; the cache
folder and the folder of shipped files.
"""

import errno
import os
import secrets
import site
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from falconwing_kit.core.checks import InputError, require_file

MAX_TEXT_BYTES = 64 * 1024**2  # of a file that a person wrote
_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextmanager
def atomic_write(path: str | Path, *, text: bool = False) -> Iterator[IO[Any]]:
    """Open a file that gets its name only when it is complete and on the disk.

    The data go to a temporary name in the same folder. When the block ends, the file is flushed to
    the disk and renamed; if it fails, the temporary file is removed and an older file at the path
    is unchanged.

    Args:
        path: of the finished file; its folder must exist.
        text: True for a UTF-8 text handle with "\\n" line ends, False for bytes.

    Raises:
        InputError: the path is a folder, may not be written, or the disk is full.
        FileNotFoundError: the folder of the path does not exist.
    """
    target = Path(path)
    require_writable_path(target)
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    mode: dict[str, Any] = (
        {"mode": "x", "encoding": "utf-8", "newline": "\n"} if text else {"mode": "xb"}
    )
    try:
        with temporary.open(**mode) as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise write_error(target, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def require_size(
    path: str | Path, max_bytes: int, what: str, advice: str = "check the path"
) -> None:
    """Refuse a file that is too large to be read.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is larger; the sentence names what was expected and ends in the advice.
    """
    size = require_file(path).stat().st_size
    if size > max_bytes:
        raise InputError(
            f"{short_name(path)}: expected {what} of at most {max_bytes >> 20} MiB, got"
            f" {size >> 20} MiB; {advice}"
        )


def read_text(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is too large, or in another encoding.
    """
    require_size(path, max_bytes, "a text file")
    try:
        return Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{short_name(path)}: expected text in UTF-8, got another encoding (byte"
            f" {error.start}); save it again as UTF-8"
        ) from None


def write_figures(folder: Path, drawings: Mapping[str, Callable[[Path], str]]) -> Iterator[str]:
    """Draw figures as SVG, each with its alternative text in a .txt file beside it.

    Args:
        folder: to write to, created if missing.
        drawings: name -> function that draws into a path and returns the alternative text.

    Yields:
        Name and size of each written figure, such as "filter.svg: 12 kB".
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in drawings.items():
        path = folder / f"{name}.svg"
        alternative_text = draw(path)
        with atomic_write(path.with_suffix(".txt"), text=True) as file:
            file.write(alternative_text + "\n")
        yield f"{path.name}: {path.stat().st_size / 1000:.0f} kB"


def short_name(path: str | Path) -> str:
    """A file's name with its folder's, such as "case00/calm.csv": the same on every machine."""
    path = Path(path)
    return f"{path.parent.name}/{path.name}" if path.parent.name else path.name


def require_writable_path(path: str | Path) -> Path:
    """Return the path if a file could be written there: its folder exists, and it is no folder.

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
    """The exception to raise when writing the file failed.

    Returns:
        An InputError for a full disk or missing permission; any other error unchanged.
    """
    if error.errno in _DISK_FULL:
        return InputError(
            f"{path}: the disk is full and writing stopped; free some space or write elsewhere"
        )
    if error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
        return InputError(f"{path}: no right to write there; choose another folder")
    return error


def cache_folder() -> Path:
    """The kit's folder in this system's cache, which may be deleted; it need not exist."""
    home = Path.home()
    locations = {
        "win32": ("LOCALAPPDATA", home / "AppData" / "Local"),
        "darwin": ("", home / "Library" / "Caches"),
    }
    variable, default = locations.get(sys.platform, ("XDG_CACHE_HOME", home / ".cache"))
    return Path(os.environ.get(variable) or default) / "falconwing"


def shipped_path(relative: str, advice: str) -> Path:
    """Path of a shipped file outside the package: in the checkout, else in the installation.

    Args:
        relative: such as "hardware/airframe_umx.toml".
        advice: end of the message when the file is missing.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    beside = Path(__file__).parents[2]
    # an environment's folder, a user's own installation, or `pip install --target`
    own = site.getuserbase()  # none in a browser
    prefixes = [Path(sys.prefix), *([Path(own)] if own else []), beside]
    candidates = [
        beside / relative,
        *(prefix / "share" / "falconwing_kit" / relative for prefix in prefixes),
    ]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"no file at {' or '.join(map(str, candidates))}; {advice}")
