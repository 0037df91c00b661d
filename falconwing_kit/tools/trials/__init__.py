"""trials: simulated flights, their statistics and figures, and flights with a hidden effect."""

from falconwing_kit.tools.trials.hidden import HiddenCase, hidden_case, hidden_seed
from falconwing_kit.tools.trials.statistics import (
    bootstrap_mean_interval,
    clopper_pearson_interval,
    mcnemar_p_value,
)
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial, fly_trials, read_trials

__all__ = [
    "HiddenCase",
    "TrialSettings",
    "bootstrap_mean_interval",
    "clopper_pearson_interval",
    "fly_trial",
    "fly_trials",
    "hidden_case",
    "hidden_seed",
    "mcnemar_p_value",
    "read_trials",
]
