"""USB serial ports: list of boards with access advice; a port's path -> a link to the board."""

import os
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass

from falconwing_kit.core.checks import InputError

BAUD = 115200
DRAIN_S = 0.1  # maximum wait for unsent bytes on closing
WRITE_TIMEOUT = 0.02  # s, maximum delay of the loop by a blocked line
# USB vendor and product numbers; those of the Mega 2560 from boards.txt of Arduino's AVR core.
MEGA = {(vendor, product) for vendor, products in {
    0x2341: (0x0010, 0x0042, 0x0210, 0x0242), 0x2A03: (0x0010, 0x0042),
}.items() for product in products}  # fmt: skip
USB_CHIPS = {  # on copies of the Mega
    (0x1A86, 0x7523): "CH340",
    (0x0403, 0x6001): "FT232R",
    (0x10C4, 0xEA60): "CP2102",
}


@dataclass(frozen=True)
class SerialBoard:
    """One USB serial port."""

    path: str  # value for --port
    what: str  # a Mega 2560, perhaps one, or another device
    likely: bool  # True if it may be the board
    may_open: bool  # this user has permission
    advice: str  # how to get permission; empty if granted


def find_boards() -> list[SerialBoard]:
    """USB serial ports, likely boards first; none is opened, which could restart a board."""
    from serial.tools.list_ports import comports

    found = []
    for port in comports():
        if port.vid is None:
            continue
        key = (port.vid, port.pid)
        what = "Arduino Mega 2560" if key in MEGA else port.description or "unknown"
        if key in USB_CHIPS:
            what = f"perhaps a copy of the Mega 2560 (it has a {USB_CHIPS[key]})"
        may_open = os.name != "posix" or os.access(port.device, os.R_OK | os.W_OK)
        likely = key in MEGA or key in USB_CHIPS
        advice = "" if may_open else permission_advice(port.device)
        found.append(SerialBoard(port.device, what, likely, may_open, advice))
    return sorted(found, key=lambda board: (not board.likely, "perhaps" in board.what, board.path))


def permission_advice(path: str) -> str:
    """What the user can do if a port does not open."""
    if os.name != "posix":
        return "close other programs that use it, and check its name in the device manager"
    if not os.path.exists(path):
        return "plug the board in; falconwing find-port lists what is there"
    if os.access(path, os.R_OK | os.W_OK):
        return "close other programs that use it, such as the Arduino IDE's monitor"
    return f"{_join_group(path)}, then log out and in again"


def _join_group(path: str) -> str:
    """The command that grants access to a device by its group: dialout, uucp or another."""
    import grp

    group = "dialout"
    with suppress(KeyError, OSError):
        group = grp.getgrgid(os.stat(path).st_gid).gr_name
    return f"sudo usermod -aG {group} $USER" if group != "root" else f"sudo chmod a+rw {path}"


class SerialLink:
    """A serial port; a thread reads and time-stamps it, so a slow loop does not affect the stamps.

    A Mega restarts when its DTR line goes on, and sends no PPM for two seconds. Linux and macOS
    switch DTR on when a port is opened and off when it is closed, unless HUPCL is off: then only
    the first opening after plugging in restarts the board, and a killed program can reconnect
    without a restart. On Windows DTR stays off.

    Raises:
        InputError: the port cannot be opened; the message says what to do.
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
        """Send bytes; OSError if the port is gone.

        A timeout is not an error: pyserial also reports one if the operating system suspends this
        process after a successful write. A blocked line shows as silence of the board.
        """
        import serial

        with suppress(serial.SerialTimeoutException):
            self._port.write(data)

    def read(self) -> bytes:
        """The bytes received since the last call; OSError if the port is gone."""
        return b"".join(data for _, data in self.read_stamped())

    def read_stamped(self) -> list[tuple[float, bytes]]:
        """The same in chunks with their times of arrival [s of time.perf_counter]."""
        if self._error is not None:
            raise self._error
        return [self._chunks.popleft() for _ in range(len(self._chunks))]

    def close(self) -> None:
        """Close the port after unsent bytes have left: they may be the hand-back."""
        end = time.perf_counter() + DRAIN_S
        with suppress(OSError, TypeError):  # pyserial raises TypeError if the port disappeared
            while self._port.out_waiting and time.perf_counter() < end:
                time.sleep(0.002)
        self._open = False
        self._reader.join()
        self._port.close()

    def _read_loop(self) -> None:
        """In a thread: read chunks with their times of arrival until the port closes or fails."""
        try:
            while self._open:
                first_byte = self._port.read(1)  # waits for it, at most the port's timeout
                if first_byte:
                    self._chunks.append(
                        (time.perf_counter(), first_byte + self._port.read(self._port.in_waiting))
                    )
        except (OSError, TypeError) as error:  # pyserial raises TypeError if the port disappears
            self._error = error if isinstance(error, OSError) else OSError("the port went away")


def _leave_dtr_on(descriptor: int) -> None:
    """Switch HUPCL off, so that closing the port leaves DTR unchanged."""
    import termios

    with suppress(termios.error):  # a pseudo-terminal may have no such line
        settings = termios.tcgetattr(descriptor)
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
