"""Control delay and late time stamps: two effects with the same dynamics."""

from falconwing_kit.aircraft.effect import Effect, draw_size
from falconwing_kit.aircraft.terms import Parameter

NO_FLIGHT_SEPARATES = (
    "no flight separates a control delay from late time stamps; on the bench, film a control "
    "surface and the stick together and compare the stamps"
)
SIZES = (0.01, 0.03, 0.12)  # [s]

EFFECTS = (
    Effect(
        name="control_delay",
        physics="Commands act later than before.",
        parameters=(
            Parameter(
                "control_delay", 0.02, -0.05, 0.4, "s", "delay added between command and servo"
            ),
        ),
        equation="u(t) -> u(t - {control_delay}), u all four commands",
        input_map=lambda K: (K.control_delay, 0.0, 0.0),
        starts=({"control_delay": 0.1}, {"control_delay": 0.2}, {"control_delay": -0.01}),
        acts_on=("sticks", "roll", "pitch", "yaw"),
        same_form=(
            "delay of the throttle",
            "delay of the aileron",
            "delay of the elevator",
            "delay of the rudder",
        ),
        separated_by={
            "aileron doublets": "a delay moves each edge",
            "shaking": "a delay shifts slow and fast movements alike",
        },
        note=NO_FLIGHT_SEPARATES,
        sizes=SIZES,
        draw=draw_size("control_delay"),
        frozen_number=9,
    ),
    Effect(
        name="time_offset",
        physics="The images' time stamps are late; a flight shows the same as a control delay.",
        parameters=(),
        same_as="control_delay",
        note=NO_FLIGHT_SEPARATES,
        sizes=SIZES,
        draw=draw_size("control_delay"),
        hidden_stamp_delay=lambda K: float(K.control_delay),
        frozen_number=17,
    ),
)
