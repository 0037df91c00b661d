"""trainer_port: PPM calibration, serial protocol, safety state machine, boards and the port to the transmitter."""

from falconwing_kit.trainer_port.ppm import Calibration, Stick, load_calibration
from falconwing_kit.trainer_port.protocol import (
    CommandFrame,
    Deframer,
    Pilot,
    Status,
    SyncReply,
    SyncRequest,
    decode,
    decode_status,
    encode,
    encode_channels,
    encode_command,
    encode_sync,
)

__all__ = [
    "Calibration",
    "CommandFrame",
    "Deframer",
    "Pilot",
    "Status",
    "Stick",
    "SyncReply",
    "SyncRequest",
    "decode",
    "decode_status",
    "encode",
    "encode_channels",
    "encode_command",
    "encode_sync",
    "load_calibration",
]
