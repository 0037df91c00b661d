"""A model file as `falconwing gap` writes it, for tests of what reads one."""

from pathlib import Path

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.sysid.model_file import write_fitted_model
from falconwing_kit.sysid.uncertainty import Uncertainty


def write_windy_model(path: Path) -> None:
    """The kit's own aircraft in a wind of 0.1 and 0.4 m/s, both known to 0.01 m/s."""
    wind = next(effect for effect in CATALOGUE if effect.name == "wind")
    model = rates_model().with_effect(wind).with_values({"wind_x": 0.1, "wind_y": 0.4})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_fitted_model(
        path,
        model,
        Uncertainty(("wind_x", "wind_y"), 1e-4 * np.eye(2), 1.0, (), (), ()),
        flights=("flight.csv",),
        train_chi2=1.0,
        held_out_chi2=1.0,
        sigma=np.full(6, 0.01),
    )
