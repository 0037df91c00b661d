"""`falconwing calibrate`: the sticks of a radio that the test knows are found again; what is stale
is refused.
"""

import json
import types
from dataclasses import replace
from datetime import date, timedelta

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import write_toml
from falconwing_kit.core.messages import COMMAND_NAMES, Command
from falconwing_kit.tools.bridge.open_port import SteppedBoard
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.cli import calibrate
from falconwing_kit.tools.cli.calibrate import (
    MAX_AGE_DAYS,
    POSES,
    SIMULATED_RADIO,
    assign_channels,
    choose_calibration,
    measure_calibration,
)
from falconwing_kit.tools.cli.main import main
from falconwing_kit.trainer_port.port import TrainerPort, require_matching_calibration
from falconwing_kit.trainer_port.ppm import Stick, load_calibration
from falconwing_kit.trainer_port.protocol import Status

TODAY = date(2026, 3, 1)  # for the tests of age, which would otherwise change at midnight


def run(*words):
    """The verb, as `falconwing calibrate WORDS`."""
    return main(["calibrate", *words])


def readings(radio=SIMULATED_RADIO):
    """What a radio gives in every pose."""
    return {name: radio.channels_us(sticks) for name, _, sticks in POSES}


def test_channel_ends_centre_and_direction_are_found():
    """By hand: elevator in slot 3, back gives 1100, forward 1850, centre 1520: reversed, for nose
    up gives less.
    """
    poses = {name: [1500, 1000, 1520, 1500] for name, _, _ in POSES}
    poses["throttle +"] = [1500, 2000, 1520, 1500]
    poses |= {"elevator +": [1500, 1000, 1100, 1500], "elevator -": [1500, 1000, 1850, 1500]}
    poses |= {"aileron +": [1900, 1000, 1520, 1500], "aileron -": [1100, 1000, 1520, 1500]}
    poses |= {"rudder +": [1500, 1000, 1520, 1200], "rudder -": [1500, 1000, 1520, 1800]}
    assert assign_channels(poses) == {
        "throttle": Stick(2, 1000, 1500, 2000),
        "aileron": Stick(1, 1100, 1500, 1900),
        "elevator": Stick(3, 1100, 1520, 1850, reversed=True),
        "rudder": Stick(4, 1200, 1500, 1800, reversed=True),
    }


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"aileron +": 1600, "aileron -": 1400},
            "aileron: expected 250 us of travel, got 200; move it all the way",
        ),
        ({"rudder +": 1510, "rudder -": 1510}, "rudder: expected 250 us of travel, got 0"),
        ({"aileron +": 1525, "aileron -": 1105}, "aileron: expected low_us < centre_us < high_us"),
    ],
)
def test_a_stick_that_was_not_moved_all_the_way_is_refused(changes, sentence):
    """By hand: half the travel; none; right only to just beyond the centre of 1530, which is no
    centre then.
    """
    poses = {name: list(slots) for name, slots in readings().items()}
    if 1525 in changes.values():
        poses["rest"][3] = 1530
    for name, us in changes.items():
        poses[name][SIMULATED_RADIO.sticks[COMMAND_NAMES.index(name.split()[0])].channel - 1] = us
    with pytest.raises(InputError, match=sentence):
        assign_channels(poses)


def test_two_sticks_at_once_are_refused():
    """Elevator and rudder by half as much, as a mix would do it: nobody can tell which it is."""
    poses = readings()
    poses["elevator +"] = SIMULATED_RADIO.channels_us(Command(0.0, 0.0, 1.0, 0.9))
    with pytest.raises(
        InputError, match="elevator: expected one channel to move, got two, by 805 and 36"
    ):
        assign_channels(poses)


class Holding:
    """A person with a radio at the board's pilot pin."""

    def __init__(self, port, radio=SIMULATED_RADIO):
        self.port, self.radio = port, radio

    def hold(self, what, sticks):
        with self.port.link.pause() as board:
            board.set_pilot(self.radio.channels_us(sticks))


@pytest.fixture
def virtual():
    """A port to a plain Python board in virtual time, and what lets its time pass."""
    clock = types.SimpleNamespace(t=0.0)

    def pause(seconds):
        clock.t += seconds

    port = TrainerPort(SteppedBoard(PythonBoard(), lambda: clock.t), now=lambda: clock.t)
    port.wait_ready(sleep=pause)
    return port, pause


def test_the_radio_is_found_through_the_board(virtual):
    """Through PPM, board and serial frames; truth: the simulated radio. Half throttle is half way
    by definition.
    """
    port, pause = virtual
    days = {date.today().isoformat()}
    found = measure_calibration(port, Holding(port), "mine", pause)
    days.add(date.today().isoformat())  # two around midnight
    assert (
        found.sticks[1:] == SIMULATED_RADIO.sticks[1:]
        and found.throttle == SIMULATED_RADIO.throttle
    )
    assert found.radio == "mine" and found.measured in days


def test_a_throttle_where_the_firmware_has_none_is_refused(virtual):
    """The firmware's safe slots are 1000, 1500, 1500, 1500: with the throttle in channel 2 a loss
    would leave it at half, which must never be flown.
    """
    port, pause = virtual
    swapped = replace(
        SIMULATED_RADIO,
        throttle=replace(SIMULATED_RADIO.throttle, channel=2),
        elevator=Stick(1, 1090, 1487, 1895),
    )
    with pytest.raises(
        InputError, match=r"got throttle 5\d%, for the radio has it in channel 2 .*THROTTLE_CHANNEL"
    ):
        measure_calibration(port, Holding(port, swapped), "mine", pause)


def test_a_stick_beyond_the_board_s_channels_is_refused(virtual):
    """A radio of six channels with its rudder in the sixth; the board sends four."""
    port, pause = virtual
    wide = replace(SIMULATED_RADIO, channels=6, rudder=replace(SIMULATED_RADIO.rudder, channel=6))
    with pytest.raises(
        InputError, match=r"expected sticks in the board's channels 1 to 4, got {'rudder': 6}"
    ):
        measure_calibration(port, Holding(port, wide), "mine", pause)


def test_no_pulses_is_one_sentence(virtual):
    """Nobody's radio is on."""
    port, pause = virtual
    nobody = types.SimpleNamespace(hold=lambda what, sticks: None)
    with pytest.raises(
        InputError,
        match=r"expected the radio's pulses at the board's pilot input \(pin 49\), got none",
    ):
        measure_calibration(port, nobody, "mine", pause)


def test_trembling_hands_are_one_sentence(virtual):
    """Sticks that move 40 us while they are read give no reading."""
    port, pause = virtual
    steps = iter(range(10**6))

    def trembling(seconds):
        with port.link.pause() as board:
            board.set_pilot((1500, 1500 + 40 * (next(steps) // 5 % 2), 1500, 1500))
        pause(seconds)

    with pytest.raises(InputError, match="held still to 12 us"):
        calibrate.read_steady_channels(port, trembling)


def test_the_rehearsal_writes_a_file_that_other_verbs_take(tmp_path, monkeypatch, capsys):
    """In real time with the plain Python board: the file says SIMULATED, its place is shown, and it
    loads.
    """
    monkeypatch.chdir(tmp_path)
    assert run("--port", "sim-python", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert (
        record["file"] == str(tmp_path / "trainer_port.toml")
        and record["radio"] == "SIMULATED radio"
    )
    assert (
        choose_calibration("sim").sticks
        == load_calibration(tmp_path / "trainer_port.toml").sticks
        == SIMULATED_RADIO.sticks
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--port", "sim-python"], "add --replace"),
        (["--port", "nowhere", "--out", "new.toml"], "--radio: expected the name"),
        (
            ["--port", "nowhere", "--radio", "R", "--out", "new.toml"],
            "nowhere: expected a serial port",
        ),
        (["--port", "sim-python", "--out", "none/new.toml"], "expected a folder"),
    ],
)
def test_what_cannot_be_is_one_sentence(tmp_path, monkeypatch, capsys, words, sentence):
    """Before anybody moves a stick."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "trainer_port.toml").write_text("")
    assert run(*words) == 2
    assert sentence in capsys.readouterr().err


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Writes a calibration that was measured on TODAY, with changes."""
    monkeypatch.chdir(tmp_path)

    def write(**changes):
        fresh = replace(SIMULATED_RADIO, radio="mine", measured=TODAY.isoformat())
        write_toml(tmp_path / "trainer_port.toml", replace(fresh, **changes))

    return write


def test_a_fresh_calibration_of_this_radio_is_taken(mine):
    """The file in this folder, without being named."""
    mine()
    assert (
        choose_calibration("COM3", radio="mine", today=TODAY).throttle == SIMULATED_RADIO.throttle
    )
    mine(measured=(TODAY - timedelta(MAX_AGE_DAYS)).isoformat())
    assert choose_calibration("sim", today=TODAY).radio == "mine"


def test_a_named_radio_without_any_calibration_is_refused(tmp_path, monkeypatch):
    """The kit's default is of no radio; without a name it is taken, with a warning."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"--radio mine: expected a calibration measured on it"):
        choose_calibration("COM3", radio="mine", today=TODAY)
    with pytest.warns(UserWarning, match="not measured on a radio"):
        choose_calibration("COM3", today=TODAY)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"radio": "yours"}, "measured on yours, not on mine"),
        ({"radio": SIMULATED_RADIO.radio}, "SIMULATED radio"),
        ({"measured": (TODAY - timedelta(MAX_AGE_DAYS + 1)).isoformat()}, "181 days old"),
        ({"measured": (TODAY + timedelta(2)).isoformat()}, "-2 days old"),
        ({"gap_us": 300}, "gap_us 300 where the firmware's is 400"),
        ({"polarity": 0}, "polarity 0 where the firmware's is 1"),
    ],
)
def test_a_stale_calibration_is_refused(mine, changes, sentence):
    """Another radio's, too old, from the future, or for a firmware with another PPM frame."""
    mine(**changes)
    with pytest.raises(InputError, match=sentence):
        choose_calibration("COM3", radio="mine", today=TODAY)


def test_a_rehearsed_calibration_flies_no_real_aircraft(mine):
    """It fits the simulated radio, and simulated boards alone."""
    mine(radio=SIMULATED_RADIO.radio)
    assert choose_calibration("sim", today=TODAY).radio == SIMULATED_RADIO.radio
    with pytest.raises(InputError, match="stale one: of a SIMULATED radio"):
        choose_calibration("/dev/ttyACM0", today=TODAY)


def test_without_a_calibration_the_default_is_taken_and_said(tmp_path, monkeypatch):
    """The kit's own values were measured on no radio."""
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match="not measured on a radio"):
        assert choose_calibration("sim") == load_calibration()


def test_a_board_of_eight_channels_is_calibrated_and_flown(mine):
    """CHANNELS is a setting of the firmware: what was measured on a board of eight is refused by
    one of four alone.
    """
    mine(channels=8)
    eight = choose_calibration("COM3", radio="mine", today=TODAY)
    assert eight.channels == 8
    said = Status("SAFE", "none", 1, 1, 0, 0, 0, 0, 0, 0, False, (1000, *[1500] * 7), 0)
    require_matching_calibration(eight, said)
    with pytest.raises(InputError, match="expected 4 channels as the board's firmware has, got 8"):
        require_matching_calibration(eight, replace(said, channels_us=(1000, 1500, 1500, 1500)))


def test_a_calibration_without_a_date_is_said(mine):
    """Copied from the kit's default by hand: it cannot grow stale, and may never have been
    measured.
    """
    mine(measured="")
    with pytest.warns(UserWarning, match="no date of measurement"):
        assert choose_calibration("COM3", today=TODAY).measured == ""


def test_every_stick_has_a_pose():
    """By hand: a rest, two ends for each of three sticks, one for the throttle."""
    assert len(POSES) == 8 and all(f"{name} +" in readings() for name in COMMAND_NAMES)
