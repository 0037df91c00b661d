"""Configuration: what comes in, and the sentence for what is wrong."""

import dataclasses
import math
import os
from collections.abc import Mapping

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.config import from_toml, load_toml, write_toml


@dataclasses.dataclass(frozen=True)
class Wing:
    span: float
    taper: float = 1.0

    def __post_init__(self):
        require_range("span", self.span, low=0.1)


@dataclasses.dataclass(frozen=True)
class Plane:
    name: str
    wing: Wing
    channels: int
    indoor: bool
    center: tuple[float, float, float]
    tips: tuple[Wing, ...] = ()
    note: str | None = None
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)


GOOD = """
name = "umx"
channels = 4
indoor = true
center = [0.1, 0, -0.2]
[wing]
span = 1
[[tips]]
span = 0.5
[values]
CL0 = 0.3
"""


@pytest.fixture
def toml(tmp_path):
    """A file with the given text."""

    def write(text: str | bytes):
        path = tmp_path / "plane.toml"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


def test_good_file_fills_the_dataclass(toml):
    """Each value as typed above; whole numbers serve as floats, defaults stand in."""
    plane = from_toml(Plane, toml(GOOD))
    assert plane == Plane(
        "umx", Wing(1.0), 4, True, (0.1, 0.0, -0.2), (Wing(0.5),), None, {"CL0": 0.3}
    )
    assert isinstance(plane.wing.span, float) and isinstance(plane.center[1], float)


def test_what_is_written_is_read_back(toml, tmp_path):
    """Inverse; None is left out of the file and comes back as the default."""
    plane = from_toml(Plane, toml(GOOD))
    write_toml(tmp_path / "again.toml", plane)
    assert from_toml(Plane, tmp_path / "again.toml") == plane
    assert sorted(os.listdir(tmp_path)) == ["again.toml", "plane.toml"]


def test_arrays_are_written_as_lists(tmp_path):
    """A covariance is an array; numbers come back to the last bit."""
    covariance = np.array([[1.0, 1 / 3], [1 / 3, 2.0]])
    write_toml(
        tmp_path / "model.toml", {"covariance": covariance, "n": np.int64(3), "x": np.float64(0.1)}
    )
    back = load_toml(tmp_path / "model.toml")
    assert (
        np.array_equal(np.array(back["covariance"]), covariance)
        and back["n"] == 3
        and back["x"] == 0.1
    )


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("span = 1\n", "sapn = 1\n", "unknown key 'wing.sapn'; perhaps you meant 'span'"),
        ("channels = 4", "chanels = 4", "unknown key 'chanels'; perhaps you meant 'channels'"),
        ("channels = 4", "channels = 4\nzzzz = 1", "unknown key 'zzzz'; known are name, wing"),
        ("channels = 4\n", "", "missing key 'channels'; add it"),
        ("span = 1\n", "", "missing key 'wing.span'"),
        ("span = 1\n", 'span = "wide"\n', "wing.span: expected a finite number, got 'wide'"),
        ("span = 1\n", "span = true\n", "wing.span: expected a finite number, got True"),
        ("span = 1\n", "span = inf\n", "wing.span: expected a finite number, got inf"),
        ("span = 1\n", "span = nan\n", "wing.span: expected a finite number, got nan"),
        (
            "span = 1\n",
            f"span = 1{'0' * 400}\n",
            "wing.span: expected a finite number, got a huge number",
        ),
        ("span = 1\n", "span = -1\n", "wing: span: expected a finite number in"),
        ("channels = 4", "channels = 4.5", "channels: expected a whole number, got 4.5"),
        ("channels = 4", "channels = true", "channels: expected a whole number, got True"),
        ("indoor = true", "indoor = 1", "indoor: expected true or false, got 1"),
        ('name = "umx"', "name = 3", "name: expected a text, got 3"),
        ("[0.1, 0, -0.2]", "[0.1, 0]", "center: expected 3 values, got 2"),
        ("[0.1, 0, -0.2]", '[0.1, "a", 0]', r"center\[1\]: expected a finite number, got 'a'"),
        ("[0.1, 0, -0.2]", "1.0", r"center: expected a list \[...\], got 1.0"),
        ("span = 0.5", "span = []", r"tips\[0\].span: expected a finite number, got a list of 0"),
        ("[wing]\nspan = 1\n", "wing = 3\n", r"wing: expected a table \[wing\], got 3"),
        ("[values]\nCL0 = 0.3", "[values]\nCL0 = []", "values.CL0: expected a finite number"),
        ("[wing]", "[wing", "this is not TOML: .*line 6"),
    ],
)
def test_each_mistake_is_named_with_its_key(toml, old, new, sentence):
    """The full path of the key and the file's name are in the one sentence."""
    assert old in GOOD
    with pytest.raises(InputError, match=sentence) as error:
        from_toml(Plane, toml(GOOD.replace(old, new)))
    assert "plane.toml" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"\xff\xfe\x00", "UTF-8"),
        (b"a = " + b"[" * 100_000, "nested too deep"),
        (b"a = " + b"1" * 5000, "not TOML"),
        (b"#" * (1024**2 + 1), "at most 1024 KiB"),
    ],
)
def test_files_that_are_no_configuration(toml, data, sentence):
    """Other bytes, brackets without end, a number of 5000 digits, a file too large for a
    configuration.
    """
    with pytest.raises(InputError, match=sentence):
        load_toml(toml(data))


def test_missing_file_is_said(tmp_path):
    """The path is in the sentence."""
    with pytest.raises(FileNotFoundError, match=r"absent\.toml"):
        load_toml(tmp_path / "absent.toml")


def test_a_byte_order_mark_does_no_harm(toml):
    """Some editors put one at the start of a UTF-8 file."""
    assert load_toml(toml(b"\xef\xbb\xbf" + GOOD.encode()))["channels"] == 4


def test_mapping_serves_as_source():
    """A table of a larger file; nothing is read."""
    assert from_toml(Wing, {"span": 2}).span == 2.0
    assert not math.isnan(from_toml(Wing, {"span": 2, "taper": 0.5}).taper)
