"""Second judge of the hints: listed wrong functions of a lab -> which cause was named.

Two lists: the solutions written anew with a wrong idea (tests/labs/rewritten), frozen before the
library of mistakes, and the hand-written mistakes (tests/labs/mutants), which judge a library of
mutations alone, built without them. A named mistake is right as in judged_hints.py: its function
and the wrong one agree in all hidden calls, whose arguments the hints never saw.
"""

import importlib
import json
import warnings
from collections.abc import Iterator
from pathlib import Path

from falconwing_kit.tools.grading.hints import Hints, Recorder, parse_hints, same_numbers
from falconwing_kit.tools.grading.hints_library import hints_text
from falconwing_kit.tools.grading.public_checks import run_checks
from tests.labs.functions import INSIDE, LabHere, library_functions, mutants
from tests.labs.judged_hints import Probes

Verdict = tuple[str, str, str, bool]  # right, wrong or silent; exercise; cause; expected shown


def rewritten(here: LabHere) -> Iterator[tuple[str, str, str, object]]:
    """Exercise, idea, kind and function of each solution written anew."""
    listed = importlib.import_module(f"tests.labs.rewritten.{here.lab.name}").REWRITTEN
    for name, rows in listed.items():
        cell = next(each for each in here.cells if each.name == name and each.kind == "exercise")
        body = INSIDE.search(cell.text)[1]
        for idea, kind, text in rows:
            yield name, idea, kind, here.function(name, body, text.lstrip("\n"))


def by_hand(here: LabHere) -> Iterator[tuple[str, str, str, object]]:
    """Exercise, name, "form" and function of each hand-written mistake."""
    for name, rows in mutants(here.lab).items():
        for cause, old, new in rows:
            yield name, cause, "form", here.function(name, old, new)


def judge(here: LabHere, hints: dict[str, Hints], cases) -> list[Verdict]:
    """All cases of a lab, judged."""
    found, known, probes = [], {}, {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for number, (name, idea, kind, function) in enumerate(cases):
            if name not in known:
                known[name], probes[name] = library_functions(here, name), Probes(here, name)
            recorder = Recorder(function)
            run_checks(here.lab.exercise(name), recorder)
            said = hints[name].diagnose(recorder.calls)
            verdict = "silent"
            if said.mistakes:
                got = probes[name].of(f"case {number}", function)
                other = probes[name].of(said.mistakes[0], known[name][said.mistakes[0]])
                agree = all(same_numbers(a, b) for a, b in zip(got, other, strict=True))
                verdict = "right" if agree and got else "wrong"
            elif said.cause:  # a relation to the right answers
                general = "sign" if "sign" in said.cause else "factor"
                verdict = "right" if kind == general else "wrong"
            shown = any(hints[name].first_difference(key, got) for key, got in recorder.calls)
            found.append((verdict, name, f"{idea} | {said.cause}", shown))
    return found


def judge_rewrites(folder: Path, hints: dict[str, Hints]) -> list[Verdict]:
    """The solutions written anew, by the lab's stored hints."""
    here = LabHere(folder)
    return judge(here, hints, rewritten(here))


def judge_mutations_alone(folder: Path) -> list[Verdict]:
    """The hand-written mistakes, by a library that is built without them."""
    here = LabHere(folder)
    hints = parse_hints(json.loads(hints_text(folder, listed=False)))
    return judge(here, hints, by_hand(here))
