"""Simulated board: the simulator itself against a program of known timing, and the interface that
all boards share.
"""

import os
import subprocess
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge.python_board import Board, PythonBoard
from falconwing_kit.tools.bridge.simulated_board import BoardOnPty, SimulatedBoard
from falconwing_kit.trainer_port.protocol import (
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    encode_channels,
    encode_sync,
)
from tests.firmware.chip import ProbedBoard, require_tools

BYTE = 10 / 115200  # s

# The timer alone makes an edge every 500 us; a byte is answered with the next one, after a zero a
# millisecond later.
PROBE = """
    #include <avr/interrupt.h>
    #include <avr/io.h>
    #include <avr/sleep.h>
    #include <util/delay.h>
    ISR(TIMER1_COMPA_vect) { OCR1A += 1000; }
    ISR(USART0_RX_vect) {
      uint8_t byte = UDR0;
      if (byte == 0) _delay_ms(1);
      while (!(UCSR0A & _BV(UDRE0))) {}
      UDR0 = byte + 1;
    }
    void __attribute__((noinline)) loop(void) { sleep_mode(); }
    int main(void) {
      UBRR0 = 16;
      UCSR0A = _BV(U2X0);
      UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
      DDRB = _BV(5);
      OCR1A = 1000;
      TIMSK1 = _BV(OCIE1A);
      TCCR1A = _BV(COM1A0);
      TCCR1B = _BV(CS11);
      sei();
      for (;;) loop();
    }
"""


@pytest.fixture(scope="module")
def probe_elf(tmp_path_factory) -> Path:
    """The probe, compiled."""
    require_tools()
    folder = tmp_path_factory.mktemp("probe")
    (folder / "probe.c").write_text(textwrap.dedent(PROBE))
    command = [
        "avr-gcc",
        "-mmcu=atmega2560",
        "-Os",
        "-DF_CPU=16000000L",
        "probe.c",
        "-o",
        "probe.elf",
    ]
    subprocess.run(command, cwd=folder, check=True, timeout=60)
    return folder / "probe.elf"


@pytest.fixture
def probe(probe_elf) -> Iterator[ProbedBoard]:
    """The probe, switched on a millisecond ago."""
    with ProbedBoard(probe_elf) as board:
        board.run_until(0.001)
        yield board


def test_edges_stand_where_the_timer_puts_them(probe):
    """By hand: Timer1 at 2 MHz, a toggle every 1000 ticks = 500 us, across its wraps (32.8 ms)."""
    level, changes = probe.pin_level, []
    for k in range(20_000):
        probe.run_until(0.002 + k * 1e-5)
        if probe.pin_level != level:
            level = probe.pin_level
            changes.append(probe.t)
    assert len(changes) in (399, 400)
    assert np.diff(changes) == pytest.approx(
        np.full(len(changes) - 1, 500e-6), abs=1.1e-5
    )  # looked every 10 us


def test_a_byte_takes_ten_bits_each_way(probe):
    """115200 8N1 to the chip, 86.8 us; its own 117647 baud back (UBRR 16, U2X), 85.0 us; 10 us for
    the program.
    """
    t = probe.t
    probe.write(b"A")
    probe.run_until(t + BYTE + 85e-6)
    assert probe.read() == b""
    probe.run_until(t + BYTE + 95e-6)
    assert probe.read() == b"B"


def test_bytes_that_nobody_fetches_are_lost(probe):
    """For a millisecond the interrupt does not return, and ten bytes come: the receiver holds two,
    as silicon does.
    """
    probe.write(b"\0" + b"abcdefghij")
    probe.run_until(probe.t + 0.01)
    assert probe.read() == b"\1" + b"bc"
    assert probe.overruns == 8


def test_a_hung_loop_does_not_stop_the_interrupts(probe):
    """The probe answers from an interrupt; it has no watchdog, so its program hangs permanently."""
    probe.hang()
    probe.run_until(probe.t + 0.01)
    probe.write(b"x")
    probe.run_until(probe.t + 0.01)
    assert probe.read() == b"y"
    assert probe.watchdog_resets == 0


def test_two_runs_are_the_same_to_the_bit():
    """Virtual time: nothing depends on the machine or its load."""
    require_tools()

    def run() -> tuple[bytes, list[float]]:
        with SimulatedBoard() as board:
            board.set_pilot((1100, 1500, 1500, 1900))
            for k in range(10):
                board.write(encode_channels(k, (1200, 1500, 1600, 1400), engage=k > 0))
                board.run_until(0.1 + 0.05 * k)
            return board.read(), [frame.t_start for frame in board.ppm_frames()]

    assert run() == run()


def test_a_file_that_is_no_program_is_said(tmp_path):
    """One sentence with the file's name, and no crash."""
    require_tools()
    for content in (b"", b"not a program", b"\x7fELF" + bytes(200)):
        (tmp_path / "broken.elf").write_bytes(content)
        with pytest.raises(InputError, match=r"broken\.elf: expected a program"):
            SimulatedBoard(tmp_path / "broken.elf")


def test_a_closed_board_says_so(probe_elf):
    """A sentence, where the C library would crash; closing twice does no harm."""
    board = SimulatedBoard(probe_elf)
    board.close()
    board.close()
    for use in (
        board.read,
        board.ppm_frames,
        board.hang,
        lambda: board.write(b"x"),
        lambda: board.run_until(1.0),
    ):
        with pytest.raises(RuntimeError, match="it was closed"):
            use()


# What a host may rely on, whatever the board is.


@pytest.fixture(params=["python", "chip"])
def board(request) -> Iterator[Board]:
    """Both boards, half a second after power-on."""
    if request.param == "chip":
        require_tools()
    made = PythonBoard() if request.param == "python" else SimulatedBoard()
    made.run_until(0.5)
    yield made
    made.close()


def messages(board: Board, kind: type) -> list:
    """What has come of a kind."""
    return [message for message in Deframer().feed(board.read()) if isinstance(message, kind)]


def test_status_comes_twenty_times_a_second(board):
    """In half a second ten, the first ones perhaps late by the boot."""
    assert 8 <= len(messages(board, Status)) <= 10


def test_commands_reach_the_pin(board):
    """engage=0, the edge and five at idle, then the sticks, to a microsecond; frames are 22 ms
    long.
    """
    for k in range(8):
        sticks = (1200, 1500, 1600, 1400) if k > 5 else (1000, 1500, 1500, 1500)
        board.write(encode_channels(k, sticks, engage=k > 0))
        board.run_until(board.t + 0.05)
    frames = board.ppm_frames()
    assert frames[-1].slots_us == pytest.approx([1200, 1500, 1600, 1400], abs=1.0)
    assert frames[-1].gap_us == pytest.approx([400] * 5, abs=1.0)
    assert frames[-1].t_slots - frames[-1].t_start == pytest.approx(
        np.cumsum(frames[-1].slots_us) * 1e-6, abs=1e-9
    )
    assert [frame.frame_us for frame in frames] == pytest.approx([22000] * len(frames), abs=1.0)
    assert [a.t_start + a.frame_us * 1e-6 for a in frames[:-1]] == pytest.approx(
        [b.t_start for b in frames[1:]]
    )
    assert board.ppm_frames() == []


def test_the_pilot_is_reported(board):
    """The sticks as given, to a microsecond, 45 times a second; none after he is gone."""
    board.set_pilot((1100, 1300, 1700, 1900))
    board.run_until(board.t + 0.5)
    taken = messages(board, PilotFrame)
    assert 18 <= len(taken) <= 23
    assert taken[-1].channels_us == pytest.approx((1100, 1300, 1700, 1900), abs=1)
    board.set_pilot(None)
    board.run_until(board.t + 0.1)
    board.read()
    board.run_until(board.t + 0.5)
    assert messages(board, PilotFrame) == []
    with pytest.raises(InputError, match="pilot"):
        board.set_pilot([2200] * 9)


def test_a_sync_tells_when_it_came(board):
    """Nine bytes at 115200 baud are 781 us; the board's clock started up to 1 ms after its power,
    and reads to 4 us.
    """
    board.read()
    asked = board.t
    board.write(encode_sync(77))
    board.run_until(board.t + 0.01)
    (reply,) = messages(board, SyncReply)
    assert reply.token == 77
    assert -0.001 <= reply.received_us * 1e-6 - (asked + 9 * BYTE) <= 0.0005
    assert reply.received_us <= reply.sent_us <= reply.received_us + 2000


def test_hang_and_power_cycle(board):
    """The watchdog resets a hung board, which says so and counts the boot; power-off forgets; time
    goes on.
    """
    board.hang()
    board.run_until(1.5)
    status = messages(board, Status)[-1]
    assert (status.state, status.fault, status.boot_count) == ("FAULT", "stall", 2)
    board.power_cycle()
    assert board.t == pytest.approx(1.5, abs=1e-6)
    board.run_until(2.0)
    status = messages(board, Status)[-1]
    assert (status.state, status.boot_count) == ("SAFE", 1)
    assert status.device_time_us < 500_000
    assert all(frame.t_start > 0.0 for frame in board.ppm_frames())
    board.run_until(1.0)
    assert board.t == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("t", [float("nan"), float("inf"), "soon"])
def test_time_that_is_none_is_refused(board, t):
    """A sentence, not an endless run."""
    with pytest.raises(InputError, match="t: expected"):
        board.run_until(t)


# Behind a pseudo-terminal.


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_pyserial_flies_the_chip():
    """The serial library opens the path as any port: the first STATUS, then 20 commands, all
    accepted and on the pin.

    Nothing here depends on how busy the machine is but the patience: the safety countdown may run
        out in between.
    """
    require_tools()
    import serial

    deframer, statuses, patience = Deframer(), [], time.monotonic() + 60.0
    with (
        BoardOnPty(SimulatedBoard()) as line,
        serial.Serial(line.path, 115200, timeout=0.01) as port,
    ):

        def listen(done) -> None:
            while not done() and time.monotonic() < patience:
                statuses.extend(m for m in deframer.feed(port.read(256)) if isinstance(m, Status))

        listen(lambda: statuses)
        for k in range(20):
            sticks = (1200, 1500, 1500, 1400) if k > 8 else (1000, 1500, 1500, 1500)
            port.write(encode_channels(k, sticks, engage=k > 0))
            end = time.monotonic() + 0.05
            listen(lambda end=end: time.monotonic() >= end)
        listen(lambda: statuses[-1].accepted == 20)
        assert statuses[-1].accepted == 20
        assert statuses[-1].last_sequence == 19
        assert line.error is None and line.worst_lag >= 0.0
        with line.pause() as board:
            t = board.t
            assert len(line_frames := board.ppm_frames()) > 30
        assert line.to_host_time(t) <= time.perf_counter()
    if line.worst_lag < 0.1:  # else the machine stood still and the countdown may have run out
        assert any(
            frame.slots_us == pytest.approx([1200, 1500, 1500, 1400], abs=1.0)
            for frame in line_frames
        )
    line.close()  # a second time does no harm
