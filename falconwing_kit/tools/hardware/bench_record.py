"""Records of `falconwing doctor --bench`: a folder and a radio -> passed, or the missing step.

Nothing flies a real aircraft by itself before every step of the bench test was answered with yes,
with the calibration of the radio that is used now.
"""

import hashlib
import json
from collections.abc import Mapping
from datetime import date, datetime
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import read_text
from falconwing_kit.tools.hardware.checklists import Checklist
from falconwing_kit.trainer_port.ppm import Calibration

MAX_AGE_DAYS = 180  # as of a calibration
SIMULATED = ("sim", "sim-python")  # ports and cameras that are no hardware


def calibration_digest(calibration: Calibration) -> str:
    """Digest of a calibration: another one has another."""
    return hashlib.sha256(repr(calibration).encode()).hexdigest()[:16]


def require_bench_test(
    folder: Path, checklist: Checklist, calibration: Calibration, today: date | None = None
) -> Path:
    """The newest record of the bench test with a radio, if every step of it was passed.

    Args:
        folder: with the records, as `doctor --bench --out` writes them.
        checklist: the bench test, as it is now.
        calibration: of the radio.
        today: None is the current date.

    Raises:
        InputError: the radio was not calibrated, there is no record of it, or a step is missing;
            the message names it.
    """
    again = f"falconwing doctor --bench --port P --camera C --out {folder}"
    if not (calibration.radio and calibration.measured):
        raise InputError(
            "bench test: expected a calibration of your radio, got the kit's default; the first"
            " missing step is falconwing calibrate --port P --radio NAME"
        )
    found = [
        (path, record)
        for path, record in _records(folder, checklist)
        if record.get("radio") == calibration.radio
    ]
    if not found:
        raise InputError(
            f"bench test: expected one on record for {calibration.radio} in {folder}, found none;"
            f" the missing step is {again}"
        )
    path, record = max(found, key=lambda each: each[1]["date"])
    fault = _fault(record, checklist, calibration, today or date.today())
    if fault:
        raise InputError(f"bench test of {calibration.radio} ({path.name}): {fault}; then {again}")
    return path


def _records(folder: Path, checklist: Checklist) -> list[tuple[Path, dict[str, Any]]]:
    """The records of this checklist in a folder; one that cannot be read is refused."""
    found = []
    for path in sorted(folder.glob("checklist_*.json")):
        try:
            record = json.loads(read_text(path))
            datetime.fromisoformat(record["date"])
            if record["list"] == checklist.title:
                found.append((path, record))
        except (ValueError, TypeError, KeyError, RecursionError):
            raise InputError(
                f"{path}: expected a record of falconwing doctor, got something else; move it away"
            ) from None
    return found


def _fault(
    record: Mapping[str, Any], checklist: Checklist, calibration: Calibration, today: date
) -> str:
    """What is missing in a record; empty for nothing."""
    for device in ("port", "camera"):
        if record.get(device) in SIMULATED:
            return f"expected your own {device}, got a SIMULATED one"
    steps = record.get("steps")
    results = {
        step.get("id"): step.get("result")
        for step in (steps if isinstance(steps, list) else [])
        if isinstance(step, dict)
    }
    for step in checklist.steps:
        result = results.get(step.id, "not done")
        if result != "yes":
            return f"expected yes at every step, got {result!r} at step {step.id}: {step.do}"
    printed = record.get("print_check")
    if isinstance(printed, dict) and printed.get("result") != "yes":
        return f"expected prints at true size, got a check line of {printed.get('seen')}"
    if record.get("calibration") != calibration_digest(calibration):
        return "expected it after the last falconwing calibrate, got another calibration"
    age = (today - datetime.fromisoformat(record["date"]).date()).days
    if not 0 <= age <= MAX_AGE_DAYS:
        return f"expected it within the last {MAX_AGE_DAYS} days, got one {age} days old"
    return ""
