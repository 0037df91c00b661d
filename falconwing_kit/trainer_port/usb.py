"""Boards on USB serial ports: which there are, how to get at them, and the line to one of them."""

import os
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass

from falconwing_kit.core.checks import InputError

BAUD = 115200
DRAIN_S = 0.1  # s that closing waits for what was written to leave
WRITE_TIMEOUT = 0.02  # s: so long a stuck line may hold up the loop
# Vendor and product numbers of USB: those of the Mega 2560 stand in boards.txt of Arduino's own
# core for AVR.
MEGA = {(vendor, product) for vendor, products in {
    0x2341: (0x0010, 0x0042, 0x0210, 0x0242), 0x2A03: (0x0010, 0x0042),
}.items() for product in products}  # fmt: skip
BRIDGES = {
    (0x1A86, 0x7523): "CH340",
    (0x0403, 0x6001): "FT232R",
    (0x10C4, 0xEA60): "CP2102",
}  # on copies of the Mega


@dataclass(frozen=True)
class SerialBoard:
    """One serial port with something on USB behind it."""

    path: str  # what to give to --port
    what: str  # a Mega 2560, perhaps one, or something else
    likely: bool  # True where it may be the board
    may_open: bool  # this user may
    mend: str  # what to do where not; empty where it is well


def find_boards() -> list[SerialBoard]:
    """Serial ports on USB, the likeliest first; none is opened, for that could restart a board."""
    from serial.tools.list_ports import comports

    found = []
    for port in comports():
        if port.vid is None:
            continue
        key = (port.vid, port.pid)
        what = "Arduino Mega 2560" if key in MEGA else port.description or "unknown"
        if key in BRIDGES:
            what = f"perhaps a copy of the Mega 2560 (it has a {BRIDGES[key]})"
        may_open = os.name != "posix" or os.access(port.device, os.R_OK | os.W_OK)
        likely = key in MEGA or key in BRIDGES
        found.append(
            SerialBoard(
                port.device,
                what,
                likely,
                may_open,
                "" if may_open else permission_advice(port.device),
            )
        )
    return sorted(found, key=lambda board: (not board.likely, "perhaps" in board.what, board.path))


def permission_advice(path: str) -> str:
    """What a person can do so that a port opens."""
    if os.name != "posix":
        return "close other programs that use it, and look into the device manager for its name"
    if not os.path.exists(path):
        return "plug the board in; falconwing find-port lists what is there"
    if os.access(path, os.R_OK | os.W_OK):
        return "close other programs that use it, such as the Arduino IDE's monitor"
    return f"{_join_group(path)}, then log out and in again"


def _join_group(path: str) -> str:
    """The command that gives the right to a device: its group, which is dialout, uucp or another."""
    import grp

    group = "dialout"
    with suppress(KeyError, OSError):
        group = grp.getgrgid(os.stat(path).st_gid).gr_name
    return f"sudo usermod -aG {group} $USER" if group != "root" else f"sudo chmod a+rw {path}"


class SerialLink:
    """A serial port; a thread reads it and stamps what comes, so that a slow loop spoils no time.

    A Mega restarts when its DTR line goes on, and sends no PPM for two seconds then. Linux and
    macOS turn it on when a port is opened and off when it is closed, unless told (HUPCL off) to
    leave it: then only the first opening after plugging in restarts the board, and a program that
    was killed can come back without. On Windows DTR stays off.

    Args:
        path: of the port.

    Raises:
        InputError: it cannot be opened; the text says how to mend that.
    """

    def __init__(self, path: str) -> None:
        import serial

        self._port = serial.Serial(baudrate=BAUD, timeout=0.1, write_timeout=WRITE_TIMEOUT)
        self._port.port, self._port.exclusive = path, True if os.name == "posix" else None
        if os.name != "posix":
            self._port.dtr = False
        try:
            self._port.open()
        except OSError as error:
            raise InputError(
                f"{path}: expected a serial port to open, got: {error}; {permission_advice(path)}"
            ) from None
        if os.name == "posix":
            _leave_dtr_on(self._port.fileno())
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._error: OSError | None = None
        self._open = True
        self._reader = threading.Thread(target=self._read_loop, name=f"reads {path}", daemon=True)
        self._reader.start()

    def write(self, data: bytes) -> None:
        """Send bytes; OSError where the line is gone.

        A write that took too long is no error: pyserial says so too where this program was only
            kept off the processor
        after a good write. Of a line that is really stuck the board's silence tells.
        """
        import serial

        with suppress(serial.SerialTimeoutException):
            self._port.write(data)

    def read(self) -> bytes:
        """What has come since the last call; OSError where the line is gone."""
        return b"".join(data for _, data in self.read_stamped())

    def read_stamped(self) -> list[tuple[float, bytes]]:
        """The same with the times they came [s of time.perf_counter]."""
        if self._error is not None:
            raise self._error
        return [self._chunks.popleft() for _ in range(len(self._chunks))]

    def close(self) -> None:
        """Close the port; what was written goes out before, for it may be the hand-back."""
        end = time.perf_counter() + DRAIN_S
        with suppress(OSError):
            while self._port.out_waiting and time.perf_counter() < end:
                time.sleep(0.002)
        self._open = False
        self._reader.join()
        self._port.close()

    def _read_loop(self) -> None:
        try:
            while self._open:
                data = self._port.read(1)
                if data:
                    self._chunks.append(
                        (time.perf_counter(), data + self._port.read(self._port.in_waiting))
                    )
        except (
            OSError,
            TypeError,
        ) as error:  # pyserial has no file number any more where the port went away
            self._error = error if isinstance(error, OSError) else OSError("the port went away")


def _leave_dtr_on(descriptor: int) -> None:
    """Tell the system to leave DTR as it is when the port is closed."""
    import termios

    with suppress(termios.error):  # a pseudo-terminal may have no such line
        settings = termios.tcgetattr(descriptor)
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
