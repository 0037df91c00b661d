"""Actuator lag: slower servos, or something slow behind them; one effect in two forms."""

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.terms import Parameter

ACTS_ON = ("sticks", "roll", "pitch", "yaw")
SEPARATED_BY = {
    "aileron doublets": "a slow servo rounds each edge",
    "shaking": "a slow servo also makes the fast ones smaller",
}

EFFECTS = (
    Effect(
        name="actuator_lag",
        physics="The servos follow more slowly than before.",
        parameters=(
            Parameter(
                "actuator_lag", 0.02, 0.0, 0.6, "s", "time constant added to servo and propeller"
            ),
        ),
        equation="lag -> lag + {actuator_lag} in lag dy/dt = u - y, y the position of the servo",
        input_map=lambda K: (0.0, K.actuator_lag, 0.0),
        starts=({"actuator_lag": 0.1},),
        acts_on=ACTS_ON,
        separated_by=SEPARATED_BY,
        sizes=(0.015, 0.04, 0.15),
        draw=lambda rng, size: {str(rng.choice(["actuator_lag", "lag_in_series"])): size},
        frozen_number=10,
    ),
    Effect(
        name="actuator_lag",
        physics="A linkage or the motor, behind the servos, has become slow.",
        parameters=(
            Parameter(
                "lag_in_series", 0.02, 0.0, 0.6, "s", "time constant of a part behind the servo"
            ),
        ),
        equation="{lag_in_series} dz/dt = y - z, y the position of the servo, z what acts",
        input_map=lambda K: (0.0, 0.0, K.lag_in_series),
        starts=({"lag_in_series": 0.1},),
        acts_on=ACTS_ON,
        separated_by=SEPARATED_BY,
        frozen_number=10,
    ),
)
