"""Links: the real serial code against a pseudo-terminal, a simulated board in step with a clock,
and what is on USB.
"""

import os
import sys
import time
import types

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command
from falconwing_kit.tools.bridge.build import missing_tools
from falconwing_kit.tools.bridge.open_port import STEP, SteppedBoard, open_port
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.bridge.simulated_board import BoardOnPty
from falconwing_kit.trainer_port import usb
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.usb import SerialLink, find_boards, permission_advice

POSIX = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
STICKS = Command(0.5, 0.1, -0.2, 0.3)
HELD = (1510, 1540, 1410, 1640)  # sticks of the SIMULATED pilot, near them


def wait_for(what, seconds: float = 20.0) -> bool:
    """Wait until it is true; the time is generous, for the machine may be busy."""
    end = time.monotonic() + seconds
    while not (true := what()) and time.monotonic() < end:
        time.sleep(0.005)
    return true


# A board in virtual time.


@pytest.fixture
def flown():
    """A port that has flown the plain Python board for two seconds; its clock is set by hand."""
    clock = types.SimpleNamespace(t=10.0)
    link = SteppedBoard(PythonBoard(), lambda: clock.t)
    port = TrainerPort(link, now=lambda: clock.t)
    link.board.set_pilot(HELD)

    def run(seconds, engage=None):
        for _ in range(round(seconds / 0.05)):
            clock.t += 0.05
            if engage is not None:
                port.send(STICKS, engage)
            port.poll()

    run(0.5)
    run(2.0, engage=True)
    return port, run


def test_the_aircraft_follows_and_the_slots_are_the_sticks(flown):
    """By hand from the shipped calibration: 1500, 1550, 1400, 1650 us; every frame sent was
    accepted.
    """
    port, run = flown
    assert port.engagement == "engaged" and port.status.state == "ACTIVE"
    with port.link.pause() as board:
        assert board.ppm_frames()[-1].slots_us.tolist() == [1500.0, 1550.0, 1400.0, 1650.0]
    run(0.1)
    assert port.counters.sent == port.counters.accepted == 40 and port.counters.dropped == 0


def test_a_loop_that_stops_is_noticed_though_the_port_is_read(flown):
    """200 ms by the firmware's rule; reading alone must not keep the aircraft flying."""
    port, run = flown
    run(0.3)
    assert port.status.state == "LOST" and port.engagement == "dropped"
    with port.link.pause() as board:
        assert board.ppm_frames()[-1].slots_us.tolist() == [1000.0, 1500.0, 1500.0, 1500.0]


def test_taking_back_after_a_loss_needs_a_withdrawal(flown):
    """Asking on gets nothing; withdrawing once and asking again does."""
    port, run = flown
    run(0.3)
    run(1.0, engage=True)
    assert port.status.state == "SAFE"
    run(0.05, engage=False)
    run(1.0, engage=True)
    assert port.status.state == "ACTIVE"


def test_hand_back_reaches_the_board_in_one_status(flown):
    """By hand: three frames of 16 bytes are 4 ms on the wire, the next STATUS says SAFE."""
    port, run = flown
    port.hand_back()
    run(0.1)
    assert port.status.state == "SAFE" and port.engagement == "dropped"


def test_power_loss_in_flight_is_seen_and_not_flown_on(flown):
    """The board forgets all; the port counts a reset and asks nothing of it."""
    port, run = flown
    with port.link.pause() as board:
        board.power_cycle()
    run(0.5, engage=True)
    assert (
        port.counters.resets == 1 and port.engagement == "dropped" and port.status.state == "SAFE"
    )


def test_device_time_is_known_to_a_millisecond_in_virtual_time(flown):
    """Truth: the host's clock is the board's plus ten seconds. Replies are stamped to STEP."""
    port, _ = flown
    assert port.to_host_time(1_000_000) == pytest.approx(11.0, abs=STEP)
    assert abs(port.to_host_time(1_000_000) - 11.0) <= port.clock.error_bound(1_000_000)


# The serial code.


@POSIX
def test_the_serial_code_flies_a_board_behind_a_pseudo_terminal():
    """Real pyserial, real time: engages, gets the pilot's sticks, and hands back; no figures, for
    it is wall clock.
    """
    from falconwing_kit.tools.bridge.simulated_board import BoardOnPty

    with BoardOnPty(PythonBoard()) as line, TrainerPort(SerialLink(line.path)) as port:
        port.wait_ready(20.0)
        with line.pause() as board:
            board.set_pilot(HELD)

        def flying():
            port.send(STICKS, engage=True)
            time.sleep(0.04)
            port.poll()
            return port.engagement == "engaged" and port.pilot is not None

        assert wait_for(flying)
        assert port.pilot.channels_us == HELD
        port.hand_back()
        assert wait_for(lambda: port.poll() is None and port.status.state == "SAFE")


@POSIX
def test_a_line_that_goes_away_is_an_event_and_comes_back():
    """The pseudo-terminal is closed under the port, as by unplugging; a second one is opened in its
    place.
    """
    from falconwing_kit.tools.bridge.simulated_board import BoardOnPty

    lines = [BoardOnPty(PythonBoard())]
    port = TrainerPort(SerialLink(lines[0].path), reopen=lambda: SerialLink(lines[-1].path))
    try:
        port.wait_ready(20.0)
        lines[0].close()
        assert wait_for(lambda: port.poll() is None and port.state == "lost")
        assert not port.send(STICKS, engage=True)
        lines.append(BoardOnPty(PythonBoard()))
        assert wait_for(lambda: port.poll() is None and port.state == "open")
        assert port.counters.reconnects >= 1 and port.send(STICKS, engage=False)
    finally:
        port.close()
        lines[-1].close()


@POSIX
@pytest.mark.skipif(
    bool(missing_tools()) and not os.environ.get("CI"), reason="tools of the firmware are missing"
)
def test_the_port_called_sim_is_the_firmware_behind_real_serial_code():
    """It follows, through pyserial, pseudo-terminal and simulated chip, and says that it is
    simulated.
    """
    with open_port("sim") as port:
        port.wait_ready(20.0)
        with port.simulation.pause() as board:
            board.set_pilot(HELD)

        def flying():
            port.send(STICKS, engage=True)
            time.sleep(0.04)
            port.poll()
            return port.engagement == "engaged" and port.status.channels_us == (
                1500,
                1550,
                1400,
                1650,
            )

        assert (
            wait_for(flying)
            and port.what == "SIMULATED board, the firmware in a simulated ATmega2560"
        )


@POSIX
def test_without_pseudo_terminals_the_sentence_names_the_way_out(monkeypatch):
    """Windows has no module pty."""
    monkeypatch.setitem(sys.modules, "pty", None)
    with pytest.raises(InputError, match="got Windows; take --port sim-python"):
        BoardOnPty(PythonBoard())


def test_a_write_off_the_processor_is_not_a_lost_port(monkeypatch):
    """pyserial raises its timeout after a good write too, where select came late; the port must not
    be given up.
    """
    import pty

    master, slave = pty.openpty()
    monkeypatch.setattr(usb, "WRITE_TIMEOUT", 1e-9)  # every write is too late
    link = SerialLink(os.ttyname(slave))
    try:
        link.write(b"abc")
        assert os.read(master, 10) == b"abc"
    finally:
        link.close()
        os.close(master)
        os.close(slave)


@POSIX
def test_a_hand_back_leaves_before_the_port_is_closed(monkeypatch):
    """Some drivers throw away what waits when a port is closed, so closing waits until nothing
    does: the system is scripted to say 48, 16 and 0 bytes, and the port is still open when it says
    0.
    """
    import pty

    import serial

    master, slave = pty.openpty()
    link, waiting, open_at = SerialLink(os.ttyname(slave)), [48, 16, 0], []

    def out_waiting(port):
        open_at.append(port.is_open)
        return waiting[len(open_at) - 1]

    monkeypatch.setattr(serial.Serial, "out_waiting", property(out_waiting))
    link.close()
    assert open_at == [True, True, True]
    os.close(master)
    os.close(slave)


@POSIX
def test_a_port_that_was_unplugged_can_be_closed(monkeypatch):
    """pyserial raises TypeError, not OSError, for the bytes that wait on a closed descriptor."""
    import pty

    import serial

    master, slave = pty.openpty()
    link = SerialLink(os.ttyname(slave))

    def out_waiting(port):
        raise TypeError("an integer is required (got type NoneType)")

    monkeypatch.setattr(serial.Serial, "out_waiting", property(out_waiting))
    link.close()
    os.close(master)
    os.close(slave)


@POSIX
def test_dtr_is_left_on_when_the_port_is_closed():
    """POSIX: HUPCL is the flag that would turn it off; what Arduino's `stty -hupcl` recipe does."""
    import pty
    import termios

    master, slave = pty.openpty()
    settings = termios.tcgetattr(slave)
    settings[2] |= termios.HUPCL
    termios.tcsetattr(slave, termios.TCSANOW, settings)
    SerialLink(os.ttyname(slave)).close()
    assert not termios.tcgetattr(slave)[2] & termios.HUPCL
    os.close(master)
    os.close(slave)


@POSIX
@pytest.mark.parametrize(
    ("place", "sentence"),
    [("absent", "plug the board in; falconwing find-port"), ("folder", "expected a serial port")],
)
def test_a_port_that_cannot_be_opened_is_one_sentence(tmp_path, place, sentence):
    """With what to do about it."""
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=sentence):
        open_port(str(tmp_path / place))


# Boards on USB.


@pytest.fixture
def usb_ports(monkeypatch, tmp_path):
    """A hub with a copy of the Mega, a keyboard, a Mega, and a port that is not on USB."""
    ports = [
        types.SimpleNamespace(
            device=str(tmp_path / "a"), vid=0x1A86, pid=0x7523, description="USB Serial"
        ),
        types.SimpleNamespace(
            device=str(tmp_path / "b"), vid=0x1234, pid=0x0001, description="Some keyboard"
        ),
        types.SimpleNamespace(
            device=str(tmp_path / "c"), vid=0x2341, pid=0x0042, description="ttyACM0"
        ),
        types.SimpleNamespace(device=str(tmp_path / "d"), vid=None, pid=None, description="ttyS0"),
    ]
    for port in ports:
        open(port.device, "w").close()
    from serial.tools import list_ports

    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    return ports


def test_the_mega_is_found_first(usb_ports):
    """Numbers from boards.txt of Arduino's core: 2341:0042 is the Mega 2560 R3; copies have a
    CH340.
    """
    found = find_boards()
    assert [os.path.basename(board.path) for board in found] == ["c", "a", "b"]
    assert [board.likely for board in found] == [True, True, False]
    assert found[0].what == "Arduino Mega 2560" and "CH340" in found[1].what


@POSIX
def test_a_port_without_rights_comes_with_its_mend(usb_ports, monkeypatch):
    """The device's own group is the one to join."""
    import grp

    monkeypatch.setattr(usb.os, "access", lambda *_: False)
    monkeypatch.setattr(grp, "getgrgid", lambda _: types.SimpleNamespace(gr_name="uucp"))
    assert "usermod -aG uucp" in find_boards()[0].advice and not find_boards()[0].may_open


@pytest.mark.skipif(sys.platform == "win32", reason="the sentence is another one there")
def test_a_busy_port_says_what_uses_it(usb_ports):
    """It is there and may be opened, so another program has it."""
    assert "close other programs" in permission_advice(usb_ports[2].device)
