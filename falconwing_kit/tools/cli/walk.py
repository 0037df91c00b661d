"""falconwing doctor --bench, --preflight: a checklist -> asked at the terminal or tried by itself
-> a dated record.
"""

import json
import sys
import time
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
WATCH_S = 2.0  # for which a board or a camera is looked at
FIRST_PICTURE_S = 5.0  # that a camera may take to begin
LEAST_RATE_HZ = 15.0  # of the paper's 20; what the lists promise
IDLE, MIDDLE = 0.05, 0.10  # how far a stick may be off and still count as idle or centred


@dataclass(frozen=True)
class WalkDevices:
    """What the automatic steps may use; "" where there is none."""

    port: str = ""  # serial port of the board; sim is a SIMULATED one
    camera: str = ""  # number, path or video file; sim is a SIMULATED one


@dataclass(frozen=True)
class StepOutcome:
    """What came of one step."""

    id: str
    result: Result
    by: Literal["person", "computer", ""]
    seen: str


class MissingDeviceError(Exception):
    """An automatic step has nothing to work with."""


def walk(
    checklist: Checklist, tools: WalkDevices, out: Path | None = None, as_json: bool = False
) -> int:
    """Go through a list: ask where somebody sits at the terminal, else print it and do what is
    automatic.

    Args:
        checklist: what to do.
        tools: of the automatic steps.
        out: folder for a dated record; None writes none.
        as_json: print the outcomes as JSON instead of tables.

    Returns:
        1 where a step failed or the walk ended early, else 0.

    Raises:
        InputError: the record cannot be written.
    """
    asked, began = sys.stdin is not None and sys.stdin.isatty(), datetime.now()
    print(f"{checklist.title}{'; y yes, n no, s skip' if asked else ''}", file=sys.stderr)
    outcomes: list[StepOutcome] = []
    for number, step in enumerate(checklist.steps, 1):
        print(f"\n{number}/{len(checklist.steps)} {step.do}\n    see: {step.see}", file=sys.stderr)
        outcome = _try(step, tools) if step.automatic else None
        if outcome is None or (
            asked and outcome.result == "skipped"
        ):  # without a tool it is the person's to see
            outcome = _ask(step, asked)
        outcomes.append(outcome)
        if outcomes[-1].result == "NO":
            print(f"    so: {step.if_not}", file=sys.stderr)
            if step.stop:
                break
    done = {outcome.id for outcome in outcomes}
    outcomes += [
        StepOutcome(step.id, "not done", "", "") for step in checklist.steps if step.id not in done
    ]
    failed = any(o.result == "NO" or (asked and o.result == "not done") for o in outcomes)
    record = {"list": checklist.title, "date": began.isoformat(timespec="seconds"), **asdict(tools)}
    record |= {"complete": all(o.result == "yes" for o in outcomes), "failed": failed}
    record |= {"steps": [asdict(outcome) for outcome in outcomes]}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        with atomic_write(out / f"checklist_{began:%Y%m%d_%H%M%S}.json", text=True) as file:
            file.write(json.dumps(record, indent=2) + "\n")
    if as_json:
        print_json(record)
    else:
        _show(checklist, outcomes, asked, failed)
    return int(failed)


def _show(checklist: Checklist, outcomes: list[StepOutcome], asked: bool, failed: bool) -> None:
    print_table(
        ("step", "result", "by", "seen"), [(o.id, o.result, o.by, o.seen) for o in outcomes]
    )
    bad = next(
        (step for step, o in zip(checklist.steps, outcomes, strict=True) if o.result == "NO"), None
    )
    if bad is not None:
        next_line(bad.if_not)
    elif not asked:
        next_line("type this at a terminal, which then asks for every step")
    else:
        next_line(
            "start again from the first step"
            if failed
            else "put the record beside your flight logs (--out DIR)"
        )


def _ask(step: Step, asked: bool) -> StepOutcome:
    """A person's answer; "not done" where nobody is there or the input ends."""
    while asked:
        print("    [y/n/s] ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            break
        if line.strip().lower() in ANSWERS:
            return StepOutcome(step.id, ANSWERS[line.strip().lower()], "person", "")
    return StepOutcome(step.id, "not done", "", "")


def _try(step: Step, tools: WalkDevices) -> StepOutcome:
    """What the computer sees; anything that breaks is a no."""
    try:
        outcome = StepOutcome(step.id, "yes", "computer", AUTOMATIC[step.automatic](tools))
    except MissingDeviceError as reason:
        outcome = StepOutcome(step.id, "skipped", "computer", str(reason))
    except Exception as error:  # whatever breaks here is what was seen
        outcome = StepOutcome(
            step.id, "NO", "computer", (str(error).splitlines() or [type(error).__name__])[0]
        )
    print(f"    {outcome.result}: {outcome.seen}", file=sys.stderr)
    return outcome


def _board(tools: WalkDevices) -> str:
    """The board stays in SAFE, idle and centred, and does not restart, while nobody engages it."""
    from falconwing_kit.tools.cli.bridge import LOOK_S, open_ready_port

    if not tools.port:
        raise MissingDeviceError("no board given (--port)")
    with open_ready_port(tools.port, None) as port:
        first, end = port.status, port.now() + WATCH_S
        while port.now() < end:
            port.poll()
            time.sleep(LOOK_S)
        status = port.status
        if port.state != "open" or status is None or first is None:
            raise InputError(f"expected a board that goes on answering, the port is {port.state}")
        if (
            status.state != "SAFE"
            or status.fault != "none"
            or status.boot_count != first.boot_count
        ):
            boots = status.boot_count - first.boot_count
            raise InputError(
                f"expected SAFE and no restart, got {status.state}, fault {status.fault}, {boots} restarts"
            )
        _require_idle(port.calibration.command(status.channels_us))
        return f"{port.what}: {status.state}, {' '.join(map(str, status.channels_us))} us, boots {status.boot_count}"


def _sticks(tools: WalkDevices) -> str:
    """The pilot's sticks reach the board, at idle and centred."""
    from falconwing_kit.core.messages import Command
    from falconwing_kit.tools.cli.bridge import LOOK_S, open_ready_port, pilot_sticks

    if not tools.port:
        raise MissingDeviceError("no board given (--port)")
    with open_ready_port(tools.port, None) as port:
        if port.simulation is not None:
            with port.simulation.pause() as board:
                board.set_pilot(port.calibration.channels_us(Command(0.0, 0.0, 0.0, 0.0)))
        end = port.now() + WATCH_S
        while port.now() < end:
            port.poll()
            time.sleep(LOOK_S)
        sticks = pilot_sticks(port)
        if not sticks:
            raise InputError("expected the pilot's sticks at the board's input, got none")
        throttle, aileron, elevator, rudder = sticks
        _require_idle(Command(throttle, aileron, elevator, rudder))
        return " ".join(f"{position:+.2f}" for position in sticks)


def _picture(tools: WalkDevices) -> str:
    """Pictures come fast enough and the frame monitor keeps still."""
    from falconwing_kit.tools.devices.cameras import open_camera
    from falconwing_kit.tools.devices.grabber import Grabber
    from falconwing_kit.vision.monitor import FrameMonitor

    if not tools.camera:
        raise MissingDeviceError("no camera given (--camera)")
    camera = _simulated_camera() if tools.camera == "sim" else open_camera(tools.camera)
    monitor, alerts = FrameMonitor(), set()
    with Grabber(camera) as images:
        if not images.wait(1, FIRST_PICTURE_S):
            raise InputError(
                f"camera {tools.camera}: expected a picture, got none; {images.health.trouble}"
            )
        begun, start = images.health.received, time.perf_counter()
        while (t := time.perf_counter() - start) < WATCH_S:
            alerts.add(monitor.update(images.next_image(t), t).reason)
            time.sleep(0.02)
        rate = (images.health.received - begun) / t
    told = ", ".join(sorted(alerts - {""}))
    if told or rate < LEAST_RATE_HZ:
        raise InputError(
            f"expected {LEAST_RATE_HZ:g} pictures a second and no alarm, got {rate:.1f}, {told or 'no alarm'}"
        )
    return f"{'SIMULATED camera: ' if tools.camera == 'sim' else ''}{rate:.1f} pictures a second, no alarm"


def _simulated_camera() -> "Camera":
    from falconwing_kit.tools.devices.cameras import FakeCamera

    return FakeCamera()


def _require_idle(sticks: "Command") -> None:
    throttle, *others = sticks.vector.tolist()
    if throttle > IDLE or max(map(abs, others)) > MIDDLE:
        got = " ".join(f"{position:+.2f}" for position in (throttle, *others))
        raise InputError(f"expected throttle idle and the other sticks in the middle, got {got}")


AUTOMATIC: dict[str, Callable[[WalkDevices], str]] = {
    "board": _board,
    "sticks": _sticks,
    "picture": _picture,
}
