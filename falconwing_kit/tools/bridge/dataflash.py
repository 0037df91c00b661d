"""DataFlash: a log of ArduPilot -> its series, and the poses of its estimator.

The library pymavlink (LGPL, never shipped) of the extra `logs` reads the file [messages:
https://ardupilot.org/plane/docs/logmessages.html]. Poses are those of the extended Kalman filter:
XKF1 (EKF3) or NKF1 (EKF2), whose position, velocity and angles have one time.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.tools.bridge.autopilot_series import (
    NedPoses,
    Series,
    import_reader,
    increasing,
    quiet,
    stack,
)
from falconwing_kit.tools.bridge.axes import HALF_TURN

MAGIC = b"\xa3\x95\x80"  # the head of a message, and the type of the first one: a format
FILTERS = ("XKF1", "NKF1")
SURFACES, OUTPUTS = "AETR", "RCOU"
TOPICS = (*FILTERS, SURFACES, OUTPUTS)


def read_dataflash(path: Path, wanted: Sequence[str]) -> tuple[dict[str, Series], list[str]]:
    """The series of TOPICS and of the wanted messages, and the names of all messages in the log.

    Of the filters only the first core is kept. Numbered fields, as C1 to C14 of RCOU, are given as
    an array too: C[0] is C1.

    Raises:
        InputError: pymavlink is not installed, or the file is damaged in a way it cannot read.
    """
    reader = import_reader("pymavlink.DFReader", "DataFlash")
    kinds = list(dict.fromkeys([*TOPICS, *wanted]))
    rows: dict[str, list[dict[str, float]]] = {}
    log = None
    try:
        with quiet():
            log = reader.DFReader_binary(str(path))
            known = sorted({form.name for form in log.formats.values()})
            while (message := log.recv_match(type=kinds)) is not None:
                values = {
                    key: value
                    for key in message.get_fieldnames()
                    if isinstance(value := getattr(message, key), (int, float))
                }
                first_core = message.get_type() not in FILTERS or not values.get("C")
                if "TimeUS" in values and first_core:
                    rows.setdefault(message.get_type(), []).append(values)
    except Exception as error:  # whatever its parser meets in a damaged file
        raise InputError(
            f"{short_name(path)}: expected a DataFlash log that pymavlink can read, got "
            f"{type(error).__name__}: {str(error)[:80]}; the log is damaged"
        ) from None
    finally:
        if log is not None:
            log.close()
    return {kind: _series(found) for kind, found in rows.items()}, known


def dataflash_poses(name: str, series: Mapping[str, Series], warnings: list[str]) -> NedPoses:
    """The poses of the Kalman filter.

    Raises:
        InputError: the log has none.
    """
    topic = next((k for k in FILTERS if k in series and len(series[k].t) > 1), None)
    if topic is None:
        raise InputError(
            f"{name}: expected the poses of a flight in {' or '.join(FILTERS)}, got none; "
            "log the filter's messages (LOG_BITMASK)"
        )
    filtered = series[topic]
    p_ned = stack(name, topic, filtered, ("PN", "PE", "PD"))
    v_ned = stack(name, topic, filtered, ("VN", "VE", "VD"))
    angles = np.radians(stack(name, topic, filtered, ("Roll", "Pitch", "Yaw")))
    p_ned[~np.isfinite(angles).all(axis=1)] = np.nan
    # The textbook's rotation is the kit's without the half turn before it.
    R_ned_body = HALF_TURN @ rotation_world_body(*np.nan_to_num(angles).T)
    return NedPoses(filtered.t, p_ned, R_ned_body, v_ned)


def _series(rows: Sequence[Mapping[str, float]]) -> Series:
    """The rows as columns; numbered fields also as arrays."""
    fields = [key for key in rows[0] if all(key in row for row in rows)]
    columns = {key: np.array([float(row[key]) for row in rows]) for key in fields}
    for key in list(columns):
        if numbered := re.fullmatch(r"([A-Za-z]+)(\d+)", key):
            columns[f"{numbered[1]}[{int(numbered[2]) - 1}]"] = columns[key]
    return increasing(columns["TimeUS"], columns)
