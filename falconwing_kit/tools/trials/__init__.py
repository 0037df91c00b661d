"""trials: many simulated flights, their statistics and figures, and flights with a hidden effect."""

from falconwing_kit.tools.trials.hidden import HiddenCase, hidden_case, hidden_seed
from falconwing_kit.tools.trials.statistics import bootstrap_mean, clopper_pearson, mcnemar
from falconwing_kit.tools.trials.trials import fly_trial, fly_trials, read_trials

__all__ = [
    "HiddenCase",
    "bootstrap_mean",
    "clopper_pearson",
    "fly_trial",
    "fly_trials",
    "hidden_case",
    "hidden_seed",
    "mcnemar",
    "read_trials",
]
