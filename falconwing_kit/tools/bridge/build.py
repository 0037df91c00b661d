"""Firmware builder: the sources in firmware/ -> the chip's program and the simulator, cached.

The system's tools build on demand; products are cached under the digest of their sources, so only a
changed firmware is rebuilt.
"""

import hashlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, cache_folder, shipped_path
from falconwing_kit.tools.linux import require_linux

SKETCH = "trainer_bridge"
TOOLS = {  # Debian package -> a program or a file in it
    "make": "make",
    "gcc": "gcc",
    "gcc-avr": "avr-g++",
    "avr-libc": "/usr/lib/avr/include/avr/io.h",
    "arduino-core-avr": "/usr/share/arduino/hardware/arduino/avr/cores/arduino/Arduino.h",
    "libsimavr-dev": "/usr/include/simavr/sim_avr.h",
}
KEEP_DAYS = 30.0  # older products are deleted
Builder = Callable[[Path, Path], None]  # (copy of the sources, path of the product)


def missing_tools() -> list[str]:
    """The Debian packages for a simulated board that are missing here; empty if none."""
    return [
        package
        for package, content in TOOLS.items()
        if not (shutil.which(content) or Path(content).is_file())
    ]


def firmware_folder() -> Path:
    """The folder of the firmware's sources, in the checkout or in the installation.

    Raises:
        FileNotFoundError: they are in neither place.
    """
    sketch = shipped_path(f"firmware/{SKETCH}/{SKETCH}.ino", "install the kit from a checkout")
    return sketch.parents[1]


def build_firmware(defines: Sequence[str] = (), replace: Path | None = None) -> Path:
    """The program for the board's ATmega2560, as flashed.

    Args:
        defines: changed settings of config.h, such as "CHANNELS=8".
        replace: a folder with replacements for files of the sketch, for experiments.

    Returns:
        Path of the ELF file.

    Raises:
        InputError: a tool is missing, the compiler refused, or the cache folder cannot be written.
    """
    flags = " ".join(f"-D{define}" for define in defines)

    def build(sources: Path, product: Path) -> None:
        if replace is not None:
            shutil.copytree(replace, sources / SKETCH, dirs_exist_ok=True)
        _run(["make", "-C", str(sources), "elf", f"OUT={product.parent}", f"DEFINES={flags}"])

    return _build_cached(f"{SKETCH}.elf", build, flags, replace)


def build_simulator() -> Path:
    """The library that simulates an ATmega2560 (firmware/sim/simavr_shim.c with libsimavr).

    Raises:
        InputError: a tool is missing, the compiler refused, or the cache folder cannot be written.
    """

    def build(sources: Path, product: Path) -> None:
        source = sources / "sim" / "simavr_shim.c"
        include = Path(TOOLS["libsimavr-dev"]).parent
        options = f"-std=gnu11 -O2 -Wall -Wextra -Werror -shared -fPIC -I{include}".split()
        _run(["gcc", *options, str(source), "-o", str(product), "-lsimavr"])

    return _build_cached("simavr_shim.so", build)


def _build_cached(name: str, build: Builder, flags: str = "", replace: Path | None = None) -> Path:
    """Path of the product in the cache, built if necessary."""
    require_linux("firmware", f"apt install {' '.join(TOOLS)}; or use --port sim-python")
    missing = missing_tools()
    if missing:
        raise InputError(
            f"firmware: expected the Debian packages {' '.join(TOOLS)} to build it, "
            f"{' '.join(missing)} not found; install with: sudo apt install {' '.join(missing)}"
        )
    source = firmware_folder()
    digest = _digest([source, replace] if replace else [source], flags)
    cached = cache_folder() / f"{Path(name).stem}-{digest}{Path(name).suffix}"
    if cached.is_file():
        return cached
    with tempfile.TemporaryDirectory(prefix="falconwing-") as folder:
        sources = Path(
            shutil.copytree(
                source, Path(folder) / "firmware", ignore=shutil.ignore_patterns("build")
            )
        )
        product = Path(folder) / "out" / name
        product.parent.mkdir()
        build(sources, product)
        _store_product(product, cached)
    return cached


def _digest(folders: Sequence[Path], flags: str) -> str:
    """12 hexadecimal digits for the flags and all files except texts and products."""
    digest = hashlib.sha256(flags.encode())
    for folder in folders:
        for path in sorted(
            path for path in folder.rglob("*") if path.is_file() and path.suffix != ".md"
        ):
            name = path.relative_to(folder)
            if "build" not in name.parts:
                digest.update(
                    f"{name.as_posix()}\0{path.stat().st_size}\0".encode() + path.read_bytes()
                )
    return digest.hexdigest()[:12]


def _run(command: Sequence[str]) -> None:
    """Run a build step; the compiler's first error becomes the message."""
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        first = next((line for line in lines if "error" in line.lower()), lines[-1])
        raise InputError(
            f"firmware: expected a clean build, got from {command[0]}: {first.strip()}; "
            "correct the source"
        )


def _store_product(product: Path, cached: Path) -> None:
    """Copy a product into the cache, and delete old ones of its kind."""
    try:
        cached.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{cached.parent}: expected a folder to keep what is built, got: {error.strerror}; "
            "set XDG_CACHE_HOME to a folder that you may write"
        ) from None
    with atomic_write(cached) as file:
        file.write(product.read_bytes())
    oldest = time.time() - KEEP_DAYS * 86400.0
    for path in cached.parent.glob(f"{product.stem}-*{product.suffix}"):
        with suppress(OSError):
            if path.stat().st_mtime < oldest:
                path.unlink()
