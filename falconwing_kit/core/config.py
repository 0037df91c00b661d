"""Configuration: a TOML file <-> a frozen dataclass, with errors that name the key."""

import dataclasses
import difflib
import math
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name

MAX_NUMBER = 1e300  # refused from here on: a whole number above 1.8e308 is no float
MAX_SHOWN_CHARACTERS = 60  # of a value in a message
MAX_SHOWN_INTEGER = 10**20
MAX_FILE_BYTES = 1024**2  # a model file with its covariance has about 10 kB
_TYPE_NAMES = {
    float: "a finite number",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
}

Record = TypeVar("Record")


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file as a dict.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is not TOML; the message gives line and column.
    """
    path = require_file(path)
    name = short_name(path)
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(
            f"{name}: expected a TOML file of at most {MAX_FILE_BYTES >> 10} KiB, got a larger one"
        )
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(
            f"{name}: expected a TOML file in UTF-8, got other bytes; save it as UTF-8 text"
        ) from None
    except RecursionError:
        raise InputError(
            f"{name}: expected a TOML file, got brackets nested too deep to read"
        ) from None
    except ValueError as error:
        raise InputError(f"{name}: this is not TOML: {error}") from None


def from_toml(cls: type[Record], source: str | Path | Mapping[str, Any]) -> Record:
    """Fill a dataclass from a TOML file or from a mapping such as one of its tables.

    Fields may be float (whole numbers are accepted), int, str, bool, a dataclass, a tuple, a
    mapping from str, or one of these or None. A field with a default may be omitted.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a key is unknown or missing, or a value has another type; the message gives the
            full key.
    """
    if isinstance(source, Mapping):
        return _build_record(cls, source, "")
    try:
        return _build_record(cls, load_toml(source), "")
    except InputError as error:
        name = short_name(source)
        raise error if str(error).startswith(name) else InputError(f"{name}: {error}") from None


def write_toml(path: str | Path, record: Any) -> None:
    """Write a dataclass or a mapping as TOML, atomically; fields that are None are omitted.

    Args:
        path: of the file.
        record: values of the types of `from_toml`, or NumPy arrays.

    Raises:
        InputError: the disk is full or the folder is not writable.
        FileNotFoundError: the folder does not exist.
    """
    import tomli_w

    text = tomli_w.dumps(_to_toml(record))
    with atomic_write(path, text=True) as file:
        file.write(text)


def _build_record(cls: type[Record], values: Any, key: str) -> Record:
    """The dataclass filled from the values of the table `key`."""
    if not isinstance(values, Mapping):
        raise InputError(f"{key}: expected a table [{key}], got {_shorten(values)}")
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}  # type: ignore[arg-type]
    for name in values:
        if name not in fields:
            close = difflib.get_close_matches(str(name)[:100], fields, n=1)
            hint = f"perhaps you meant {close[0]!r}" if close else f"known are {', '.join(fields)}"
            raise InputError(f"unknown key {_join_key(key, str(name)[:100])!r}; {hint}")
    missing = [
        _join_key(key, name)
        for name, field in fields.items()
        if name not in values
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise InputError(f"missing key {', '.join(map(repr, missing))}; add it")
    filled = {
        name: _convert_value(hints[name], value, _join_key(key, name))
        for name, value in values.items()
    }
    try:
        return cls(**filled)
    except ValueError as error:
        raise InputError(f"{key}: {error}" if key else str(error)) from None


def _convert_value(kind: Any, value: Any, key: str) -> Any:
    """The value converted to the annotated type."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _build_record(typing.cast(type[Any], kind), value, key)
    if origin in (typing.Union, types.UnionType):
        expected_type = next(choice for choice in inner if choice is not type(None))
        return None if value is None else _convert_value(expected_type, value, key)
    if origin is tuple:
        return _convert_tuple(inner, value, key)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            raise InputError(f"{key}: expected a table [{key}], got {_shorten(value)}")
        return {
            str(name): _convert_value(inner[1], item, _join_key(key, str(name)[:100]))
            for name, item in value.items()
        }
    whole = isinstance(value, int) and not isinstance(value, bool)
    if kind is float and (whole or isinstance(value, float)) and abs(value) < MAX_NUMBER:
        return float(value)
    if kind is not float and type(value) is kind:
        return value
    raise InputError(f"{key}: expected {_TYPE_NAMES.get(kind, kind)}, got {_shorten(value)}")


def _convert_tuple(inner: tuple[Any, ...], value: Any, key: str) -> tuple[Any, ...]:
    """A list of the file as a tuple, each value converted to the type annotated at its place."""
    if not isinstance(value, (list, tuple)):
        raise InputError(f"{key}: expected a list [...], got {_shorten(value)}")
    kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else list(inner)
    if len(kinds) != len(value):
        raise InputError(f"{key}: expected {len(kinds)} values, got {len(value)}")
    return tuple(
        _convert_value(kind, item, f"{key}[{i}]")
        for i, (kind, item) in enumerate(zip(kinds, value, strict=True))
    )


def _to_toml(value: Any) -> Any:
    """The value in TOML's own types."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _to_toml(
            {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        )
    if isinstance(value, Mapping):
        return {str(name): _to_toml(item) for name, item in value.items() if item is not None}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return [_to_toml(item) for item in value] if isinstance(value, (list, tuple)) else value


def _join_key(key: str, name: str) -> str:
    """The key of a value in a table, such as "wheels.tail"."""
    return f"{key}.{name}" if key else name


def _shorten(value: Any) -> str:
    """A value as text for a message, at most about 60 characters."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = (
        repr(value)
        if not isinstance(value, int) or abs(value) < MAX_SHOWN_INTEGER
        else "a huge number"
    )
    return text if len(text) <= MAX_SHOWN_CHARACTERS else f"{text[:MAX_SHOWN_CHARACTERS]}..."
