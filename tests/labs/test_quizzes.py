"""The labs' quizzes: every number against a computation by hand, for the open course and another.

The expected values are worked out here from the physics, with other formulas or other code than
the quiz's own where there is a choice.
"""

import json
import math
import re

import numpy as np
import pytest
from scipy import stats

from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.tools.grading.collect import read_notebook
from falconwing_kit.tools.grading.find import lab_folders, load_checks, notebook_path
from falconwing_kit.tools.grading.lab import course_constants
from falconwing_kit.tools.grading.quiz import read_quiz
from falconwing_kit.tools.grading.quiz_answers import quiz_record
from tests.labs.run_notebook import ROOT

# Every lab of the course has one (tested below); one begun from the template has none.
FOLDERS = [folder for folder in lab_folders(ROOT / "labs") if (folder / "quiz.toml").is_file()]
KEYS = ("", "0123456789abcdef" * 4)


def numbers(text):
    """The numbers of a question's text, in order, without those of its formulas."""
    plain = re.sub(r"\$[^$]*\$", "", text)
    return [float(each) for each in re.findall(r"(?<![\w.])-?\d+\.?\d*", plain)]


def bisect(function, low, high):
    """A root, by halving."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(low) * function(middle) > 0 else (low, middle)
    return 0.5 * (low + high)


def l1_q1(c, start, speed, extra):  # lift = weight at both masses: k V^2 = m g
    return bisect(lambda v: v**2 / speed**2 - (start + extra) / start, 1.0, 50.0)


def l1_q2(c, speed, bank):  # the vertical part of the lift carries the weight
    return bisect(lambda v: v**2 * math.cos(math.radians(bank)) - speed**2, 1.0, 50.0)


def l1_q5(c, wing, place, motor, ahead):
    return float(np.average([place, -ahead], weights=[wing, motor]))


def l2_q1(c, focal, right, ahead):
    pixel = np.diag([focal, focal, 1.0]) @ [right, 0.0, ahead]
    return float(pixel[0] / pixel[2])


def l2_q2(c, height, focal, down):  # the ray meets the floor
    return height / math.tan(math.atan2(down, focal))


def l3_q1(c, size, ahead, focal, blur):  # moments of a projected cloud, by quadrature
    nodes, weights = np.polynomial.hermite_e.hermegauss(20)
    u = focal * nodes * size / 100.0 / ahead
    return math.sqrt(np.sum(weights * u**2) / np.sum(weights) + blur)


def l3_q2(c, opacity, sigmas):
    return opacity * stats.norm.pdf(sigmas) / stats.norm.pdf(0.0)


def l3_q3(c, first, second):
    left = np.cumprod([1.0, 1.0 - first, 1.0 - second])
    return float(left[1] - left[2])


def l4_q1(c, speed, pitch, rise):
    R = rotation_world_body(0.0, math.radians(pitch), 0.0)
    u, _, w = R.T @ (np.array([speed, 0.0, 0.0]) - [0.0, 0.0, rise])
    return math.degrees(math.atan2(w, u))


def l4_q2(c, bank, pitch, turn):  # the turn's axis is down in the world; its part along body y
    R = rotation_world_body(math.radians(bank), pitch, 0.3)
    return float((R.T @ [0.0, 0.0, -turn])[1])


def l4_q3(c, step, error, times):  # halving costs 2^-4 each, log-log slope 4
    return math.exp(math.log(error) - 4.0 * math.log(times))


def l5_q1(c, every, noise):
    slope = np.linalg.pinv(np.column_stack([np.ones(3), [-every, 0.0, every]]))[1]
    return float(np.linalg.norm(slope) * noise / 100.0)


def l5_q2(c, parameters, windows, state, count, total):
    return total / (count - parameters - windows * state)


def l5_q4(c, far_sigmas, far):
    factor = math.sqrt(c["far_sigmas"] / far)
    assert far_sigmas == c["far_sigmas"]
    return (factor * far) ** 2


def l6_q1(c, size, distance, focal, pixels):  # a marker that appears 0.3 px smaller is farther
    width = focal * size / distance
    both = [focal * size / (width + step) for step in (-0.5 * pixels, 0.5 * pixels)]
    return 100.0 * (both[0] - both[1])


def l6_q2(c, near, distance):
    return (distance**3) ** 2 / (near**3) ** 2


def l6_q5(c, *misses):
    return c["gate"] * float(np.median(misses))


def l7_q1(c, radius, speed, gravity):
    return math.degrees(
        bisect(lambda a: gravity * radius * math.sin(a) - speed**2 * math.cos(a), 0.0, 1.5)
    )


def l7_q2(c, margin, bank):
    return margin / math.sqrt(1.0 / math.cos(math.radians(bank)))


def l7_q4(c, sink, tau, height):  # Euler with small steps
    h, t = height, 0.0
    while h > 0.0:
        h, t = h - 1e-5 * (sink + h / tau), t + 1e-5
    assert sink == c["touch_sink"]
    return t


def l8_q2(c, times):  # sum over the steps of the number of steps behind each
    return sum(range(int(times * 10_000))) / sum(range(10_000))


def l8_q4(c, first_expert, first, turn, less, a):
    error, expert = np.array([first, -less]), np.array([first_expert, turn])
    return float(np.mean((1.0 + a * np.abs(expert)) * error**2))


def l9_q1(c, truth, marked, both):
    a, b = set(range(int(truth))), set(range(int(truth - both), int(truth - both + marked)))
    return len(a & b) / len(a | b)


def l9_q2(c, value, most, share, gamma):
    return most * (share * (value / most) ** gamma) ** (1.0 / gamma)


def l9_q5(c, views, *_):
    return 100.0 * bisect(lambda p: stats.binom.pmf(0, views, p) - 0.05, 1e-6, 0.9)


def l10_q1(c, centre, reach, throttle):
    assert centre == c["centre_us"]
    return float(np.interp(throttle, [0.0, 1.0], [centre - reach, centre + reach]))


def l10_q2(c, bits, first, second):
    return (2**bits - first + second) / 2.0


def l10_q3(c, edge):
    return math.hypot(edge, edge)


def l11_q1(c, trials, again, *_):  # Wilson: the rate from which 1 is z standard deviations away
    return bisect(lambda p: (1 - p) - 1.96 * math.sqrt(p * (1 - p) / trials), 1e-6, 1 - 1e-9)


def l11_q2(c, printed, failed, *_):
    return sum([printed] * 10) / len(range(int(failed), 10))


def l11_q3(c, pairs):
    patterns = np.array(np.meshgrid(*[[1, -1]] * int(pairs))).reshape(int(pairs), -1)
    return float(np.mean(np.abs(patterns.sum(axis=0)) >= pairs))


def l11_q5(c, rate, z):
    p, n = rate / 100.0, 1
    while 1.0 - p < z * math.sqrt(p * (1.0 - p) / n):
        n += 1
    return n


def l12_q1(c, drop, one, part):
    residual = np.array([3.0, -1.0, 2.0])
    return drop * float(np.sum((residual / part) ** 2) / np.sum(residual**2))


def l12_q2(c, drop, count):
    return drop - math.log(count**2)


def l13_q1(c, size, apart):  # variance of an equal mixture, by the law of total variance
    return math.sqrt(size**2 + float(np.var([-apart / 2, apart / 2])))


def l13_q2(c, worth, soft, off, sink):
    assert (worth, soft) == (c["worth_m"], c["soft_sink"])
    return 100.0 / math.exp((off / worth) ** 2) * (soft / sink if sink > soft else 1.0)


def l13_q3(c, step, every, speed):
    ages = [step * (k % int(every)) for k in range(100)]
    return speed * max(ages)


HAND = {
    tuple(int(part) for part in re.findall(r"\d+", name)): function
    for name, function in list(globals().items())
    if re.fullmatch(r"l\d+_q\d", name)
}


def test_every_lab_of_the_course_has_a_quiz_a_film_and_a_goal():
    """Thirteen labs; the template begins without, so other tests ask where there is one."""
    folders = lab_folders(ROOT / "labs")
    assert len(folders) == len(FOLDERS) == 13
    for folder in folders:
        assert (folder / "goal.webp").is_file(), folder.name
        assert "moving_" in (folder / "lab.py").read_text(encoding="utf-8"), folder.name


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
@pytest.mark.parametrize("key", KEYS, ids=["open", "course"])
def test_every_number_is_what_a_hand_computation_gives(folder, key):
    """From the numbers in the question's text alone, and the course's constants."""
    lab = load_checks(folder)
    constants = course_constants(lab, key)
    questions = read_quiz(folder, key, constants)
    assert len(questions) == 5
    counted = 0
    for question in questions:
        if question.kind == "number":
            counted += 1
            by_hand = HAND[int(lab.name[3:]), question.number](constants, *numbers(question.text))
            assert by_hand == pytest.approx(question.expected, rel=2e-4), question.text
            wrong = [abs(value / question.expected - 1.0) for value, _ in question.mistakes]
            assert all(each > question.tolerance for each in wrong), question.mistakes
        assert "<" not in re.sub(r"\$[^$]*\$", "", question.text + question.explanation)
    assert counted >= 2


def test_each_computation_belongs_to_a_question():
    """No question with a number goes unchecked, and none is checked twice."""
    asked = {
        (int(load_checks(folder).name[3:]), question.number)
        for folder in FOLDERS
        for question in read_quiz(folder, "", course_constants(load_checks(folder), ""))
        if question.kind == "number"
    }
    assert asked == set(HAND)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_solution_answers_all_and_the_untouched_notebook_none(folder):
    """The notebooks as they are kept: read, not run."""
    questions = read_quiz(folder, "", course_constants(load_checks(folder), ""))
    solved, open_ = (
        quiz_record(read_notebook(notebook_path(folder, solution=done)), questions)
        for done in (True, False)
    )
    assert (solved["right"], solved["problem"]) == (5, "")
    assert {state for state, _ in open_["questions"].values()} == {"not answered"}
    shown = json.loads(notebook_path(folder).read_text(encoding="utf-8"))["cells"]
    (text,) = ["".join(c["source"]) for c in shown if "".join(c["source"]).startswith("## Quiz")]
    assert all(f"**{question.number}.** {question.text}" in text for question in questions)
    assert not any(choice.says and choice.says in text for q in questions for choice in q.choices)
