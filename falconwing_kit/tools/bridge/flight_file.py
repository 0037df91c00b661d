"""Flight file: a flight table or log, or a log of ROS 2, PX4 or ArduPilot -> a flight table."""

from pathlib import Path

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import MAGIC, read_flight_log, to_flight_table
from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.tools.bridge.log_mapping import LogMapping


def read_flight(
    path: str | Path, mapping: LogMapping | None = None, rate_hz: float | None = None
) -> FlightTable:
    """Read a flight from any file that the kit knows, by the file's first bytes.

    Args:
        path: a flight table (CSV), a flight log (MCAP), a log of ROS 2 (MCAP, or a folder with
            one), of PX4 (ULog) or of ArduPilot (DataFlash).
        mapping: which topics and channels mean what, for the logs of others.
        rate_hz: rows per second, for the logs of others.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file cannot be used, or mapping or rate_hz are given for the kit's own.
    """
    from falconwing_kit.tools.bridge.autopilot_log import is_autopilot_log, read_autopilot_log
    from falconwing_kit.tools.bridge.ros2_log import is_ros_log, read_ros2_log

    is_folder = Path(path).is_dir()
    if not is_folder and is_autopilot_log(path):
        return read_autopilot_log(path, mapping, rate_hz)
    if is_folder or _is_mcap(path):
        if is_ros_log(path):
            return read_ros2_log(path, mapping, rate_hz)
        _refuse(path, mapping, rate_hz)
        return to_flight_table(read_flight_log(path))
    _refuse(path, mapping, rate_hz)
    return read_flight_table(path)


def _is_mcap(path: str | Path) -> bool:
    with require_file(path).open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def _refuse(path: str | Path, mapping: LogMapping | None, rate_hz: float | None) -> None:
    given = [name for name, value in (("mapping", mapping), ("rate-hz", rate_hz)) if value]
    if given:
        raise InputError(
            f"--{given[0]}: expected a log of ROS 2, PX4 or ArduPilot, got {short_name(path)}; "
            "leave it out"
        )
