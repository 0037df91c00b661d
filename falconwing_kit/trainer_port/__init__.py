"""trainer_port: PPM calibration, serial protocol, safety state machine and the board's port."""

from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import (
    Calibration,
    Stick,
    encode_command,
    load_calibration,
)
from falconwing_kit.trainer_port.protocol import (
    CommandFrame,
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    SyncRequest,
    decode,
    decode_status,
    encode,
    encode_channels,
    encode_sync,
)
from falconwing_kit.trainer_port.safety import Safety, SafetyConfig, SafetyDecision

__all__ = [
    "Calibration",
    "CommandFrame",
    "Deframer",
    "PilotFrame",
    "Safety",
    "SafetyConfig",
    "SafetyDecision",
    "Status",
    "Stick",
    "SyncReply",
    "SyncRequest",
    "TrainerPort",
    "decode",
    "decode_status",
    "encode",
    "encode_channels",
    "encode_command",
    "encode_sync",
    "load_calibration",
]
