"""Damaged files, and the doors that take files: the table of bad input."""

import contextlib
import gzip
import io
import os
import shutil
import signal
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from falconwing_kit.tools.cli.main import main

CALM = "falconwing_kit/data/case02_calm.csv"
HEADER = b"t,px,py,pz,roll,pitch,yaw,throttle,aileron,elevator,rudder\n"
HANG_S = 60


def _rows(count: int, value: str = "0") -> bytes:
    return HEADER + b"".join(
        f"{0.05 * k:.2f},{','.join([value] * 10)}\n".encode() for k in range(count)
    )


def _png(width: int, height: int) -> bytes:
    """A black PNG; its rows are compressed one by one, so that a huge one stays small."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    compress, row = zlib.compressobj(9), b"\0" * (1 + 3 * width)
    data = b"".join(compress.compress(row) for _ in range(height)) + compress.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    magic = b"\x89PNG\r\n\x1a\n"
    return magic + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def _zip(name: str, data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return buffer.getvalue()


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nend_header\n"
DAMAGED: dict[str, bytes] = {
    "empty": b"",
    "one_byte": b"\x00",
    "zeros": bytes(5000),
    "latin_1": "student,größe\né,ü\n".encode("latin-1"),
    "utf_16": "student\nA\n".encode("utf-16"),
    "bom_only": b"\xef\xbb\xbf",
    "line_of_blanks": b" " * 50_000,
    "one_quote": b'"' + b"x" * 2000,
    "nul_in_text": HEADER + b"0,\x00,0,0,0,0,0,0,0,0,0\n",
    "header_only": HEADER,
    "one_row": _rows(1),
    "all_zero": _rows(900),
    "all_nan": _rows(900, "nan"),
    "all_inf": _rows(900, "inf"),
    "huge_numbers": _rows(900, "1e308"),
    "words": _rows(40, "left"),
    "too_many_cells": HEADER + b"0," * 300 + b"\n",
    "nested_json": b"[" * 20_000,
    "json": b'{"a": [1, 2, {"b": null}]}',
    "json_nan": b'{"parameters": NaN}',
    "toml": b"mass_g = 150\n",
    "toml_negative": b"mass_g = -1\nwing_area_m2 = 0.1\nspan_m = 0.7\n",
    "toml_nan": b"mass_g = nan\nwing_area_m2 = 0.1\nspan_m = 0.7\n",
    "toml_cut": b"mass_g = ",
    "toml_deep": b"a = " + b"[" * 2000,
    "python": b"EFFECTS = 7\nTERMS = 7\n",
    "python_syntax": b"def (:\n",
    "mcap_magic": b"\x89MCAP0\r\n",
    "mcap_long_record": b"\x89MCAP0\r\n" + struct.pack("<BQ", 5, 2**62) + b"x" * 40,
    "gzip_cut": gzip.compress(bytes(9000))[:40],
    "gzip_bomb": gzip.compress(bytes(20_000_000)),
    "zip_slip": _zip("../../etc/x", b"y"),
    "zip_empty": _zip("a.txt", b""),
    "ply_huge": PLY % 4_000_000_000,
    "ply_negative": PLY % -5,
    "ply_no_end": b"ply\nformat ascii 1.0\n",
    "png_huge": _png(16_000, 16_000),
    "png_cut": _png(64, 64)[:60],
    "jpeg_cut": b"\xff\xd8\xff\xe0" + bytes(40),
    "safetensors": struct.pack("<Q", 2**40) + b"{}",
    "notebook": b'{"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}',
    "notebook_cells": b'{"cells": 3}',
}
# Doors: {} is the damaged file with this ending, OUT a new place.
SLOTS: dict[str, tuple[str, str]] = {
    "identify": ("identify {} --out OUT.toml", ".csv"),
    "identify --airframe": (f"identify {CALM} --airframe {{}}", ".toml"),
    "identify --start": (f"identify {CALM} --start {{}}", ".toml"),
    "identify --terms": (f"identify {CALM} --terms {{}}", ".py"),
    "identify --judge": (f"identify {CALM} --judge {{}}", ".csv"),
    "gap --flight": (f"gap --calm {CALM} --flight {{}} --out OUT", ".csv"),
    "gap --calm": (f"gap --calm {{}} --flight {CALM} --out OUT", ".csv"),
    "gap --effects": (f"gap --calm {CALM} --flight {CALM} --effects {{}} --out OUT", ".py"),
    "gap --model": (f"gap --calm {CALM} --flight {CALM} --model {{}} --out OUT", ".toml"),
    "gap --airframe": (f"gap --calm {CALM} --flight {CALM} --airframe {{}} --out OUT", ".toml"),
    "watch --model": (f"watch {CALM} --model {{}}", ".toml"),
    "export": ("export {} --out OUT.csv", ".mcap"),
    "export --to mcap": ("export {} --to mcap --out OUT.mcap", ".mcap"),
    "export --mapping": ("export {} --mapping {} --out OUT.csv", ".toml"),
    "replay": ("replay {} --headless --out OUT", ".mcap"),
    "poses log": ("poses {} --out OUT.csv", ".mcap"),
    "poses --camera": ("poses falconwing_kit/data/hall_clip --camera {} --out OUT.csv", ".json"),
    "poses --scene": ("poses falconwing_kit/data/hall_clip --scene {} --out OUT.csv", ".npz"),
    "scene info npz": ("scene info {}", ".npz"),
    "scene info ply": ("scene info {}", ".ply"),
    "scene info splat": ("scene info {}", ".splat"),
    "scene info spz": ("scene info {}", ".spz"),
    "scene info sog": ("scene info {}", ".sog"),
    "render": ("render {} --pose=0,0,1,0,0,0 --out OUT.png", ".ply"),
    "fly --model": ("fly --headless --no-render --model {}", ".toml"),
    "fly --bench": ("fly --headless --no-render --bench {}", ".toml"),
    "poses --bench": ("poses falconwing_kit/data/hall_clip --bench {} --out OUT.csv", ".toml"),
    "fly --start": ("fly --headless --no-render --start {}", ".csv"),
    "fly --scene": ("fly --headless --scene {}", ".npz"),
    "size --airframe": ("size --airframe {}", ".toml"),
    "size --parts": ("size --parts {}", ".csv"),
    "labs release --roster": (
        "labs release OUT lab12 --salt correct-horse-battery --roster {}",
        ".csv",
    ),
    "bridge --calibration": ("bridge --port sim-python --seconds 0.1 --calibration {}", ".toml"),
}
# What some doors may take: a table of zeros is a table, and so on.
FITTING = {
    ("scene info splat", "nested_json"),  # 20,000 bytes are 625 Gaussians of 32 bytes
    ("fly --start", "one_row"),
    ("fly --start", "all_zero"),
}
CASES = [(slot, name) for slot in SLOTS for name in DAMAGED if (slot, name) not in FITTING]


def write_damaged(folder: Path) -> dict[str, Path]:
    """Each damaged file, without an ending."""
    paths = {name: folder / "damaged" / name for name in DAMAGED}
    (folder / "damaged").mkdir()
    for name, path in paths.items():
        path.write_bytes(DAMAGED[name])
    return paths


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    """TimeoutError after HANG_S, where the system has alarms."""

    def ring(number: int, frame: object) -> None:
        raise TimeoutError("hangs")

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    old = signal.signal(signal.SIGALRM, ring)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)


def fault(slot: str, damaged: Path, folder: Path) -> str:
    """What is wrong with the answer of a door to a damaged file; empty if all is well."""
    command, ending = SLOTS[slot]
    given = folder / f"given{ending}"
    for old in (given, *folder.glob("out*")):
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
    os.link(damaged, given)
    words = [word.replace("{}", str(given)) for word in command.split()]
    words = [word.replace("OUT", str(folder / "out")) for word in words]
    heard, said = io.StringIO(), io.StringIO()
    try:
        with _alarm(), contextlib.redirect_stderr(heard), contextlib.redirect_stdout(said):
            code = main(words)
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    left = [path.name for path in folder.glob("out*") if path.is_file()]
    sentences = [line for line in heard.getvalue().splitlines() if line.startswith("falconwing: ")]
    if code != 2:
        return f"exit code {code}: {(said.getvalue() or heard.getvalue())[-200:]!r}"
    if "Traceback" in heard.getvalue() or len(sentences) != 1:
        return f"not one sentence: {heard.getvalue()[-300:]!r}"
    return f"left {left}" if left else ""
