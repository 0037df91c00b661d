"""The firmware's link and safety, compiled for this computer: C++ -> the same calls as the Python
twin has.

`make -C firmware host-lib` builds it; what it offers is told by firmware/host_tests/host_api.h.
"""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pytest

from falconwing_kit.trainer_port import SafetyDecision
from falconwing_kit.trainer_port.protocol import FAULTS, STATES

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"


@cache
def build(out: Path, defines: str = "") -> ctypes.CDLL:
    """The library, built into a folder with settings such as "-DSILENT_AFTER_MS=1000"."""
    missing = [tool for tool in ("make", "g++") if shutil.which(tool) is None]
    if missing:
        reason = f"{' and '.join(missing)} missing (apt-get install make g++)"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    command = ["make", "-s", "-C", str(FIRMWARE), "host-lib", f"OUT={out}", f"DEFINES={defines}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(out / "libtrainer_bridge.so"))
    library.safety_new.restype = library.link_new.restype = ctypes.c_void_p
    return library


class HostSafety:
    """The firmware's state machine with the names of `Safety`."""

    def __init__(
        self, library: ctypes.CDLL, now_us: int = 0, *, watchdog_reset: bool = False
    ) -> None:
        self._library, self._channels = library, library.config_channels()
        self._self = ctypes.c_void_p(
            library.safety_new(ctypes.c_uint32(now_us), int(watchdog_reset))
        )
        self.slots_us: tuple[int, ...] = ()

    def frame(
        self, now_us: int, sequence: int, engage: bool, channels_us: Sequence[int]
    ) -> SafetyDecision:
        channels = (ctypes.c_uint16 * len(channels_us))(*channels_us)
        now, number = ctypes.c_uint32(now_us), ctypes.c_uint16(sequence)
        return SafetyDecision(
            self._library.safety_frame(
                self._self, now, number, int(engage), channels, len(channels_us)
            )
        )

    def tick(self, now_us: int, pilot_us: Sequence[int] | None = None) -> tuple[int, ...] | None:
        slots, sticks = (ctypes.c_uint16 * self._channels)(), pilot_us or ()
        pilot = (ctypes.c_uint16 * max(len(sticks), 1))(*sticks)
        silent = self._library.safety_tick(
            self._self, ctypes.c_uint32(now_us), pilot, len(sticks), slots
        )
        self.slots_us = tuple(slots)
        return None if silent else self.slots_us

    @property
    def state(self) -> str:
        return STATES[self._library.safety_state(self._self)]

    @property
    def fault(self) -> str:
        return FAULTS[self._library.safety_fault(self._self)]

    @property
    def has_pilot(self) -> bool:
        return bool(self._library.safety_has_pilot(self._self))

    @property
    def pilot_took_over(self) -> bool:
        return bool(self._library.safety_pilot_took_over(self._self))

    @property
    def size(self) -> int:
        """Bytes of the object's memory."""
        return self._library.safety_size()

    def flip(self, byte: int, bit: int) -> None:
        """Disturb the object's memory."""
        self._library.safety_flip(self._self, byte, bit)

    def close(self) -> None:
        self._library.safety_free(self._self)


def encode(library: ctypes.CDLL, kind: int, values: Sequence[int]) -> bytes:
    """A frame as the firmware writes it, with its zero byte; values in the order of the wire."""
    frame = (ctypes.c_uint8 * 65)()
    size = library.link_encode(kind, (ctypes.c_uint32 * len(values))(*values), len(values), frame)
    return bytes(frame[:size])


def decode(library: ctypes.CDLL, frame: bytes) -> tuple[int, tuple[int, ...]] | None:
    """Type and values of a frame as the firmware reads it; None where it refuses."""
    kind, values = ctypes.c_int(), (ctypes.c_uint32 * 24)()
    data = (ctypes.c_uint8 * max(len(frame), 1))(*frame)
    count = library.link_decode(data, len(frame), ctypes.byref(kind), values)
    return None if count < 0 else (kind.value, tuple(values[:count]))


class HostLink:
    """The firmware's receiver in front of its state machine."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._self = ctypes.c_void_p(library.link_new())
        self._safety = ctypes.c_void_p(library.safety_new(ctypes.c_uint32(0), 0))

    def feed(self, now_us: int, data: bytes) -> int:
        """How many commands were accepted of these bytes."""
        buffer = (ctypes.c_uint8 * max(len(data), 1))(*data)
        return self._library.link_feed(
            self._self, self._safety, ctypes.c_uint32(now_us), buffer, len(data)
        )

    @property
    def bad(self) -> int:
        return self._library.link_bad(self._self)

    def close(self) -> None:
        self._library.link_free(self._self)
        self._library.safety_free(self._safety)
