"""A lab of one exercise in a temporary folder, for the tests of finding, building and releasing."""

from pathlib import Path

SOURCE = '''# %% [markdown]
# # Lab 1: Small
# Weight.

# %%
from given import COHORT

from falconwing_kit.tools.grading.public_checks import check

# %% exercise="weight"
def weight(mass):
    """Weight [N] of a mass [kg]."""
    # BEGIN SOLUTION
    newtons = COHORT["gravity"] * mass

    return newtons
    # END SOLUTION


# %% check="weight"
check(weight)

# %% figure="line"
print(weight(2.0))

# %% [markdown]
# Why?

# %% [markdown] answer="q1"
# Because of the Earth, which pulls.

# %% tags=["solution"]
print("for instructors")
'''
CHECKS = '''"""What students see."""

from given import COHORT

from falconwing_kit.tools.grading.lab import Check, Criterion, Exercise, Lab

LAB = Lab(
    "lab01",
    "Small",
    1.0,
    (
        Exercise(
            "weight",
            75.0,
            (
                Check("1 kg weighs what your course says",
                      lambda weight: weight(1.0) == COHORT["gravity"], "multiply"),
                Check("nothing weighs nothing",
                      lambda weight: weight(0.0) == 0.0, "no constant is added"),
            ),
        ),
    ),
    (Criterion("line", 15.0, "a number"), Criterion("q1", 10.0, "the Earth")),
    constants={"gravity": (9.0, 11.0, 3)},
)
'''
GIVEN = '''"""What is given."""

import json
from pathlib import Path

COHORT = json.loads(Path(__file__).with_name("cohort.json").read_text())
'''
HIDDEN = '''"""What students do not see."""

from checks import LAB
from given import COHORT

from falconwing_kit.tools.grading.lab import Values


def judges(course):
    assert LAB.name == "lab01" and COHORT == course.constants
    draw = lambda rng: (rng.uniform(1.0, 5.0),)
    return {"weight": (Values(draw, lambda mass: COHORT["gravity"] * mass),)}


def handout(course, folder):
    (folder / "mine.txt").write_text(f"{course.student} {course.salt}")
'''


def write_small_lab(labs: Path) -> Path:
    """The lab's folder, made in the folder of the labs."""
    folder = labs / "lab01_small"
    (folder / "data").mkdir(parents=True)
    files = {
        "lab.py": SOURCE,
        "checks.py": CHECKS,
        "given.py": GIVEN,
        "hidden.py": HIDDEN,
        "notes.md": "secret notes",
        "cohort.json": '{"gravity": 10.0}',
        "data/points.csv": "1,2\\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder
