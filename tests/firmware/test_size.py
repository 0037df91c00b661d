"""The firmware as a program: it fits the chip with room to spare, and a config.h that cannot work
does not compile.
"""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.firmware.chip import require_tools

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
FLASH, RAM = 16 * 1024, 2 * 1024  # bytes; the design allows no more of the chip's 256 KiB and 8 KiB


def build(out: Path, target: str, defines: str = "") -> subprocess.CompletedProcess[str]:
    """`make` in firmware/, into a folder of the test's."""
    require_tools()
    command = ["make", "-C", str(FIRMWARE), target, f"OUT={out}", f"DEFINES={defines}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)


@pytest.mark.parametrize(
    "defines", ["", "-DCHANNELS=8 -DSILENT_AFTER_MS=1000 -DPOLARITY=0 -DPILOT_SOURCE=0"]
)
def test_program_takes_less_than_16_kib_and_2_kib(tmp_path, defines):
    """Limits of the design; counted by avr-size. -Wall -Wextra -Werror: one warning of avr-g++ ends
    the build.
    """
    done = build(tmp_path, "size", defines)
    assert done.returncode == 0, done.stderr
    program, data = (int(n) for n in re.findall(r"(?:Program|Data): +(\d+) bytes", done.stdout))
    assert (
        4000 < program < FLASH
    )  # 4000: the Arduino core alone takes nearly so much, so less were not our program
    assert 300 < data < RAM  # 300: the core's buffers of two serial ports


@pytest.mark.parametrize(
    ("defines", "why"),
    [
        ("-DCHANNELS=3", "CHANNELS: 4 to 8"),
        ("-DCHANNELS=8 -DFRAME_US=19000", "the pause is under 4 ms"),  # 19 - 8 x 2 = 3 ms
        ("-DFRAME_US=24000", "the pause is over 19 ms"),  # 24 - 4 x 1 = 20 ms
        ("-DCHANNEL_MAX_US=2200", "CHANNEL_MAX_US <= VALID_MAX_US"),
        ("-DGAP_PULSE_US=900", "GAP_PULSE_US"),
        ("-DTHROTTLE_CHANNEL=4", "THROTTLE_CHANNEL"),
        ("-DTHROTTLE_CEILING_US=950", "below the idle throttle"),
        ("-DSAFE_SLOTS_US=1000,1500,2500,1500", "SAFE_SLOTS_US"),
        ("-DSILENT_AFTER_MS=100", "SILENT_AFTER_MS"),
    ],
)
def test_settings_that_cannot_work_do_not_compile(defines, why):
    """Each breaks one limit of config.h, worked out beside it; the compiler says which."""
    compiler = shutil.which("g++")
    if compiler is None:
        require_tools()
    command = [
        compiler,
        "-std=c++11",
        "-fsyntax-only",
        *defines.split(),
        "-x",
        "c++",
        FIRMWARE / "trainer_bridge/config.h",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert why in done.stderr


def test_arduino_ide_can_compile_the_sketch(tmp_path):
    """The IDE puts <Arduino.h> before the sketch and a prototype of every function before its first
    one.
    """
    require_tools()
    sketch = (FIRMWARE / "trainer_bridge/trainer_bridge.ino").read_text(encoding="utf-8")
    functions = re.findall(r"^((?:void|bool|uint16_t) \w+\([^)]*\)) \{", sketch, re.MULTILINE)
    assert {"void setup()", "void loop()"} < set(functions)
    head, tail = sketch.split("constexpr uint8_t PPM_OUT_PIN", 1)
    prototypes = "".join(f"{function};\n" for function in functions)
    source = f"#include <Arduino.h>\n{head}{prototypes}constexpr uint8_t PPM_OUT_PIN{tail}"
    (tmp_path / "sketch.cpp").write_text(source, encoding="utf-8")
    done = subprocess.run(
        ["make", "-n", "-B", "-C", FIRMWARE, "elf", f"OUT={tmp_path}"],
        capture_output=True,
        text=True,
        check=True,
    )
    line = next(
        line
        for line in done.stdout.splitlines()
        if "trainer_bridge.ino.o" in line and "-x c++" in line
    )
    options = [
        word for word in line.split() if word.startswith(("-m", "-O", "-D", "-W", "-f", "-std"))
    ]
    folders = [line.split()[i + 1] for i, word in enumerate(line.split()) if word == "-I"]
    includes = [f"-I{folder}" for folder in [*folders, FIRMWARE / "trainer_bridge"]]
    command = [
        "avr-g++",
        *options,
        *includes,
        "-c",
        tmp_path / "sketch.cpp",
        "-o",
        tmp_path / "sketch.o",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
