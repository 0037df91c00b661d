"""Advice: a verdict -> one honest sentence about it, and what to fly next to know more."""

from collections.abc import Sequence
from itertools import combinations

from falconwing_kit.gap.name import CalmBase, Naming

# What makes an effect show, so that nothing else looks like it.
MANOEUVRES: dict[str, str] = {
    "wind": "turns through all headings, left and right",
    "fan_jet": "repeated passes through the same places in both directions, and others where the air is still",
    "ground_effect": "low passes at 0.3 to 1 m right after level flight at 2 m, at the same speed and throttle",
    "extra_drag": "glides with the throttle closed, then the same speeds under power",
    "flap": "a slow sweep of speed from the slowest safe flight to the fastest, wings level",
    "thrust_loss": "throttle steps at one speed, and a glide with the throttle closed",
    "battery_sag": "the same throttle steps at the start and at the end of a flight of two minutes or more",
    "propeller_torque": "throttle steps with the wings level and the hands off aileron and rudder",
    "adverse_yaw": "quick aileron doublets with the rudder still",
    "control_delay": "sharp doublets on every stick",
    "actuator_lag": "stick movements from slow to fast, up to two a second",
    "trim_bias": "straight flight with the hands off the sticks, at a slow and at a fast speed",
    "deadband": "small stick movements of a few per cent beside large ones",
    "aileron_loss": "full and half aileron doublets to both sides",
    "mass_change": "steep turns beside straight flight at the same speed, and a glide",
    "cg_shift": "elevator doublets at a slow and at a fast speed",
    "camera_tilt": "steep circles to the left and to the right at one speed",
    "stall": "slow flight down to the first mushing, and steep turns",
}  # fmt: skip
# Pairs that need a flight of their own, or that no flight can part.
PAIRS: dict[frozenset[str], str] = {
    frozenset(pair.split("+")): text
    for pair, text in {
        "control_delay+actuator_lag": "sharp stick steps held for a second beside fast shaking (two a second): a delay "
        "shifts both alike, a slow servo also makes the fast ones smaller",
        "extra_drag+thrust_loss": "glides with the throttle closed: drag slows them, a weak propeller does not",
        "extra_drag+battery_sag": "glides with the throttle closed at the start and at the end of a long flight",
        "thrust_loss+battery_sag": "two minutes or more with the same throttle steps at start and end: a weak battery "
        "grows worse, a weak propeller stays",
        "mass_change+flap": "a sweep of speed and steep turns: weight bends every path less",
        "mass_change+thrust_loss": "steep turns at one throttle and a glide: weight shows in both",
        "mass_change+extra_drag": "steep turns and glides: weight bends the path less, drag only slows it",
        "flap+camera_tilt": "circles inverted or very steep, left and right: a tilted camera turns with the body, lift "
        "does not care how the camera looks",
        "flap+ground_effect": "the same speeds at 2 m and at 0.3 to 1 m: only the cushion fades with height",
        "wind+fan_jet": "the whole hall in both directions: a wind is the same everywhere, a fan's stream is not",
        "trim_bias+camera_tilt": "straight flight hands off, at a slow and at a fast speed: a bent trim turns the "
        "aircraft faster with speed, a tilted camera shows the same angle always",
        "trim_bias+cg_shift": "straight flight from slow to fast: a moved centre of gravity needs other elevator at "
        "each speed, a moved neutral the same",
        "aileron_loss+deadband": "small and large aileron doublets: a dead band eats the small ones only",
        "extra_drag+wind": "upwind and downwind legs: drag slows both, wind one of them",
    }.items()
}  # fmt: skip
ONE_CLASS = (
    "no flight parts a control delay from late time stamps; on the bench, film a control surface and the stick "
    "together and compare the stamps"
)


def next_flight(base: CalmBase, naming: Naming) -> str:
    """What to fly next.

    Args:
        base: the aircraft without surprise.
        naming: the answer for the flight.

    Returns:
        One sentence.
    """
    names = [c.effect.name for c in naming.chosen]
    if naming.verdict == "ambiguous":
        return f"to part {_listed(names)}, fly {_parting(names)}"
    if naming.verdict == "named":
        shows = "; ".join(MANOEUVRES[name] for name in names)
        known = f"; {ONE_CLASS}" if "control_delay" in names else ""
        return f"to know the size better, fly more of this: {shows}{known}"
    if naming.verdict == "outside":
        return (
            "fly the calm flight again with nothing changed, to be sure of the aircraft; if it still fits, change one "
            "thing at a time and look at the map of residuals for what it goes with"
        )
    weak = [n for n in base.found.uncertainty.not_excited if n not in ("delay", "lag")]
    shy = f"; the calm flight hardly moved {_listed(weak[:4])}" if weak else ""
    return (
        "nothing needs to be parted; a smaller effect would show in a longer flight with larger and faster movements "
        f"of every stick, a sweep of speed, low passes and turns both ways{shy}"
    )


def headline(naming: Naming) -> str:
    """The verdict in a few words."""
    names = [c.effect.name for c in naming.chosen]
    return {
        "named": f"Missing: {_listed(names, 'and')}",
        "ambiguous": f"Missing: {_listed(names, 'or')}, this flight does not tell which",
        "none": "Nothing is missing that this flight could show",
        "outside": "Something is missing, and it is not in the catalogue",
    }[naming.verdict]


def _parting(names: Sequence[str]) -> str:
    told = [PAIRS[frozenset(pair)] for pair in combinations(names, 2) if frozenset(pair) in PAIRS]
    lone = [n for n in names if not any(frozenset((n, m)) in PAIRS for m in names)]
    return "; and ".join(dict.fromkeys([*told, *(MANOEUVRES[name] for name in lone)]))


def _listed(names: Sequence[str], word: str = "and") -> str:
    plain = [name.replace("_", " ") for name in names]
    return f" {word} ".join([", ".join(plain[:-1]), plain[-1]]) if len(plain) > 1 else "".join(plain)
