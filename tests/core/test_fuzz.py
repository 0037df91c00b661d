"""Fuzzing: 12,000 damaged files go through the readers; each is read or refused in one sentence, in
little memory.

A mutation draws from the kinds that real damage and real malice take: flipped bytes, cut ends,
blocks twice or gone, garbage in between, absurd numbers, giant length fields. Every case is
reproducible from its number.
"""

import dataclasses
import os
import shutil
import struct
import tracemalloc
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.flight_log import (
    FlightLogWriter,
    read_flight_log,
    recover,
    to_flight_table,
)
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.core.messages import Command, Image, State

FILES = 3000  # of each of the four kinds
# Python keeps a cell of two bytes as an object of some 50, and a thousand open brackets are a
# thousand nested calls.
BYTES_PER_FILE_BYTE, BYTES_AT_LEAST = 50, 512 * 1024

WEIRD = [
    *(
        b"nan",
        b"inf",
        b"-inf",
        b"1e999",
        b"-1e308",
        b"9" * 400,
        b"0x10",
        b"1_000",
        b"--1",
        b"1.2.3",
        b"",
        b" ",
    ),
    *(
        b",",
        b",,,,",
        b";",
        b"\n",
        b"\r",
        b"\n\n\n",
        b'"',
        b"'",
        b"#",
        b"=",
        b"[",
        b"]" * 9,
        b"[[" * 500,
        b"{" * 500,
    ),
    *(
        b"\0",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\xf0\x9f\x9b\xa9",
        b"true",
        b"1979-05-27T07:32:00Z",
        b"\\u0000",
        b"\x1f",
    ),
    *(
        struct.pack("<Q", n)
        for n in (0, 1, 2**16, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
    ),
    *(struct.pack("<I", n) for n in (2**31, 2**32 - 1)),
]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four random damages, one after the other."""
    for _ in range(rng.integers(1, 5)):
        a, b = sorted(rng.integers(0, len(data) + 1, 2).tolist())
        b = min(b, a + int(2 ** rng.uniform(0, 12)))
        weird = WEIRD[rng.integers(len(WEIRD))]
        flipped = bytearray(data)
        for at in rng.integers(0, max(len(data), 1), rng.integers(1, 9)).tolist() if data else ():
            flipped[at] ^= 1 << int(rng.integers(8))
        choices = (
            bytes(flipped),
            data[:a],  # cut end
            data[:a] + data[b:],  # block gone
            data[:b] + data[a:b] + data[b:],  # block twice
            data[:a] + rng.bytes(b - a) + data[a:],  # garbage inserted
            data[:a] + rng.bytes(b - a) + data[b:],  # garbage written over
            data[:a] + weird + data[a:],
            data[:a] + weird + data[a + len(weird) :],
        )
        data = choices[rng.integers(len(choices))]
    return data


@dataclasses.dataclass(frozen=True)
class Part:
    mass: float
    name: str = ""


@dataclasses.dataclass(frozen=True)
class Plane:
    name: str
    mass: float
    channels: int
    indoor: bool
    center: tuple[float, float, float]
    battery: Part
    parts: tuple[Part, ...] = ()
    note: str | None = None


TOML = b"""# an aircraft
name = "umx"
mass = 0.15
channels = 4
indoor = true
center = [0.1, 0, -0.2]
note = 'small'
[battery]
mass = 1.2e-2
[[parts]]
mass = 0.01
name = "wing"
[[parts]]
mass = 0.02
"""


def csv_seed() -> bytes:
    """A second of flight with a gap, an optional column, an unknown one and words."""
    rng = np.random.default_rng(1)
    lines = ["t,px,py,pz,roll,pitch,yaw,throttle,aileron,elevator,rudder,vx,battery,source"]
    for k in range(20):
        pose = ["nan"] * 6 if k == 7 else [f"{x:.4f}" for x in rng.uniform(-1, 1, 6)]
        sticks = [f"{x:.3f}" for x in rng.uniform(0, 1, 4)]
        lines.append(
            ",".join(
                [f"{k * 0.05:.3f}", *pose, *sticks, "7.0", "7.4", "marker" if k % 2 else "hybrid"]
            )
        )
    return "\n".join(lines).encode() + b"\n"


def mcap_seeds(folder) -> tuple[bytes, bytes]:
    """Ten frames as they stand in the file while flying, and packed."""
    pixels = np.random.default_rng(2).integers(0, 256, 100, dtype=np.uint8)
    with FlightLogWriter(folder / "a.mcap") as log:
        log.metadata({"aircraft": "umx"})
        for k in range(10):
            log.state(0.05 * k, State.from_vector(np.arange(9.0)), k)
            log.command(0.05 * k + 0.03, Command(0.5, 0.0, 0.1, 0.2, k), Image(k, 0.05 * k, pixels))
        log.event(0.5, "touchdown", {"where": [1.0, 2.0]})
        shutil.copy(folder / "a.mcap", folder / "b.mcap")
    return (folder / "b.mcap").read_bytes(), (folder / "a.mcap").read_bytes()


def fuzz(read: Callable[[], object], path, seed: bytes, first: int) -> Counter[str]:
    """Read FILES mutations of a seed; the outcomes, counted."""
    outcomes: Counter[str] = Counter()
    tracemalloc.start()
    try:
        for number in range(first, first + FILES):
            data = mutate(seed, np.random.default_rng(number))
            path.unlink(missing_ok=True)  # cutting an old file to zero waits for the disk
            path.write_bytes(data)
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            try:
                read()
                outcomes["read"] += 1
            except (InputError, FileNotFoundError) as error:
                sentence = str(error)
                assert len(sentence) < 2000 and "\n" not in sentence, (
                    f"mutation {number}: {sentence[:3000]}"
                )
                outcomes["refused"] += 1
            except Exception as error:
                raise AssertionError(
                    f"mutation {number} of {path.name} ends in {error!r}"
                ) from error
            peak = tracemalloc.get_traced_memory()[1] - before
            assert peak < BYTES_PER_FILE_BYTE * len(data) + BYTES_AT_LEAST, (
                f"mutation {number}: {peak} of {len(data)}"
            )
    finally:
        tracemalloc.stop()
    return outcomes


def check_both_happen(outcomes: Counter[str]) -> None:
    """A fuzz that only ever refuses, or only ever reads, tests nothing."""
    assert outcomes["read"] + outcomes["refused"] == FILES
    assert min(outcomes["read"], outcomes["refused"]) > FILES // 100, outcomes


def test_flight_tables(tmp_path):
    """CSV."""
    path = tmp_path / "a.csv"
    path.write_bytes(csv_seed())
    assert len(read_flight_table(path).t) == 20
    check_both_happen(fuzz(lambda: read_flight_table(path), path, csv_seed(), 0))


def test_configurations(tmp_path):
    """TOML into nested dataclasses."""
    path = tmp_path / "a.toml"
    path.write_bytes(TOML)
    assert from_toml(Plane, path).parts[1].mass == 0.02
    check_both_happen(fuzz(lambda: from_toml(Plane, path), path, TOML, 10_000))


@pytest.mark.parametrize("packed", [False, True])
def test_flight_logs(tmp_path, monkeypatch, packed):
    """MCAP as recorded and as packed: read, turned into a table, recovered; without waiting for the
    disk.
    """
    monkeypatch.setattr(os, "fsync", lambda file: None)
    seed = mcap_seeds(tmp_path)[packed]
    path, recovered = tmp_path / "c.mcap", tmp_path / "d.mcap"

    def read():
        log = read_flight_log(path)
        for _ in log.images():
            pass
        recovered.unlink(missing_ok=True)  # replacing an old file waits for the disk
        recover(path, recovered)
        return to_flight_table(log)

    path.write_bytes(seed)
    assert len(read().t) == 10
    check_both_happen(fuzz(read, path, seed, 20_000 + 10_000 * packed))
