"""Aircraft as boxes: their colours, sizes and places in body axes, for every page that draws it."""

from collections.abc import Sequence

WHITE, RED, NAVY, DARK = (238, 238, 234), (205, 55, 50), (48, 76, 160), (50, 50, 52)
# Colour, size and centre [m] in body axes; span 0.70 m, length 0.52 m. page/aircraft.js holds the
# same numbers, which a test compares.
AIRCRAFT: tuple[tuple[tuple[int, int, int], Sequence[float], Sequence[float]], ...] = (
    (WHITE, (0.240, 0.065, 0.075), (0.030, 0.0, 0.0)),  # fuselage
    (WHITE, (0.220, 0.035, 0.040), (-0.180, 0.0, -0.010)),
    (RED, (0.055, 0.060, 0.065), (0.175, 0.0, 0.0)),  # nose
    (WHITE, (0.115, 0.700, 0.014), (0.030, 0.0, -0.045)),  # wing and its stripes
    *((RED, (0.117, 0.090, 0.016), (0.030, y, -0.045)) for y in (-0.27, 0.27)),
    *((NAVY, (0.117, 0.050, 0.016), (0.030, y, -0.045)) for y in (-0.15, 0.15)),
    (WHITE, (0.075, 0.220, 0.010), (-0.270, 0.0, -0.020)),  # tail
    (NAVY, (0.080, 0.012, 0.100), (-0.275, 0.0, -0.070)),
    (DARK, (0.006, 0.012, 0.190), (0.206, 0.0, 0.0)),  # propeller
    *((DARK, (0.050, 0.016, 0.050), (0.050, y, 0.085)) for y in (-0.08, 0.08)),  # wheels
    (DARK, (0.014, 0.160, 0.010), (0.050, 0.0, 0.060)),
)
