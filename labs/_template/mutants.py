"""Wrong solutions of lab 0: what is wrong, the replaced text, the replacement.

Belongs to the tests: move it to tests/labs/mutants/lab00.py.
"""

MUTANTS = {
    "glide_range": (
        ("ignores the wind", "(airspeed - headwind)", "airspeed"),
        ("wrong sign of the wind", "airspeed - headwind", "airspeed + headwind"),
        ("inverted glide ratio", '* COHORT["glide_ratio"]', '/ COHORT["glide_ratio"]'),
        ("glide ratio copied, not named", 'COHORT["glide_ratio"]', "8.0"),
    ),
}
