"""The command `falconwing`: a verb and its words in, that verb's work done, its exit code out.

Exit codes: 0 done, 1 the answer is no, 2 wrong use, 130 interrupted.
"""

import difflib
import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from typing import TextIO

from falconwing_kit import __version__

# Before NumPy is loaded: its threads only get in each other's way on arrays of this kit's size.
for _library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_library, "1")

# Verb, file of this folder, class, what it does. Only the chosen file is imported. A verb is a
# frozen dataclass whose fields are its options and whose `run()` returns the exit code, so Python
# code can call it too.
VERBS: tuple[tuple[str, str, str, str], ...] = (
    ("demo", "demo", "Demo", "land in a splat hall, then study recorded flights, one of them real"),
    ("doctor", "doctor", "Doctor", "say what works on this machine and how to mend the rest"),
    ("size", "size", "Size", "minimum speed, turn radius and mass budget of an airframe"),
    ("scene", "scene_steps", "Scene", "make scenes: the arena, from photos, edited; inspect them"),
    ("render", "scene", "Render", "make an image of a Gaussian scene"),
    ("fly", "fly", "Fly", "fly a task in simulation, once to look at or often to count"),
    ("poses", "video", "Poses", "read a flight's states off its onboard video, for identify"),
    ("identify", "identify", "Identify", "fit the aircraft model to recorded flights"),
    ("gap", "gap", "Gap", "say where a flight disagrees with the model and what is missing"),
    ("bridge", "bridge", "Bridge", "watch the board: state, counters, delay, pilot's sticks"),
    (
        "record",
        "bridge",
        "Record",
        "log a manual flight: the pilot's sticks and the camera's images",
    ),
    ("find-port", "bridge", "FindPort", "list the boards on this machine's serial ports"),
    ("calibrate", "calibrate", "Calibrate", "learn a radio's microseconds, order and directions"),
    ("firmware", "firmware", "Firmware", "build the board's program, or test it in simulation"),
    ("export", "logs", "Export", "turn a flight log into a table, a whole log or a ROS bag"),
    ("replay", "logs", "Replay", "show a flight log again, live or as figures"),
    ("check", "check", "Check", "run a lab's public checks on your notebook"),
    ("labs", "labs", "Labs", "build the labs' notebooks, hand them out, test them"),
    ("grade", "grade", "Grade", "grade a class, every function in a box of its own"),
    ("report", "report", "Report", "gradebook, feedback, statistics and rubric of a class"),
    ("sandbox", "grade", "Sandbox", "try to get out of the grader's box"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        arguments: the words after `falconwing`; None takes them from the command line.

    Returns:
        The exit code. Options that the verb does not know end in SystemExit(2) and its `--help` in
        SystemExit(0).
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(help_text())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"falconwing {__version__}")
        return 0
    chosen = next((verb for verb in VERBS if verb[0] == words[0]), None)
    if chosen is None:
        return _refuse(
            f"{words[0]!r} is not a verb of falconwing{_suggestion(words[0])}; see `falconwing --help`"
        )
    return _run_verb(*chosen[:3], words[1:])


def help_text() -> str:
    """The list of verbs.

    Returns:
        The text of `falconwing --help`.
    """
    width = max(len(name) for name, *_ in VERBS)
    lines = [f"  {name:<{width}}  {summary}" for name, _, _, summary in VERBS]
    head = ["usage: falconwing VERB [options]", "", "verbs (falconwing VERB --help says more):"]
    tail = ["", "exit codes: 0 done, 1 the answer is no, 2 wrong use"]
    return "\n".join([*head, *lines, *tail])


def _run_verb(name: str, module: str, class_name: str, words: list[str]) -> int:
    """Import the verb, let tyro fill its fields from the words, run it and turn errors into one
    sentence.
    """
    import tyro

    from falconwing_kit.core.checks import InputError

    with warnings.catch_warnings():
        warnings.showwarning = _print_warning
        try:
            verb = getattr(
                importlib.import_module(f"falconwing_kit.tools.cli.{module}"), class_name
            )
            # Without pairs a switch is `--json`, not `--json` and `--no-json`.
            settings = tyro.cli(
                verb, prog=f"falconwing {name}", args=words, config=(tyro.conf.FlagCreatePairsOff,)
            )
            return int(settings.run())
        except InputError as error:
            return _refuse(str(error))
        except BrokenPipeError:  # `falconwing ... | head` closed our output, which is no error
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except OSError as error:
            return _refuse(
                f"{error.filename}: {error.strerror}"
                if error.filename and error.strerror
                else str(error)
            )
        except ModuleNotFoundError as error:
            return _refuse(
                f"the library {error.name} is not installed; `falconwing doctor` says how to mend it"
            )
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130


def _suggestion(word: str) -> str:
    """A hint at the verb that was meant, or nothing."""
    close = difflib.get_close_matches(word, [name for name, *_ in VERBS], n=1)
    return f", perhaps you meant {close[0]!r}" if close else ""


def _refuse(sentence: str) -> int:
    """Print why the verb did not run; the exit code of wrong use."""
    print(f"falconwing: {sentence}", file=sys.stderr)
    return 2


def _print_warning(
    message: Warning | str,
    category: type,
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """A warning as one line for a person, without file and line number; the signature is the
    standard library's.
    """
    print(f"warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
