"""Foxglove: records of a flight log -> the messages that it draws: image, frames, motion, text.

Foxglove recognises an image, a frame or a line of text by the name of its schema alone, so these
messages have the published names and fields [https://docs.foxglove.dev/docs/sdk/schemas], as JSON.
Frames are `world`, `aircraft` (the kit's body axes: x nose, y right wing, z belly), `camera`
(OpenCV axes) and, where one flies, `leader`.
"""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import State

WORLD, AIRCRAFT, CAMERA, LEADER = "world", "aircraft", "camera", "leader"  # frames
AIRCRAFT_TOPIC, CAMERA_TOPIC, LEADER_TOPIC = "/frame/aircraft", "/frame/camera", "/frame/leader"
MOTION_TOPIC, TEXT_TOPIC = "/motion", "/text"
IMAGE_SCHEMA, FRAME_SCHEMA, TEXT_SCHEMA = (
    f"foxglove.{name}" for name in ("CompressedImage", "FrameTransform", "Log")
)
INFO = 2  # level of a foxglove.Log


def _of(**fields: Any) -> dict[str, Any]:
    return {"type": "object", "properties": fields}


_NUMBER, _TEXT, _COUNT = {"type": "number"}, {"type": "string"}, {"type": "integer", "minimum": 0}
_TIME = {**_of(sec=_COUNT, nsec=_COUNT), "title": "time"}
_VECTOR = _of(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_SCHEMA_RECORDS: dict[str, dict[str, Any]] = {
    IMAGE_SCHEMA: _of(
        timestamp=_TIME, frame_id=_TEXT, data={**_TEXT, "contentEncoding": "base64"}, format=_TEXT
    ),
    FRAME_SCHEMA: _of(
        timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR,
        rotation=_of(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
    ),
    TEXT_SCHEMA: _of(
        timestamp=_TIME, level=_COUNT, message=_TEXT, name=_TEXT, file=_TEXT, line=_COUNT
    ),
    # Not Foxglove's: what a plot shows, in the units of its axes.
    "motion": _of(
        t=_NUMBER, height_m=_NUMBER, speed_m_s=_NUMBER, roll_deg=_NUMBER, pitch_deg=_NUMBER,
        yaw_deg=_NUMBER,
    ),
}  # fmt: skip
SCHEMAS = {name: json.dumps(schema).encode() for name, schema in _SCHEMA_RECORDS.items()}  # JSON
TOPICS = {  # derived topic -> its schema
    AIRCRAFT_TOPIC: FRAME_SCHEMA, CAMERA_TOPIC: FRAME_SCHEMA, LEADER_TOPIC: FRAME_SCHEMA,
    MOTION_TOPIC: "motion", TEXT_TOPIC: TEXT_SCHEMA,
}  # fmt: skip


def pack_image(nanoseconds: int, jpeg: bytes) -> bytes:
    """A JPEG as foxglove.CompressedImage in the frame `camera`."""
    record = {
        "timestamp": _time(nanoseconds),
        "frame_id": CAMERA,
        "format": "jpeg",
        "data": base64.b64encode(jpeg).decode("ascii"),
    }
    return json.dumps(record).encode()


def unpack_image(data: bytes) -> bytes:
    """The JPEG in a foxglove.CompressedImage; inverse of `pack_image`.

    Raises:
        InputError: the message is of another kind, or holds another format.
        ValueError: it is no JSON or no base64.
    """
    record = json.loads(data)
    if not isinstance(record, dict) or record.get("format") not in ("jpeg", "jpg"):
        raise InputError("expected a compressed image with a JPEG")
    return base64.b64decode(str(record.get("data")), validate=True)


def aircraft_messages(nanoseconds: int, state: State) -> list[tuple[str, bytes]]:
    """Topic and message of the aircraft's frame and of its motion; none of what is not known."""
    if not np.isfinite(state.vector[:6]).all():
        return []
    frame = AIRCRAFT_TOPIC, _state_frame(nanoseconds, AIRCRAFT, state)
    if not np.isfinite(state.v_world).all():
        return [frame]
    motion = {
        "t": nanoseconds / 1e9,
        "height_m": float(state.p_world[2]),
        "speed_m_s": math.hypot(*state.v_world.tolist()),
        "roll_deg": math.degrees(state.roll),
        "pitch_deg": math.degrees(state.pitch),
        "yaw_deg": math.degrees(state.yaw),
    }
    return [frame, (MOTION_TOPIC, json.dumps(motion).encode())]


def leader_messages(nanoseconds: int, state: State) -> list[tuple[str, bytes]]:
    """Topic and message of the leader's frame; none without a pose."""
    if not np.isfinite(state.vector[:6]).all():
        return []
    return [(LEADER_TOPIC, _state_frame(nanoseconds, LEADER, state))]


def camera_message(nanoseconds: int, p_body_camera: Sequence[float]) -> tuple[str, bytes]:
    """Topic and message of the camera's frame on the aircraft, which never moves.

    Args:
        nanoseconds: time of the first state.
        p_body_camera: (3,) [m].
    """
    # R_BODY_CAMERA as a quaternion: a third of a turn about the diagonal.
    turn = (0.5, 0.5, 0.5, 0.5)
    return CAMERA_TOPIC, _frame(nanoseconds, AIRCRAFT, CAMERA, p_body_camera, turn)


def text_message(nanoseconds: int, name: str, details: Mapping[str, Any]) -> tuple[str, bytes]:
    """Topic and message of an event as one line of text."""
    words = ", ".join(f"{key} {value}" for key, value in details.items())
    record = {
        "timestamp": _time(nanoseconds),
        "level": INFO,
        "message": f"{name}: {words}" if words else name,
        "name": "falconwing",
        "file": "",
        "line": 0,
    }
    return TEXT_TOPIC, json.dumps(record).encode()


def attitude_quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of R_world_body, from the kit's body axes to the world.

    q = i * q_z(yaw) * q_y(pitch) * q_x(roll): the textbook's product [Stevens, Lewis & Johnson,
    eq. 1.8-16] after half a turn about x, whose quaternion is i.
    """
    sr, cr = math.sin(0.5 * roll), math.cos(0.5 * roll)
    sp, cp = math.sin(0.5 * pitch), math.cos(0.5 * pitch)
    sy, cy = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return w, -z, y, -x


def _state_frame(nanoseconds: int, child: str, state: State) -> bytes:
    turn = attitude_quaternion(state.roll, state.pitch, state.yaw)
    return _frame(nanoseconds, WORLD, child, state.p_world.tolist(), turn)


def _frame(
    nanoseconds: int, parent: str, child: str, place: Sequence[float], turn: Sequence[float]
) -> bytes:
    """A foxglove.FrameTransform: where the child's origin is and how its axes lie."""
    record = {
        "timestamp": _time(nanoseconds),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": dict(zip("xyz", place, strict=True)),
        "rotation": dict(zip("xyzw", turn, strict=True)),
    }
    return json.dumps(record).encode()


def _time(nanoseconds: int) -> dict[str, int]:
    sec, nsec = divmod(nanoseconds, 10**9)
    return {"sec": sec, "nsec": nsec}
