"""trainer_port: PPM calibration, serial protocol, safety state machine, boards and the port to the transmitter."""

from falconwing_kit.trainer_port.port import TrainerPort
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
from falconwing_kit.trainer_port.safety import Safety, SafetyConfig, Verdict

__all__ = [
    "Calibration",
    "CommandFrame",
    "Deframer",
    "Pilot",
    "Safety",
    "SafetyConfig",
    "Status",
    "Stick",
    "SyncReply",
    "SyncRequest",
    "TrainerPort",
    "Verdict",
    "decode",
    "decode_status",
    "encode",
    "encode_channels",
    "encode_command",
    "encode_sync",
    "load_calibration",
]
