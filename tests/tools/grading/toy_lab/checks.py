"""Toy lab of the grader's tests: a line to compute and a cart to stop."""

from falconwing_kit.tools.grading.lab import Check, Criterion, Exercise, Lab


def _grows(stretch) -> bool:
    return bool(stretch(2.0, 3.0) > stretch(1.0, 3.0))


LAB = Lab(
    name="lab00",
    title="toy",
    hours=0.1,
    exercises=(
        Exercise(
            "stretch",
            50.0,
            (Check("a larger number gives a larger one", _grows, "look at the sign"),),
            seconds=1.0,
        ),
        Exercise("brake", 25.0, (), seconds=1.0),
    ),
    rubric=(Criterion("figure", 25.0, "anything"),),
    constants={"offset": (2.0, 3.0, 3)},
    memory_mib=256,
)
