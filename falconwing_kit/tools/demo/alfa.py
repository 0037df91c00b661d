"""ALFA flight: the ROS topics of one recorded flight, as CSV -> one flight table at 20 Hz and when
the engine failed.

The aircraft is a 2 m foam T-28 [Keipour, Mousaei & Scherer, ALFA: A dataset for UAV fault and
anomaly detection, IJRR 40 (2021) 515-520]. What the log holds, measured on it:

- Fresh attitudes and gyro rates come 2.5 times a second (imu-data); every faster topic repeats the last one.
- Positions come 4.1 times a second, velocities 19 times. Their time stamps are the host's and jitter by 10 ms, which
  is 0.19 m along the track and nothing across it, so each position is averaged with its neighbours
  before it.
- Servo pulses come 2.9 times a second and are held in between. Interpolated ones would look into the future and
  predict no better: the roll one second ahead is off by 3.1 deg with each at its best delay (0.1 s
  held, 0.2 to 0.3 s interpolated), and by 3.3 against 4.0 deg where no delay is fitted.
- The rudder pulse is half the aileron pulse to 1 us: the flight cannot tell the two apart.
- The failure is an autopilot that closes its throttle: the throttle in the table goes to zero with it.

    python -m falconwing_kit.tools.demo.alfa FOLDER OUT.csv
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.flight_table import FlightTable, write_flight_table
from falconwing_kit.core.frames import euler_from_rotation, euler_rates, world_from_enu, wrap_angle

RATE_HZ = 20.0
AVERAGED_S = (
    1.0  # positions of this long before a row are averaged; they are carried to it by the velocity
)
MAX_LATE_S = (
    2.0  # a topic that starts later or ends earlier than the attitudes by more than this is cut
)
# What a model fitted over 2 s leaves between itself and the poses: jitter of stamps, the
# autopilot's filter, gusts.
SIGMA_POSITION, SIGMA_ATTITUDE = 0.15, 0.026
# ROS body axes are nose, left, up; ours are nose, right, belly.
R_BODY_ROS = np.diag([1.0, -1.0, -1.0])
MIDDLE_PULSE_US = 1500.0
HALF_TRAVEL_US = 400.0  # ArduPilot's servo range is 1100..1900 us
IDLE_PULSE_US, FULL_PULSE_US = 1100.0, 1900.0  # 1 % of the logged throttle (vfr_hud) is 8 us

_TOPICS = {
    "failure": ("failure_status-engines", ("data",)),
    "imu": (
        "mavros-imu-data",
        (
            *(f"orientation.{axis}" for axis in "xyzw"),
            *(f"angular_velocity.{axis}" for axis in "xyz"),
        ),
    ),
    "position": (
        "mavros-local_position-odom",
        tuple(f"pose.pose.position.{axis}" for axis in "xyz"),
    ),
    "velocity": ("mavros-nav_info-velocity", tuple(f"meas_{axis}" for axis in "xyz")),
    "airspeed": ("mavros-nav_info-airspeed", ("measured",)),
    "servos": ("mavros-rc-out", tuple(f"channels{number}" for number in range(8))),
    "wind": ("mavros-wind_estimation", ("twist.linear.x", "twist.linear.y")),
}


@dataclass(frozen=True)
class AlfaFlight:
    """One recorded flight with an engine failure; world x = north, y = west, z = up from the
    take-off point.
    """

    # 20 Hz, with a pose in the rows that have a fresh attitude; extra vx..vz, p..r, airspeed,
    # sigmas
    table: FlightTable
    failure_time: float  # first "engine off" of the log, in the table's clock [s]
    wind_logged_world: Array  # (2,) where the autopilot thought the air moves to: north, west [m/s]
    warnings: tuple[str, ...] = ()  # what was mended while reading, one sentence each


@dataclass(frozen=True)
class _Topic:
    t: Array  # (N,) header stamp where there is one, else arrival [s], strictly increasing
    values: Array  # (N, columns)


def read_alfa(folder: str | Path) -> AlfaFlight:
    """Read one flight of the ALFA dataset.

    Args:
        folder: holds the topics as CSV, named as in the dataset without the flight's prefix:
            "mavros-imu-data.csv".

    Returns:
        The flight; time zero is its first attitude.

    Raises:
        FileNotFoundError: the folder or one of the topics is missing.
        InputError: a file cannot be read as the topic it should be, or the files are cut before the
            failure.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: expected the folder of an ALFA flight's CSV files, found none; check the path"
        )
    warnings = list[str]()
    topics = {
        key: _read_topic(folder, name, columns, warnings)
        for key, (name, columns) in _TOPICS.items()
    }
    start, end = topics["imu"].t[0], topics["imu"].t[-1]
    for key, topic in topics.items():
        if key != "failure" and (topic.t[0] > start + MAX_LATE_S or topic.t[-1] < end - MAX_LATE_S):
            raise InputError(
                f"{folder.name}: {_TOPICS[key][0]} covers {topic.t[0] - start:.1f} to {topic.t[-1] - start:.1f} s of "
                f"the {end - start:.1f} s that the attitudes cover; the file is cut, copy it again"
            )
    failure_time = topics["failure"].t[0] - start
    if not 0.0 < failure_time < end - start:
        raise InputError(
            f"{folder.name}: the engine failure at {failure_time:.1f} s is outside the flight of {end - start:.1f} s; "
            "the files are cut or of different flights, copy them again"
        )
    wind = topics["wind"]
    return AlfaFlight(
        table=_flight_table(folder.name, topics, start, tuple(warnings)),
        failure_time=round(float(failure_time), 3),
        wind_logged_world=_wind_world(wind.values[wind.t < topics["failure"].t[0]]),
        warnings=tuple(warnings),
    )


def _read_topic(folder: Path, name: str, columns: tuple[str, ...], warnings: list[str]) -> _Topic:
    """The named columns of one topic; a last line that is cut off is dropped with a warning."""
    path = require_file(folder / f"{name}.csv")
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = list(csv.reader(file))
    header = [column.removeprefix("field.") for column in lines[0]] if lines else []
    missing = [column for column in ("%time", *columns) if column not in header]
    if missing:
        raise InputError(
            f"{path.name}: expected the columns {', '.join(missing)}, got none of that name; is this the file?"
        )
    if len(lines) > 1 and len(lines[-1]) != len(header):
        warnings.append(f"{path.name}: the last line is cut off and was dropped")
        lines.pop()
    stamp = "header.stamp" if "header.stamp" in header else "%time"
    places = [header.index(column) for column in (stamp, *columns)]
    try:
        cells = np.array([[float(line[place]) for place in places] for line in lines[1:]])
    except (ValueError, IndexError):
        raise InputError(
            f"{path.name}: a cell is not a number or a line is short; copy the file again"
        ) from None
    if len(cells) < 2 or not np.isfinite(cells).all():
        raise InputError(
            f"{path.name}: expected two or more lines of finite numbers, got {len(cells)} lines; copy it again"
        )
    increasing = cells[:, 0] > np.maximum.accumulate(np.concatenate([[-np.inf], cells[:-1, 0]]))
    if not increasing.all():
        warnings.append(
            f"{path.name}: {(~increasing).sum()} lines whose time does not increase were dropped"
        )
    return _Topic(cells[increasing, 0] * 1e-9, cells[increasing, 1:])


def _flight_table(
    name: str, topics: dict[str, _Topic], start: float, warnings: tuple[str, ...]
) -> FlightTable:
    """All topics on one 20 Hz grid; nothing that was measured less often is invented in between."""
    imu, velocity, airspeed = topics["imu"], topics["velocity"], topics["airspeed"]
    t = np.arange(int((imu.t[-1] - start) * RATE_HZ + 0.5) + 1) / RATE_HZ
    row = np.rint((imu.t - start) * RATE_HZ).astype(np.int64)
    attitude, rates_body = _attitude(imu, start + t[row] - imu.t)
    v_world = world_from_enu(
        velocity.values[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    )  # logged north, east, down
    fresh = np.flatnonzero(np.diff(airspeed.values[:, 0], prepend=np.nan) != 0.0)
    extra = {
        key: _at(start + t, velocity.t, v_world[:, axis], 3)
        for axis, key in enumerate(("vx", "vy", "vz"))
    }
    extra |= {key: _in_rows(rates_body[:, axis], row, len(t)) for axis, key in enumerate("pqr")}
    extra["airspeed"] = _at(start + t, airspeed.t[fresh], airspeed.values[fresh, 0], 2)
    extra["sigma_position"] = np.full(len(t), SIGMA_POSITION)
    extra["sigma_attitude"] = np.full(len(t), SIGMA_ATTITUDE)
    p_world = _positions(topics["position"], velocity.t, v_world, start + t[row])
    return FlightTable(
        name=name,
        t=np.round(t, 3),
        p_world=np.column_stack([_in_rows(values, row, len(t), 3) for values in p_world.T]),
        attitude=np.column_stack([_in_rows(values, row, len(t)) for values in attitude.T]),
        commands=_commands(topics["servos"], start + t),
        extra=extra,
        warnings=warnings,
    )


def _attitude(imu: _Topic, late: Array) -> tuple[Array, Array]:
    """Attitude (N, 3) moved by `late` seconds with the gyro's rates, and those rates p, q, r (N, 3)
    [rad/s].

    The logged quaternion turns nose-left-up vectors into east-north-up ones. Moving by at most 25
    ms costs less than 0.2 deg at 10 rad/s^2.
    """
    from scipy.spatial.transform import Rotation

    quaternions = imu.values[:, :4]  # x, y, z, w
    if not quaternions.any(axis=1).all():
        raise InputError(
            f"{_TOPICS['imu'][0]}: expected attitudes as quaternions, got one of length 0; "
            "copy the file again"
        )
    # rows: where each body axis points
    axes_enu = Rotation.from_quat(quaternions).as_matrix().transpose(0, 2, 1)
    R_world_body = world_from_enu(axes_enu).transpose(0, 2, 1) @ R_BODY_ROS
    attitude = np.column_stack(euler_from_rotation(R_world_body))
    rates_body = imu.values[:, 4:] @ R_BODY_ROS
    rates = np.column_stack(euler_rates(R_world_body[:, 2].T, *rates_body.T))
    return wrap_angle(attitude + late[:, None] * rates), rates_body


def _positions(position: _Topic, t_velocity: Array, v_world: Array, t: Array) -> Array:
    """Positions (N, 3) at times t from those logged in the second before, each carried to t by the
    velocity [m].

    Only what was known at t enters, so a forecast from a row uses nothing of its future.
    """
    p_logged = world_from_enu(position.values)
    steps = 0.5 * (v_world[1:] + v_world[:-1]) * np.diff(t_velocity)[:, None]
    path = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    def along(query: Array) -> Array:
        return np.column_stack([np.interp(query, t_velocity, axis) for axis in path.T])

    start_of_path = p_logged - along(position.t)
    last = np.maximum(np.searchsorted(position.t, t, side="right"), 1)
    first = np.minimum(np.searchsorted(position.t, t - AVERAGED_S, side="right"), last - 1)
    return along(t) + [start_of_path[a:b].mean(axis=0) for a, b in zip(first, last, strict=True)]


def _commands(servos: _Topic, t: Array) -> Array:
    """Commands (N, 4) from servo pulses, held from one to the next: throttle 0..1; aileron,
    elevator, rudder -1..1.

    Channels, counted from zero, found from the motion: 1 elevator (a longer pulse lowers the nose),
        2 throttle,
    3 rudder, 4 and 5 the ailerons (a longer pulse lowers the right wing; both always agree). Trims
    are not removed.
    """
    elevator, throttle, rudder, aileron = servos.values[:, 1:5].T
    deflection = [
        (pulse - MIDDLE_PULSE_US) / HALF_TRAVEL_US for pulse in (aileron, elevator, rudder)
    ]
    power = (throttle - IDLE_PULSE_US) / (FULL_PULSE_US - IDLE_PULSE_US)
    channels = np.column_stack([power, deflection[0], -deflection[1], deflection[2]])
    held = np.maximum(np.searchsorted(servos.t, t, side="right") - 1, 0)
    return np.round(channels[held], 4)


def _wind_world(wind_enu: Array) -> Array:
    """Median wind (2,) north, west [m/s], where the air moves to.

    The log's vector points to where the wind comes from: ground velocity minus air velocity has the
    opposite sign.
    """
    east, north = np.median(wind_enu, axis=0)
    return np.round(world_from_enu([-east, -north, 0.0])[:2], 2)


def _at(query: Array, t: Array, values: Array, digits: int) -> Array:
    return np.round(np.interp(query, t, values), digits)


def _in_rows(values: Array, rows: np.ndarray, length: int, digits: int = 5) -> Array:
    column = np.full(length, np.nan)
    column[rows] = np.round(values, digits)
    return column


def main(arguments: list[str]) -> int:
    """Write the flight table of a folder: FOLDER OUT.csv; returns the exit status."""
    if len(arguments) != 2:
        print("expected two arguments: the folder of an ALFA flight and the CSV file to write")
        return 2
    try:
        flight = read_alfa(arguments[0])
        write_flight_table(arguments[1], flight.table)
    except (InputError, FileNotFoundError) as error:
        print(error)
        return 2
    print(
        f"{len(flight.table.t)} rows, {flight.table.has_pose.sum()} poses, engine off at {flight.failure_time:g} s"
    )
    for warning in flight.warnings:
        print(f"warning: {warning}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
