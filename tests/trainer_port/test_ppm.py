"""PPM calibration: sticks to microseconds and back, and what a file may not say."""

import dataclasses
import math
import tomllib

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import write_toml
from falconwing_kit.core.messages import Command
from falconwing_kit.trainer_port.ppm import (
    UNUSED_CHANNEL_US,
    Stick,
    default_calibration_path,
    load_calibration,
)


@pytest.fixture
def shipped():
    return load_calibration()


@pytest.fixture
def skewed(shipped):
    """A radio as they come: other order, uneven ends, one stick reversed, six slots."""
    return dataclasses.replace(
        shipped,
        radio="test",
        measured="2026-03-01",
        channels=6,
        throttle=Stick(3, 1080, 1490, 1920),
        aileron=Stick(1, 1100, 1510, 1900, reversed=True),
        elevator=Stick(2, 1120, 1530, 1880),
        rudder=Stick(6, 1000, 1500, 2000),
    )


def test_shipped_values_are_the_convention_and_say_so(shipped):
    """1000, 1500, 2000 us; never measured; idle throttle is the firmware's safe slot."""
    assert (shipped.radio, shipped.measured) == ("", "")
    assert shipped.channels_us(Command(0.0, 0.0, 0.0, 0.0)) == (1000, 1500, 1500, 1500)
    assert shipped.channels_us(Command(1.0, 1.0, -1.0, 0.5)) == (2000, 2000, 1000, 1750)


def test_a_skewed_radio_by_hand(skewed):
    """Throttle 3/4 is halfway from 1490 to 1920; aileron right (reversed) goes down from 1510;
    spares stay neutral.
    """
    slots = skewed.channels_us(Command(0.75, 0.5, -1.0, 0.1))
    assert slots == (1305, 1120, 1705, UNUSED_CHANNEL_US, UNUSED_CHANNEL_US, 1550)
    assert all(type(us) is int for us in slots)


def test_a_pilot_frame_gives_the_sticks_by_hand(skewed):
    """The same numbers inverted; a seventh slot is ignored; beyond an end point it is clipped."""
    command = skewed.command((1305, 1120, 1705, 0, 0, 1550, 999))
    assert command.vector == pytest.approx([0.75, 0.5, -1.0, 0.1], abs=1e-12)
    assert not command.saturated
    beyond = skewed.command((1510, 1900, 1000, 0, 0, 1500))
    assert (beyond.throttle, beyond.elevator, beyond.saturated) == (0.0, 1.0, True)


def test_there_and_back_is_the_same_within_a_rounding(skewed):
    """Half a microsecond of the shortest half travel, the elevator's 350 us."""
    rng = np.random.default_rng(2)
    for _ in range(500):
        command = Command(float(rng.uniform(0, 1)), *map(float, rng.uniform(-1, 1, 3)))
        again = skewed.command(skewed.channels_us(command))
        assert again.vector == pytest.approx(command.vector, abs=0.5 / 350)


def test_sticks_are_cut_and_nan_is_refused(shipped):
    """The aircraft gets full or nothing, never a number beyond; nan is a bug above."""
    assert shipped.channels_us(Command(7.0, -7.0, 2.0, 0.0)) == (2000, 1000, 2000, 1500)
    with pytest.raises(InputError, match="elevator"):
        shipped.channels_us(Command(0.5, 0.0, math.nan, 0.0))


def test_too_few_slots_are_refused(shipped, skewed):
    """The rudder sits in slot 6 there."""
    with pytest.raises(InputError, match="expected at least 6, got 5"):
        skewed.command((1500,) * 5)
    with pytest.raises(InputError, match="finite"):
        shipped.command((1500, math.nan, 1500, 1500))


def test_a_file_is_read_as_it_was_written(skewed, tmp_path):
    """What `write_toml` writes of a calibration is a calibration file."""
    write_toml(tmp_path / "own.toml", skewed)
    assert load_calibration(tmp_path / "own.toml") == skewed


def test_every_number_of_the_shipped_file_says_where_it_is_from():
    """Behind each number stands a comment with one of the three sources that its head explains."""
    text = default_calibration_path().read_text(encoding="utf-8")
    lines = [
        line for line in text.splitlines() if "=" in line.split("#")[0] and not line.startswith("#")
    ]
    numbers = [line for line in lines if any(c.isdigit() for c in line.split("#")[0])]
    assert len(numbers) == 4 + 4 * 4
    sourced = [
        line
        for line in numbers
        if any(word in line for word in ("convention", "report", "assumed", "paper"))
    ]
    assert sourced == numbers
    assert tomllib.loads(text)["measured"] == ""


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"channels": 3}, "channels"),
        ({"channels": 9}, "channels"),
        ({"polarity": 2}, "polarity: expected 1"),
        ({"gap_us": 900}, "gap_us"),
        ({"frame_us": 11_000}, "expected a pause of 4000..19000 us behind 4 channels"),
        ({"frame_us": 23_500}, "expected a pause"),
        ({"measured": "last week"}, "measured: expected a day"),
        ({"rudder": Stick(1, 1000, 1500, 2000)}, "four different slots"),
        ({"rudder": Stick(5, 1000, 1500, 2000)}, "four different slots of 1..4"),
        ({"rudder": Stick(0, 1000, 1500, 2000)}, "four different slots"),
    ],
    ids=str,
)
def test_what_makes_no_frame_is_refused(shipped, change, sentence):
    """The rules of a PPM frame: 4 to 8 slots, a pause of 4 to 19 ms, every stick in a slot of its
    own.
    """
    with pytest.raises(InputError, match=sentence):
        dataclasses.replace(shipped, **change)


@pytest.mark.parametrize(
    "ends", [(1500, 1500, 2000), (2000, 1500, 1000), (899, 1500, 2000), (1000, 1500, 2101)]
)
def test_ends_of_a_stick_stand_in_order(ends):
    """A reversed stick says so by its flag, and what the firmware calls invalid is no end."""
    with pytest.raises(InputError, match="low_us < centre_us < high_us"):
        Stick(1, *ends)


def test_a_wrong_file_gets_one_sentence_with_its_key(tmp_path):
    """A missing table, a text for a number, a wrong end: the key is named."""
    text = default_calibration_path().read_text(encoding="utf-8")
    path = tmp_path / "own.toml"
    for change, sentence in (
        (("[rudder]", "[ruder]"), "unknown key 'ruder'; perhaps you meant 'rudder'"),
        (("frame_us = 22000", 'frame_us = "22 ms"'), "frame_us: expected a whole number"),
        (("low_us = 1000", "low_us = 1600"), "throttle: expected low_us < centre_us"),
    ):
        path.write_text(text.replace(*change, 1), encoding="utf-8")
        with pytest.raises(InputError, match=sentence):
            load_calibration(path)
    with pytest.raises(FileNotFoundError):
        load_calibration(tmp_path / "none.toml")
