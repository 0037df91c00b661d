"""Toy lab, judges: gain * x + offset, and whether a cart comes to rest at the origin."""

from falconwing_kit.tools.grading.lab import Trials, Values


def judges(course):
    """The judges of each exercise."""
    offset = course.constants["offset"]

    def draw(rng):
        return rng.normal(size=5), float(rng.uniform(1.0, 2.0))

    return {
        "stretch": (Values(draw, lambda x, gain: gain * x + offset, cases=4),),
        "brake": (Trials(_comes_to_rest, trials=3),),
    }


def _comes_to_rest(brake, rng):
    """A cart without friction, 10 s in steps of 0.05 s; the function gives its acceleration."""
    position, speed = rng.uniform(0.5, 1.0), rng.uniform(-1.0, 1.0)
    for _ in range(200):
        speed += 0.05 * float(brake(position, speed))
        position += 0.05 * speed
    return bool(abs(position) < 0.01 and abs(speed) < 0.01)
