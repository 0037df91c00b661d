"""Result cache: results of many tasks on the disk, one small JSON file each.

The file name is a hash of function, item and kit version, so a result is found in any order of the
items and never confused with another. Files are written atomically.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from falconwing_kit import __version__
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write


class ResultCache:
    """A folder of results of one function."""

    def __init__(self, folder: Path, function: Callable[..., Any]) -> None:
        self._folder, self._function = folder, function
        folder.mkdir(parents=True, exist_ok=True)

    def read(self, item: Any) -> tuple[Any] | None:
        """The item's result in a tuple; None without one or with an invalid file."""
        try:
            record = json.loads(self._path(item).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return (record["result"],) if isinstance(record, dict) and "result" in record else None

    def write(self, item: Any, result: Any) -> Any:
        """Store a result; returns it as it will be read, with tuples as lists.

        Raises:
            InputError: the result is not valid JSON, or the disk is full.
        """
        try:
            text = json.dumps({"result": result}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{self._folder}: expected results of texts, finite numbers, lists and dicts, "
                f"{error}"
            ) from None
        with atomic_write(self._path(item), text=True) as handle:
            handle.write(text)
        return json.loads(text)["result"]

    def _path(self, item: Any) -> Path:
        return self._folder / f"{cache_key(self._function, item)}.json"


def cache_key(function: Callable[..., Any], item: Any) -> str:
    """Hash of a task and the kit's version, 32 hexadecimal digits.

    Args:
        function: identified by its name and, for a `functools.partial`, its arguments.
        item: numbers, texts, bytes, paths, arrays, and lists, tuples, dicts and dataclasses of
            them.

    Raises:
        TypeError: the item contains something else.
    """
    canonical_text = json.dumps(
        [__version__, _canonical_form(function), _canonical_form(item)], sort_keys=True
    )
    return hashlib.sha256(canonical_text.encode()).hexdigest()[:32]


def _canonical_form(value: Any) -> Any:
    """The value as JSON, different for different values."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, bytes):
        return ["bytes", hashlib.sha256(value).hexdigest()]
    if isinstance(value, PurePath):
        return ["path", str(value)]
    if isinstance(value, np.ndarray | np.generic):
        digest = hashlib.sha256(value.tobytes()).hexdigest()
        return ["array", str(value.dtype), list(value.shape), digest]
    if isinstance(value, tuple | list):
        return [_canonical_form(each) for each in value]
    if isinstance(value, Mapping):
        pairs = [[_canonical_form(key), _canonical_form(each)] for key, each in value.items()]
        return ["dict", sorted(pairs, key=json.dumps)]
    if isinstance(value, partial):
        return ["partial", *map(_canonical_form, (value.func, value.args, value.keywords))]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return [type(value).__qualname__, _canonical_form(fields)]
    if hasattr(value, "__qualname__"):
        return ["function", f"{value.__module__}.{value.__qualname__}"]
    raise TypeError(
        "expected an item of numbers, texts, arrays, paths and dataclasses of them, "
        f"got {type(value).__name__}"
    )
