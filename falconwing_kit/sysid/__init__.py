"""sysid: recorded flights -> the parameters of f_K, their intervals and a held-out score."""

from falconwing_kit.sysid.diagnose import (
    Fault,
    diagnose_pair,
    diagnose_table,
    require_sound_table,
)
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_initial_states
from falconwing_kit.sysid.forecast import (
    Forecasts,
    constant_turn,
    constant_velocity,
    forecast,
    hold_throttle,
)
from falconwing_kit.sysid.identify import Identification, identify
from falconwing_kit.sysid.model_file import ModelFile, read_model, write_model
from falconwing_kit.sysid.one_step import differentiated_states, fit_one_step
from falconwing_kit.sysid.prepare import (
    CHANNELS,
    PreparedFlight,
    PreparedTable,
    difference_noise,
    prepare,
)
from falconwing_kit.sysid.score import PredictionScore, score, split_blocks
from falconwing_kit.sysid.shooting import (
    Windows,
    cut_windows,
    jacobian,
    predict,
    residuals,
    select_windows,
)
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

__all__ = [
    "CHANNELS",
    "Fault",
    "FitResult",
    "Forecasts",
    "Identification",
    "ModelFile",
    "PredictionScore",
    "PreparedFlight",
    "PreparedTable",
    "Prior",
    "Uncertainty",
    "Windows",
    "constant_turn",
    "constant_velocity",
    "cut_windows",
    "diagnose_pair",
    "diagnose_table",
    "difference_noise",
    "differentiated_states",
    "fit",
    "fit_initial_states",
    "fit_one_step",
    "forecast",
    "hold_throttle",
    "identify",
    "jacobian",
    "predict",
    "prepare",
    "read_model",
    "require_sound_table",
    "residuals",
    "score",
    "select_windows",
    "split_blocks",
    "uncertainty",
    "write_model",
]
