"""`falconwing doctor --bench` and `--preflight`: a checklist -> answers or checks -> a record."""

import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.tools.hardware.checklists import Checklist, Step

if TYPE_CHECKING:
    from falconwing_kit.core.messages import Command
    from falconwing_kit.tools.devices.grabber import Camera

Result = Literal["yes", "NO", "skipped", "not done"]
ANSWERS: dict[str, Result] = {
    "y": "yes",
    "n": "NO",
    "s": "skipped",
    "skip": "skipped",
    "yes": "yes",
    "no": "NO",
}
OBSERVE_S = 2.0  # duration of the check of a board or a camera
FIRST_IMAGE_S = 5.0  # maximum time to a camera's first image
MIN_RATE_HZ = 15.0  # of the paper's 20; as stated in the checklists
IDLE, CENTRED = 0.05, 0.10  # maximum throttle, maximum deflection of the other sticks


@dataclass(frozen=True)
class ChecklistDevices:
    """Devices of the automatic steps; "" for none."""

    port: str = ""  # serial port of the board; sim is a SIMULATED one
    camera: str = ""  # number, path or video file; sim is a SIMULATED one


@dataclass(frozen=True)
class StepOutcome:
    """Result of one step."""

    id: str
    result: Result
    by: Literal["person", "computer", ""]
    seen: str


class MissingDeviceError(Exception):
    """An automatic step has no device to check."""


def walk(
    checklist: Checklist,
    devices: ChecklistDevices,
    out: Path | None = None,
    as_json: bool = False,
    asks_print: bool = False,
    print_mm: float | None = None,
) -> int:
    """Work through a checklist: at a terminal ask for every step, else run the automatic ones.

    Args:
        out: folder for a dated record; None writes none.
        as_json: print the outcomes as JSON instead of tables.
        asks_print: ask for the check line of the builder's own prints too.
        print_mm: its measured length [mm]; None asks for it at a terminal.

    Returns:
        1 if a step failed or the checklist ended early, else 0.

    Raises:
        InputError: the record cannot be written.
    """
    asked = sys.stdin is not None and sys.stdin.isatty()
    start = datetime.now()
    print(f"{checklist.title}{'; y yes, n no, s skip' if asked else ''}", file=sys.stderr)
    outcomes: list[StepOutcome] = []
    for number, step in enumerate(checklist.asked, 1):
        heading = f"\n{number}/{len(checklist.steps)} {step.do}\n    see: {step.see}"
        print(heading, file=sys.stderr)
        outcome = _run_automatic(step, devices) if step.automatic else None
        # a step without its device is left to the person
        if outcome is None or (asked and outcome.result == "skipped"):
            outcome = _ask(step, asked)
        outcomes.append(outcome)
        if outcomes[-1].result == "NO":
            print(f"    so: {step.if_not}", file=sys.stderr)
            if step.stop:
                break
    stopped = outcomes[-1].result == "NO" and checklist.asked[len(outcomes) - 1].stop
    for number, step in enumerate(checklist.steps, 1):
        if step.spoken and not stopped:
            text = f"aloud, after this program has ended: {step.do}\n    see: {step.see}"
            print(f"\n{number}/{len(checklist.steps)} {text}", file=sys.stderr)
            print(f"    if not: {step.if_not}", file=sys.stderr)
    printed = None
    if asks_print and (print_mm is not None or not stopped):
        printed = _check_print(print_mm, asked)
    done = {outcome.id for outcome in outcomes}
    outcomes += [
        StepOutcome(step.id, "not done", "", "") for step in checklist.asked if step.id not in done
    ]
    failed = any(o.result == "NO" or (asked and o.result == "not done") for o in outcomes)
    failed |= printed is not None and printed.result == "NO"
    record = {
        "list": checklist.title,
        "date": start.isoformat(timespec="seconds"),
        **asdict(devices),
    }
    record |= _radio(devices.port)
    record |= {"complete": all(o.result == "yes" for o in outcomes), "failed": failed}
    record |= {"steps": [asdict(outcome) for outcome in outcomes]}
    if printed is not None:
        record["print_check"] = asdict(printed)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        with atomic_write(out / f"checklist_{start:%Y%m%d_%H%M%S}.json", text=True) as file:
            file.write(json.dumps(record, indent=2) + "\n")
    if as_json:
        print_json(record)
    else:
        _show(checklist, outcomes, asked, failed, printed)
    return int(failed)


def _check_print(length_mm: float | None, asked: bool) -> StepOutcome | None:
    """The scale of the builder's own prints by the length of a check line; None without one.

    Raises:
        InputError: the length given by an option is none.
    """
    from falconwing_kit.tools.hardware.prints import CHECK_MM, print_scale_fault

    question = f"\n    print check length measured [mm of {CHECK_MM:g}; Enter without a print] "
    while length_mm is None and asked:
        print(question, end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line.strip():
            return None
        try:
            length_mm = float(line.strip().removesuffix("mm").replace(",", "."))
            print_scale_fault(length_mm)
        except ValueError as error:  # InputError is one
            print(f"    expected a length in millimetres such as 99.8: {error}", file=sys.stderr)
            length_mm = None
    if length_mm is None:
        return None
    fault = print_scale_fault(length_mm)
    if fault:
        print(f"    NO: {fault}", file=sys.stderr)
    return StepOutcome(
        "print_scale", "NO" if fault else "yes", "person", f"{length_mm:g} of {CHECK_MM:g} mm"
    )


def _radio(port: str) -> dict[str, str]:
    """The radio that the list was worked through with, and a digest of its calibration."""
    from falconwing_kit.tools.cli.calibrate import choose_calibration
    from falconwing_kit.tools.hardware.bench_record import calibration_digest

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the automatic steps have said it
            calibration = choose_calibration(port)
    except (InputError, FileNotFoundError):  # a stale one: the automatic steps have failed by it
        return {"radio": "", "calibration": ""}
    return {"radio": calibration.radio, "calibration": calibration_digest(calibration)}


def _show(
    checklist: Checklist,
    outcomes: list[StepOutcome],
    asked: bool,
    failed: bool,
    printed: StepOutcome | None,
) -> None:
    rows = [*outcomes, *([] if printed is None else [printed])]
    print_table(
        ("step", "result", "by", "measured"), [(o.id, o.result, o.by, o.seen) for o in rows]
    )
    bad = next(
        (step for step, o in zip(checklist.asked, outcomes, strict=True) if o.result == "NO"), None
    )
    if bad is not None:
        next_line(bad.if_not)
    elif printed is not None and printed.result == "NO":
        next_line("print again at 100 % (actual size, no fit to page), and measure again")
    elif not asked:
        next_line("run this at a terminal, which then asks for every step")
    else:
        next_line(
            "start again from the first step"
            if failed
            else f"start the flight's program if it has one, then item {len(checklist.steps)} aloud"
            if checklist.steps[-1].spoken
            else "keep the record with your flight logs (--out DIR)"
        )


def _ask(step: Step, asked: bool) -> StepOutcome:
    """The person's answer; "not done" without a terminal or at the end of the input."""
    while asked:
        print("    [y/n/s] ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            break
        if line.strip().lower() in ANSWERS:
            return StepOutcome(step.id, ANSWERS[line.strip().lower()], "person", "")
    return StepOutcome(step.id, "not done", "", "")


def _run_automatic(step: Step, devices: ChecklistDevices) -> StepOutcome:
    """Run an automatic step; any error is a NO."""
    try:
        outcome = StepOutcome(step.id, "yes", "computer", AUTOMATIC[step.automatic](devices))
    except MissingDeviceError as reason:
        outcome = StepOutcome(step.id, "skipped", "computer", str(reason))
    except Exception as error:  # any error is the result
        outcome = StepOutcome(
            step.id, "NO", "computer", (str(error).splitlines() or [type(error).__name__])[0]
        )
    print(f"    {outcome.result}: {outcome.seen}", file=sys.stderr)
    return outcome


def _board(devices: ChecklistDevices) -> str:
    """The board stays in SAFE, idle and centred, without a restart, while not engaged."""
    from falconwing_kit.tools.cli.board_status import POLL_S, open_ready_port

    if not devices.port:
        raise MissingDeviceError("no board given (--port)")
    with open_ready_port(devices.port, None) as port:
        first, end = port.status, port.now() + OBSERVE_S
        while port.now() < end:
            port.poll()
            time.sleep(POLL_S)
        status = port.status
        if port.state != "open" or status is None or first is None:
            raise InputError(
                f"expected a board that keeps answering, got a port that is {port.state}"
            )
        if (
            status.state != "SAFE"
            or status.fault != "none"
            or status.boot_count != first.boot_count
        ):
            boots = status.boot_count - first.boot_count
            raise InputError(
                f"expected SAFE and no restart, got {status.state}, fault {status.fault}, "
                f"{boots} restarts"
            )
        _require_idle(port.calibration.command(status.channels_us))
        channels = " ".join(map(str, status.channels_us))
        return f"{port.what}: {status.state}, {channels} us, boots {status.boot_count}"


def _sticks(devices: ChecklistDevices) -> str:
    """The pilot's sticks arrive at the board's input, idle and centred."""
    from falconwing_kit.core.messages import Command
    from falconwing_kit.tools.cli.board_status import POLL_S, open_ready_port, pilot_sticks

    if not devices.port:
        raise MissingDeviceError("no board given (--port)")
    with open_ready_port(devices.port, None) as port:
        if port.simulation is not None:
            with port.simulation.pause() as board:
                board.set_pilot(port.calibration.channels_us(Command(0.0, 0.0, 0.0, 0.0)))
        end = port.now() + OBSERVE_S
        while port.now() < end:
            port.poll()
            time.sleep(POLL_S)
        sticks = pilot_sticks(port)
        if not sticks:
            raise InputError("expected the pilot's sticks at the board's input, got none")
        throttle, aileron, elevator, rudder = sticks
        _require_idle(Command(throttle, aileron, elevator, rudder))
        return " ".join(f"{position:+.2f}" for position in sticks)


def _picture(devices: ChecklistDevices) -> str:
    """Images come fast enough and the frame monitor raises no alarm."""
    from falconwing_kit.tools.devices.cameras import open_camera
    from falconwing_kit.tools.devices.grabber import Grabber
    from falconwing_kit.vision.monitor import FrameMonitor

    if not devices.camera:
        raise MissingDeviceError("no camera given (--camera)")
    camera = _simulated_camera() if devices.camera == "sim" else open_camera(devices.camera)
    monitor, alerts = FrameMonitor(), set()
    with Grabber(camera) as images:
        if not images.wait(1, FIRST_IMAGE_S):
            raise InputError(
                f"camera {devices.camera}: expected an image, got none; {images.health.trouble}"
            )
        received, start = images.health.received, time.perf_counter()
        while (t := time.perf_counter() - start) < OBSERVE_S:
            alerts.add(monitor.update(images.next_image(t), t).reason)
            time.sleep(0.02)
        rate = (images.health.received - received) / t
    alarms = ", ".join(sorted(alerts - {""}))
    if alarms or rate < MIN_RATE_HZ:
        raise InputError(
            f"expected {MIN_RATE_HZ:g} images per second and no alarm, got {rate:.1f}, "
            f"{alarms or 'no alarm'}"
        )
    source = "SIMULATED camera: " if devices.camera == "sim" else ""
    return f"{source}{rate:.1f} images per second, no alarm"


def _simulated_camera() -> "Camera":
    from falconwing_kit.tools.devices.cameras import FakeCamera

    return FakeCamera()


def _require_idle(sticks: "Command") -> None:
    throttle, *others = sticks.vector.tolist()
    if throttle > IDLE or max(map(abs, others)) > CENTRED:
        got = " ".join(f"{position:+.2f}" for position in (throttle, *others))
        raise InputError(f"expected throttle idle and the other sticks centred, got {got}")


AUTOMATIC: dict[str, Callable[[ChecklistDevices], str]] = {
    "board": _board,
    "sticks": _sticks,
    "picture": _picture,
}
