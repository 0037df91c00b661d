"""falconwing bridge: monitor the board: state, counters, delay, pilot's sticks."""

import math
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.messages import Command
from falconwing_kit.tools.cli.board_status import (
    MAX_S,
    POLL_S,
    StatusLine,
    open_ready_port,
    port_record,
)
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.port import TrainerPort

PERIOD_S = 0.05  # between two commands of --move-sticks


@dataclass(frozen=True)
class Bridge:
    """Show the board's state, counters, delay and the pilot's sticks. Commands are sent only with
    --ros or --move-sticks.

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
            0 if the board answered until the end, else 1.

        Raises:
            InputError: the port cannot be opened, no board answers, or the calibration does not
                fit.
        """
        require_range("--seconds", self.seconds, low=0.0, high=MAX_S)
        if self.ros and self.move_sticks:
            raise InputError(
                "--move-sticks: expected one source of commands, got --ros too; leave one out"
            )
        with open_ready_port(self.port, self.calibration, self.radio) as port:
            # A moving stick of the pilot takes over, a SIMULATED pilot's too.
            line = StatusLine(port, self.seconds, moves=not (self.ros or self.move_sticks))
            with suppress(KeyboardInterrupt):
                if self.ros:
                    self._relay(port, line)
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
        return 0 if answered else 1

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
