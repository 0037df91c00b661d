"""falconwing bridge: monitor the board: state, counters, delay, pilot's sticks."""

import math
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.messages import Command
from falconwing_kit.tools.bridge.open_port import PORTS
from falconwing_kit.tools.cli.board_status import (
    MAX_S,
    POLL_S,
    StatusLine,
    open_ready_port,
    port_record,
)
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.port import TrainerPort

PERIOD_S = 0.05  # between two commands of --move-sticks and --turn-motor
CONFIRMATION = "propeller off"  # typed before --turn-motor sends anything
MOTOR_THROTTLE = 0.2  # of its pulse; 1200 us where the calibration has 1000 to 2000
MOTOR_WAIT_S = 3.0  # from the engagement to the pulse, throttle idle
MOTOR_PULSE_S = 2.0  # length of the pulse
MOTOR_ENGAGE_S = 15.0  # maximum time to the engagement


@dataclass(frozen=True)
class Bridge:
    """Show the board's state, counters, delay and the pilot's sticks. Commands are sent only with
    --ros, --move-sticks or --turn-motor.

    Ctrl-C ends it and returns control to the pilot. Exit code 0 if the board answered until the
    end, else 1.
    """

    port: str
    """serial port of the trainer bridge; sim is the firmware in a simulated chip, sim-python a
    board simulated in Python
    """
    seconds: float = 0.0
    """duration; 0 is until Ctrl-C"""
    calibration: Path | None = None
    """file of falconwing calibrate; without it ./trainer_port.toml, or the kit's default"""
    radio: str = ""
    """refuse a calibration of another radio"""
    ros: bool = False
    """relay commands from ROS to the board, and its status and the pilot's sticks to ROS"""
    move_sticks: bool = False
    """engage, and move aileron, elevator and rudder slowly with the throttle idle: for the bench,
    propeller off
    """
    turn_motor: bool = False
    """engage with the throttle idle and open it to 20 % once, for 2 s: for the bench, to see
    whether the radio's throttle cut acts on the computer. Asks at the terminal whether the
    propeller is off, and ends by itself
    """
    without_camera: bool = False
    """with --ros: the controller flies without images, such as by motion capture; otherwise a
    command that names no image, or one older than --max-image-age, hands back
    """
    max_image_age: float = 0.4
    """with --ros: maximum age of the image behind a command [s]"""
    battery_s: float = math.inf
    """with --ros: hand back so long after the first engaged command [s]"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Monitor until the time is up or Ctrl-C.

        Returns:
            0 if the board answered until the end, and with --turn-motor if the pulse was sent; else
            1.

        Raises:
            InputError: the port cannot be opened, no board answers, the calibration does not fit,
                or the propeller was not confirmed to be off.
        """
        require_range("--seconds", self.seconds, low=0.0, high=MAX_S)
        if self.ros + self.move_sticks + self.turn_motor > 1:
            raise InputError(
                "expected one source of commands, got two of --ros, --move-sticks, --turn-motor; "
                "leave one out"
            )
        if self.turn_motor:
            _require_confirmation(self.port)
        sent = True
        with open_ready_port(self.port, self.calibration, self.radio) as port:
            # A moving stick of the pilot takes over, a SIMULATED pilot's too.
            sends = self.ros or self.move_sticks or self.turn_motor
            line = StatusLine(port, self.seconds, moves=not sends)
            with suppress(KeyboardInterrupt):
                if self.ros:
                    self._relay(port, line)
                elif self.turn_motor:
                    sent = False  # if Ctrl-C ends it
                    sent = self._turn_motor(port, line)
                else:
                    self._monitor(port, line)
            line.end()
            answered, record = port.state == "open", port_record(port)
        if self.json:
            print_json(record)
        else:
            rows = [
                (name.replace("_", " "), ", ".join(map(str, v)) if isinstance(v, list) else v)
                for name, v in record.items()
            ]
            print_table(("what", "value"), rows)
            next_line(f"falconwing record --port {self.port} --out recordings")
        return 0 if answered and sent else 1

    def _monitor(self, port: TrainerPort, line: StatusLine) -> None:
        """Poll the board and, with --move-sticks, send commands at 20 Hz.

        The board engages near the pilot's sticks, or with ours in the middle: they move from then.
        """
        start, sent, still = time.perf_counter(), 0, 0.0
        while not line.is_over():
            t = time.perf_counter() - start
            if self.move_sticks and t >= PERIOD_S * sent:
                still = still if port.engagement == "engaged" else t
                aileron, elevator, rudder = (
                    0.3 * math.sin(2.0 * math.pi * f * (t - still)) for f in (0.2, 0.3, 0.5)
                )
                port.send(Command(0.0, aileron, elevator, rudder), engage=True)
                sent = int(t / PERIOD_S) + 1
            port.poll()
            time.sleep(POLL_S)

    def _turn_motor(self, port: TrainerPort, line: StatusLine) -> bool:
        """Engage at idle, wait, open the throttle once, idle again; whether it came to its end.

        A take-over by the pilot, a silent board, or an engagement that does not come ends it.
        """
        start, sent, engaged = time.perf_counter(), 0, math.nan
        while not line.is_over():
            t = time.perf_counter() - start
            if math.isnan(engaged) and port.engagement == "engaged":
                engaged = t
                print(f"\nengaged: the throttle opens in {MOTOR_WAIT_S:g} s", file=sys.stderr)
            since = t - engaged  # nan before the engagement: every comparison below is False
            if since >= MOTOR_WAIT_S + MOTOR_PULSE_S:
                return True
            if math.isnan(engaged) and t > MOTOR_ENGAGE_S:
                line.alert(f"the board did not engage: {port.mismatch() or port.state}")
                return False
            if since > 0.0 and port.engagement != "engaged":
                line.alert("the board handed back before the end of the pulse")
                return False
            if t >= PERIOD_S * sent:
                throttle = MOTOR_THROTTLE if since >= MOTOR_WAIT_S else 0.0
                port.send(Command(throttle, 0.0, 0.0, 0.0), engage=True)
                sent = int(t / PERIOD_S) + 1
            port.poll()
            time.sleep(POLL_S)
        return False

    def _relay(self, port: TrainerPort, line: StatusLine) -> None:
        from falconwing_kit.flight.supervisor import Supervisor, SupervisorSettings
        from falconwing_kit.tools.bridge.bus import relay
        from falconwing_kit.tools.bridge.ros import RosBus
        from falconwing_kit.vision.monitor import FrameMonitor

        settings = SupervisorSettings(max_image_age_s=self.max_image_age, battery_s=self.battery_s)

        def supervise() -> Supervisor:
            monitor = None if self.without_camera else FrameMonitor()
            return Supervisor(settings, by_images=not self.without_camera, monitor=monitor)

        bus = RosBus()
        try:
            relay(
                port,
                bus,
                line.is_over,
                supervise=supervise,
                on_hand_back=lambda reason: line.alert(f"handed back: {reason}"),
            )
        finally:
            bus.close()


def _require_confirmation(port: str) -> None:
    """The sentence that the propeller is off, typed at the terminal.

    Raises:
        InputError: something else was typed, or nobody is at a terminal of a board on USB.
    """
    if port not in PORTS and not (sys.stdin is not None and sys.stdin.isatty()):
        raise InputError(
            "--turn-motor: expected a person at a terminal, got none; the motor turns: type the "
            "command at the bench"
        )
    print(
        f"The motor will turn for {MOTOR_PULSE_S:g} s. Propeller off, aircraft held, hands away "
        f"from the shaft? Type: {CONFIRMATION}",
        file=sys.stderr,
        flush=True,
    )
    typed = "" if sys.stdin is None else sys.stdin.readline().strip()
    if typed != CONFIRMATION:
        raise InputError(
            f"--turn-motor: expected {CONFIRMATION!r} to be typed, got {typed!r}; nothing was sent"
        )
