"""Shipped data: the name of a recorded or simulated flight -> its file. README.md says where each
comes from.
"""

from pathlib import Path

from falconwing_kit.core.checks import InputError

_FOLDER = Path(__file__).parent
_SUFFIXES = (".csv", ".toml", ".txt")


def shipped_names() -> tuple[str, ...]:
    """Names of all files that ship, sorted."""
    return tuple(sorted(path.name for path in _FOLDER.iterdir() if path.suffix in _SUFFIXES))


def data_path(name: str) -> Path:
    """Where a shipped file lies.

    Args:
        name: its name with the ending, "alfa_engine_failure.csv".

    Returns:
        The path of an existing file.

    Raises:
        InputError: nothing of that name ships; the text lists what does.
    """
    if name not in shipped_names():
        raise InputError(f"data: expected one of {', '.join(shipped_names())}, got {name!r}")
    return _FOLDER / name
