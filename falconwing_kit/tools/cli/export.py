"""falconwing export: a log of the kit, ROS 2, PX4 or ArduPilot to a table, log, bag or page."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import read_flight_log, recover, to_flight_table
from falconwing_kit.core.flight_table import FlightTable, slice_time, write_flight_table
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

Counts = dict[str, int]
Warnings = tuple[str, ...]


@dataclass(frozen=True)
class Export:
    """Convert a flight log to a table, a bag of ROS 1 or 2 or a page that shows the flight, or
    repair an interrupted one.

    Logs of others become a flight table too, their poses with the commands: of ROS 2 (MCAP), PX4
    (ULog) and ArduPilot (DataFlash).
    """

    log: Annotated[Path, tyro.conf.Positional]
    """the flight log (MCAP), interrupted ones too; or a log of ROS 2 (MCAP, or the folder of a
    recording), PX4 (.ulg) or ArduPilot (.bin); with --alfa the folder of a flight
    """
    out: Path
    """the file to write, or a folder to write it into"""
    to: Literal["csv", "mcap", "bag", "ros2", "html"] = "csv"
    """csv: one row per image with pose and command; mcap: everything that can be read, indexed,
    compressed and in the form that Foxglove draws; bag: ROS 1; ros2: a recording of ROS 2, a new
    folder; html: one page with the flight in its hall, its verdict and its ghost, that opens
    without a network
    """
    alfa: bool = False
    """the log is a flight of the ALFA dataset: a folder with one CSV file per ROS topic"""
    mapping: Path | None = None
    """for a log of ROS 2, PX4 or ArduPilot: its topics of poses and commands, their axes, channels
    and pulse widths (TOML); without it they are found in the log where it leaves no choice
    """
    rate_hz: float | None = None
    """for such a log: rows per second, each the nearest measured pose; without it every pose"""
    begin: float | None = None
    """with --to csv: leave out what comes before this time of the table, in seconds"""
    end: float | None = None
    """with --to csv: leave out this time and what comes after it"""
    scene: str = ""
    """for --to html: the hall around the flight, a name or a scene file; if not given, the one that
    the log names, else a map
    """
    model: Path | None = None
    """for --to html: a model file (model.toml), whose aircraft flies as the ghost; if not given,
    the kit's nominal model
    """
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Write the file and print what it contains.

        Returns:
            0: the file is written.

        Raises:
            FileNotFoundError: there is no log, or no folder for the file.
            InputError: the log cannot be used, or the file cannot be written or is the log itself.
        """
        if self.alfa and self.to != "csv":
            raise InputError(f"--alfa: expected --to csv, got --to {self.to}; leave --to out")
        cut = [name for name in ("begin", "end") if getattr(self, name) is not None]
        if cut and self.to != "csv":
            raise InputError(f"--{cut[0]}: expected --to csv, got --to {self.to}; leave it out")
        given = [name for name in ("mapping", "rate_hz") if getattr(self, name) is not None]
        if given and (self.alfa or self.to != "csv"):
            other = "--alfa" if self.alfa else f"--to {self.to}"
            raise InputError(
                f"--{given[0].replace('_', '-')}: expected a log of ROS 2, PX4 or ArduPilot and "
                f"--to csv, got {other}; leave one of them out"
            )
        for name in ("scene", "model"):
            if getattr(self, name) and self.to != "html":
                raise InputError(
                    f"--{name}: expected it with --to html, got --to {self.to}; leave it out"
                )
        target = self.out / f"{self.log.stem}.{self.to}" if self.out.is_dir() else self.out
        if target.resolve() == self.log.resolve():
            raise InputError(f"{target}: expected another name than the log's own; the log is kept")
        write, use = {
            "csv": (self._to_table, f"falconwing identify {target}"),
            "mcap": (self._to_log, f"falconwing export {target} --to csv"),
            "bag": (self._to_bag, f"rosbag info {target}"),
            "ros2": (self._to_bag, f"ros2 bag info {target}"),
            "html": (self._to_page, f"open {target} in a browser"),
        }[self.to]
        counts, warnings = write(target)
        if self.json:
            print_json({"file": str(target), **counts, "warnings": list(warnings)})
            return 0
        print_table(["what", "count"], list(counts.items()), title=str(target))
        for sentence in warnings:
            print(f"warning: {sentence}")
        next_line(use)
        return 0

    def _to_table(self, target: Path) -> tuple[Counts, Warnings]:
        if self.alfa:
            from falconwing_kit.tools.demo.alfa import read_alfa

            table = read_alfa(self.log).table
        else:
            table = self._table_of_others() or to_flight_table(read_flight_log(self.log))
        if self.begin is not None or self.end is not None:
            ends = (self.begin, -math.inf), (self.end, math.inf)
            table = slice_time(
                table, *(default if given is None else given for given, default in ends)
            )
        write_flight_table(target, table)
        return {"rows": len(table.t), "rows with a pose": int(table.has_pose.sum())}, table.warnings

    def _table_of_others(self) -> FlightTable | None:
        """The flight of a log of ROS 2, PX4 or ArduPilot; None for the kit's own log."""
        from falconwing_kit.tools.bridge.autopilot_log import is_autopilot_log, read_autopilot_log
        from falconwing_kit.tools.bridge.log_mapping import read_mapping
        from falconwing_kit.tools.bridge.ros2_log import is_ros_log, read_ros2_log

        mapping = None if self.mapping is None else read_mapping(self.mapping)
        if is_autopilot_log(self.log):
            return read_autopilot_log(self.log, mapping, self.rate_hz)
        if self.mapping is None and self.rate_hz is None and not is_ros_log(self.log):
            return None
        return read_ros2_log(self.log, mapping, self.rate_hz)

    def _to_log(self, target: Path) -> tuple[Counts, Warnings]:
        saved = recover(self.log, target)
        if not saved.counts:
            target.unlink()
            raise InputError(
                f"{self.log}: expected a log with records that can be read, got none; it was cut at"
                " its beginning"
            )
        return {topic.strip("/"): count for topic, count in saved.counts.items()}, saved.warnings

    def _to_bag(self, target: Path) -> tuple[Counts, Warnings]:
        from falconwing_kit.tools.bridge.bag import write_bag, write_ros2_bag

        log = read_flight_log(self.log)
        return (write_bag if self.to == "bag" else write_ros2_bag)(target, log), log.warnings

    def _to_page(self, target: Path) -> tuple[Counts, Warnings]:
        """The player's page of one flight, as the class shares it."""
        from falconwing_kit.core.files import atomic_write
        from falconwing_kit.tools.classroom.results import flight_data, record_of_log
        from falconwing_kit.tools.classroom.share import page_of_data

        record, model, name = record_of_log(self.log), None, ""
        if self.model is not None:
            from falconwing_kit.sysid.model_file import read_model

            model, name = read_model(self.model).model, self.model.name
        scene, warnings = self._scene_bytes(self.scene or record.scene)
        data = flight_data(record, model, name)
        page = page_of_data(data, scene)
        with atomic_write(target, text=True) as file:
            file.write(page)
        counts = {"rows": len(data["t"]), "events": len(data["events"]), "kB": len(page) // 1000}
        return counts, (*read_flight_log(self.log).warnings, *warnings)

    def _scene_bytes(self, name: str) -> tuple[bytes | None, Warnings]:
        """A hall as the page draws it; without one a sentence."""
        if not name:
            return None, ("the log does not say where it was flown: the page shows a map; give"
                          " --scene",)  # fmt: skip
        from falconwing_kit.tools.classroom.scene_file import scene_bytes
        from falconwing_kit.tools.cli.fly import hall_loader

        named = "hall" if name == "hall_analog" else name
        return scene_bytes(hall_loader(named)()), ()
