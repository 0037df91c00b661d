"""Shards: the results of many tasks on the disk, one small file each, named by what was asked.

The name is a fingerprint of function, item and kit version, so a result is found again however the
items are ordered, and never taken for another's. A file is there whole or not at all.
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
    """A folder of results of one function: `read` gives what is there, `write` keeps a new one."""

    def __init__(self, folder: Path, function: Callable[..., Any]) -> None:
        self._folder, self._function = folder, function
        folder.mkdir(parents=True, exist_ok=True)

    def read(self, item: Any) -> tuple[Any] | None:
        """The item's result in a tuple; None where there is none, or its file is not one of ours."""
        try:
            record = json.loads(self._path(item).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return (record["result"],) if isinstance(record, dict) and "result" in record else None

    def write(self, item: Any, result: Any) -> Any:
        """Keep a result.

        Returns:
            The result as it will be read: tuples have become lists.

        Raises:
            InputError: JSON cannot say the result, or the disk is full.
        """
        try:
            text = json.dumps({"result": result}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{self._folder}: expected results of texts, finite numbers, lists and dicts, {error}"
            ) from None
        with atomic_write(self._path(item), text=True) as handle:
            handle.write(text)
        return json.loads(text)["result"]

    def _path(self, item: Any) -> Path:
        return self._folder / f"{cache_key(self._function, item)}.json"


def cache_key(function: Callable[..., Any], item: Any) -> str:
    """A fingerprint of a task.

    Args:
        function: known by its name and, where it is a `functools.partial`, by what it was given.
        item: numbers, texts, bytes, paths, arrays, and lists, tuples, dicts and dataclasses of
            them.

    Returns:
        32 hexadecimal digits; another kit version gives others.

    Raises:
        TypeError: the item holds something else.
    """
    canonical_text = json.dumps(
        [__version__, _canonical_form(function), _canonical_form(item)], sort_keys=True
    )
    return hashlib.sha256(canonical_text.encode()).hexdigest()[:32]


def _canonical_form(value: Any) -> Any:
    """A value as JSON that differs where the value differs."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, bytes):
        return ["bytes", hashlib.sha256(value).hexdigest()]
    if isinstance(value, PurePath):
        return ["path", str(value)]
    if isinstance(value, np.ndarray | np.generic):
        return [
            "array",
            str(value.dtype),
            list(value.shape),
            hashlib.sha256(value.tobytes()).hexdigest(),
        ]
    if isinstance(value, tuple | list):
        return [_canonical_form(each) for each in value]
    if isinstance(value, Mapping):
        return [
            "dict",
            sorted(
                [[_canonical_form(key), _canonical_form(each)] for key, each in value.items()],
                key=json.dumps,
            ),
        ]
    if isinstance(value, partial):
        return [
            "partial",
            _canonical_form(value.func),
            _canonical_form(value.args),
            _canonical_form(value.keywords),
        ]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return [type(value).__qualname__, _canonical_form(fields)]
    if hasattr(value, "__qualname__"):
        return ["function", f"{value.__module__}.{value.__qualname__}"]
    raise TypeError(
        f"expected an item of numbers, texts, arrays, paths and dataclasses of them, got {type(value).__name__}"
    )
