"""Judge of the hints: the frozen wrong functions of a lab -> which cause was named, right or wrong.

A named mistake is right if its function and the wrong one agree in twelve or more calls of the
hidden cases, whose arguments the hints never saw (all calls, where a judge makes fewer). A general
finding is right if the frozen kind of the edit is one of those it stands for. Two frozen lists are
judged alike: holdout/generate.py's, and holdout/second.py's of two tokens or more.
"""

import signal
import warnings

from falconwing_kit.tools.grading.hints import Hints, Recorder, load_hints, numbers_of, same_numbers
from falconwing_kit.tools.grading.public_checks import run_checks
from tests.labs.functions import LabHere, library_functions
from tests.labs.holdout.generate import (
    _too_long,
    as_function,
    frozen,
    solution_source,
    wrong_sources,
)
from tests.labs.holdout.second import second, second_sources

SIGNS = {"sign of a term", "sign of a difference", "sign of a whole term", "swapped arguments"}
FACTORS = {"missing factor", "constant", "missing term", "other function", "missing power"}
FACTORS |= {"degrees for radians", "upside down", "no function"}


class Probes:
    """Arguments of an exercise's hidden calls, taken with the solution."""

    def __init__(self, here: LabHere, name: str) -> None:
        self.arguments: list[tuple] = []
        right = here.function(name)

        def taking(*arguments):
            if len(self.arguments) < 30:
                self.arguments.append(arguments)
            return right(*arguments)

        here.score(name, taking)
        self.answers: dict[str, list] = {}

    def of(self, label: str, function) -> list:
        """What a function returns for them."""
        if label not in self.answers:
            found = []
            for arguments in self.arguments:
                try:
                    found.append(numbers_of(function(*arguments)))
                except Exception as error:
                    found.append({"raised": type(error).__name__})
            self.answers[label] = found
        return self.answers[label]


def judged(
    here: LabHere, hints: Hints, rows: list[dict], sources=wrong_sources
) -> list[tuple[str, dict, str]]:
    """For each wrong function of an exercise: "right", "wrong", "silent", and what was said."""
    name = rows[0]["exercise"]
    wrong, probes = sources(solution_source(here, name), name), Probes(here, name)
    named = library_functions(here, name)
    found = []
    for row in rows:
        kind, cause, text = wrong[row["index"]]
        assert (kind, cause) == (row["kind"], row["cause"]), "the solution changed: freeze anew"
        function = as_function(here, name, text)
        signal.signal(signal.SIGALRM, _too_long)
        signal.alarm(10)
        recorder = Recorder(function)
        run_checks(here.lab.exercise(name), recorder)
        said = hints.diagnose(recorder.calls)
        verdict = "silent"
        if said.mistakes:
            got = probes.of(f"holdout {row['index']}", function)
            other = probes.of(said.mistakes[0], named[said.mistakes[0]])
            agree = all(same_numbers(a, b) for a, b in zip(got, other, strict=True))
            verdict = "right" if agree and got else "wrong"
        elif said.cause:
            stands_for = SIGNS if "sign" in said.cause else FACTORS
            verdict = "right" if kind.removesuffix(", everywhere") in stands_for else "wrong"
        signal.alarm(0)
        shown = any(hints.first_difference(key, got) for key, got in recorder.calls)
        found.append((verdict, row | {"shown": shown}, said.cause))
    return found


def judge_lab(folder, keep=lambda row: True, *, second_list=False) -> list[tuple[str, dict, str]]:
    """All frozen wrong functions of a lab, judged; those of the second list on wish."""
    here, hints = LabHere(folder), load_hints(folder)
    listed, sources = (second, second_sources) if second_list else (frozen, wrong_sources)
    rows = [row for row in listed() if row["lab"] == folder.name and keep(row)]
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in dict.fromkeys(row["exercise"] for row in rows):
            of_name = [row for row in rows if row["exercise"] == name]
            found += judged(here, hints[name], of_name, sources)
    return found
