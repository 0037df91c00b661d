"""Autopilot logs for tests: columns over time -> bytes of a ULog or of a DataFlash log, by hand.

ULog after docs.px4.io (ULog File Format), DataFlash after ArduPilot's own definition: messages of
`A3 95 type`, each type described by a FMT message before. No library of theirs is used here.
"""

import struct
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from falconwing_kit.core.flight_table import FlightTable

ULOG_TYPES = {"uint64_t": "Q", "float": "f", "bool": "?", "uint8_t": "B", "uint16_t": "H"}
START_US = 12_000_000  # of the flight, after the autopilot's start

# name -> fields as "type[count] name" and their columns (N,) or (N, count); "timestamp" is first.
Topics = Mapping[str, tuple[Sequence[str], Mapping[str, np.ndarray]]]


def ulog_bytes(topics: Topics, instances: Mapping[str, int] | None = None) -> bytes:
    """A ULog with the records of all topics in order of time."""
    instances = instances or {}
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", START_US)
    data += ulog_message("B", bytes(40))
    records = []
    for number, (name, (fields, columns)) in enumerate(topics.items()):
        kind = name.partition(":")[0]
        text = f"{kind}:" + "".join(f"{field};" for field in fields)
        data += ulog_message("F", text.encode())
        subscription = struct.pack("<BH", instances.get(name, 0), number) + kind.encode()
        records.append((-1, ulog_message("A", subscription)))
        for row, t in enumerate(columns["timestamp"]):
            body = struct.pack("<H", number)
            for field in fields:
                form, label = field.split()
                if label.startswith("_padding"):
                    continue  # at the end: in the format, but not in the data
                kind_of = ULOG_TYPES[form.partition("[")[0]]
                for value in np.atleast_1d(columns[label][row]):
                    body += struct.pack("<" + kind_of, value.item())
            records.append((int(t), ulog_message("D", body)))
    records.sort(key=lambda record: record[0])
    return data + b"".join(message for _, message in records)


def ulog_message(kind: str, body: bytes) -> bytes:
    """Size of the body, type, body."""
    return struct.pack("<HB", len(body), ord(kind)) + body


DATAFLASH_TYPES = {"Q": "Q", "B": "B", "c": "h", "C": "H", "e": "i", "f": "f", "H": "H", "h": "h"}
HUNDREDTHS = "cCe"  # stored as hundredths


def dataflash_bytes(
    messages: Mapping[str, tuple[str, str, Mapping[str, np.ndarray]]],
) -> bytes:
    """A DataFlash log: name -> (format, fields separated by commas, columns), in order of time."""

    def described(number: int, length: int, name: str, form: str, fields: str) -> bytes:
        body = struct.pack("<BB4s16s64s", number, length, *(
            text.encode() for text in (name, form, fields)
        ))  # fmt: skip
        return b"\xa3\x95\x80" + body

    data = described(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    records = []
    for number, (name, (form, fields, columns)) in enumerate(messages.items(), start=1):
        packed = "<" + "".join(DATAFLASH_TYPES[kind] for kind in form)
        data += described(number, 3 + struct.calcsize(packed), name, form, fields)
        for row, t in enumerate(columns["TimeUS"]):
            values = []
            for kind, field in zip(form, fields.split(","), strict=True):
                value = columns[field][row] if field in columns else 0
                value = round(100 * float(value)) if kind in HUNDREDTHS else value
                values.append(float(value) if kind == "f" else int(value))
            head = b"\xa3\x95" + bytes([number])
            records.append((int(t), head + struct.pack(packed, *values)))
    records.sort(key=lambda record: record[0])
    return data + b"".join(message for _, message in records)


def microseconds(t: np.ndarray) -> np.ndarray:
    """Times of the autopilot."""
    return START_US + np.rint(1e6 * t).astype(np.int64)


def ned(flight: FlightTable) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and Euler angles yaw, pitch, roll (N, 3) of a flight, world x north.

    The kit's world is x north, y west, z up: half a turn about x, which leaves the angles.
    """
    return flight.p_world * [1.0, -1.0, -1.0], flight.attitude[:, ::-1]


def px4_topics(flight: FlightTable, offset: Sequence[float] = (3.0, -5.0, -100.0)) -> Topics:
    """The topics of PX4 1.13 for a flight; `offset` is where it begins, in north-east-down."""
    p, angles = ned(flight)
    v = np.gradient(p, flight.t, axis=0)
    p = p - p[0] + offset
    x, y, z, w = Rotation.from_euler("ZYX", angles).as_quat().T
    t = microseconds(flight.t)
    ones = np.ones(len(t), bool)
    throttle, aileron, elevator, rudder = flight.commands.T
    position = {"timestamp": t, "timestamp_sample": t, "xy_valid": ones, "z_valid": ones}
    position |= dict(zip(("x", "y", "z", "vx", "vy", "vz"), [*p.T, *v.T], strict=True))
    position |= {"xy_reset_counter": 0 * t}
    floats = [f"float {name}" for name in ("x", "y", "z", "vx", "vy", "vz")]
    control = np.column_stack([aileron, elevator, rudder, throttle, *[0.0 * throttle] * 4])
    return {
        "vehicle_local_position": (
            ["uint64_t timestamp", "uint64_t timestamp_sample", *floats, "bool xy_valid",
             "bool z_valid", "uint8_t xy_reset_counter", "uint8_t[1] _padding0"],
            position,
        ),
        "vehicle_attitude": (
            ["uint64_t timestamp", "uint64_t timestamp_sample", "float[4] q"],
            {"timestamp": t, "timestamp_sample": t, "q": np.column_stack([w, x, y, z])},
        ),
        "actuator_controls_0": (
            ["uint64_t timestamp", "float[8] control"], {"timestamp": t, "control": control},
        ),
    }  # fmt: skip


def ardupilot_messages(flight: FlightTable) -> dict[str, tuple[str, str, dict[str, np.ndarray]]]:
    """The messages of ArduPlane 4 for a flight."""
    p, angles = ned(flight)
    v = np.gradient(p, flight.t, axis=0)
    t = microseconds(flight.t)
    yaw, pitch, roll = np.degrees(angles).T
    throttle, aileron, elevator, rudder = flight.commands.T
    columns = {"TimeUS": t, "C": 0 * t, "Roll": roll, "Pitch": pitch, "Yaw": yaw % 360.0}
    columns |= dict(zip(("VN", "VE", "VD", "PN", "PE", "PD"), [*v.T, *p.T], strict=True))
    fields = "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"
    other_core = {**columns, "C": 0 * t + 1, "PN": columns["PN"] + 50.0}
    both = {key: np.repeat(values, 2) for key, values in columns.items()}
    for key in ("C", "PN"):
        both[key][1::2] = other_core[key]
    surfaces = {"TimeUS": t, "Ail": 4500 * aileron, "Elev": 4500 * elevator}
    surfaces |= {"Thr": 100 * throttle, "Rudd": 4500 * rudder}
    pulses = {"TimeUS": t, "C1": 1500 + 500 * aileron, "C2": 1500 + 500 * elevator}
    pulses |= {"C3": 1000 + 1000 * throttle, "C4": 1500 + 500 * rudder}
    return {
        "XKF1": ("QBccCfffffffccce", fields, both),
        "AETR": ("Qfffffff", "TimeUS,Ail,Elev,Thr,Rudd,Flap,Steer,SS", surfaces),
        "RCOU": ("QHHHH", "TimeUS,C1,C2,C3,C4", pulses),
    }
