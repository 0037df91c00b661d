"""sysid: recorded flights -> the parameters of f_K, their intervals, and an honest score."""

from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_starts
from falconwing_kit.sysid.forecast import Forecasts, constant_turn, constant_velocity, forecast, with_throttle_held
from falconwing_kit.sysid.identify import Identification, identify
from falconwing_kit.sysid.model_file import ModelFile, read_model, write_model
from falconwing_kit.sysid.one_step import differentiated_states, fit_one_step
from falconwing_kit.sysid.prepare import CHANNELS, Flight, Prepared, difference_noise, prepare
from falconwing_kit.sysid.score import Score, hold_out, score, select
from falconwing_kit.sysid.shooting import Windows, cut_windows, jacobian, predict, residuals
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

__all__ = [
    "CHANNELS",
    "FitResult",
    "Flight",
    "Forecasts",
    "Identification",
    "ModelFile",
    "Prepared",
    "Prior",
    "Score",
    "Uncertainty",
    "Windows",
    "constant_turn",
    "constant_velocity",
    "cut_windows",
    "difference_noise",
    "differentiated_states",
    "fit",
    "fit_one_step",
    "fit_starts",
    "forecast",
    "hold_out",
    "identify",
    "jacobian",
    "predict",
    "prepare",
    "read_model",
    "residuals",
    "score",
    "select",
    "uncertainty",
    "with_throttle_held",
    "write_model",
]
