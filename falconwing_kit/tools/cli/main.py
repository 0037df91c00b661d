"""The command `falconwing`: a verb and its options in, that verb run, its exit code out.

Exit codes: 0 done, 1 the answer is no, 2 wrong use, 130 interrupted.

A verb is one file of this folder: `find_port.py` starts with the line
`falconwing find-port: <summary>` and holds `FindPort`, a frozen dataclass whose fields are the
options and whose `run()` returns the exit code, so Python code can call it too.
"""

import difflib
import importlib
import os
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TextIO

from falconwing_kit import __version__

# Set before NumPy is loaded: on arrays of this kit's size its threads cost more than they save.
for _library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_library, "1")


class Verb(NamedTuple):
    """One line of `falconwing --help` and where its code is."""

    name: str  # as typed: "find-port"
    module: str  # file of this folder, without its ending: "find_port"
    class_name: str  # "FindPort"
    summary: str


def find_verbs(folder: Path = Path(__file__).parent) -> tuple[Verb, ...]:
    """The verbs of a folder in alphabetical order, from the first lines of its files.

    The files are read and not imported, which keeps `falconwing --help` fast.
    """
    verbs = []
    for path in sorted(folder.glob("*.py")):
        name = path.stem.rstrip("_").replace("_", "-")  # class_.py, for `class` is no module
        with path.open(encoding="utf-8") as file:
            head = file.read(400)
        found = re.match(
            rf'"""falconwing {re.escape(name)}: (.+?)\.?\s*(?:\n\n|""")', head, re.DOTALL
        )
        if found:
            class_name = "".join(word.capitalize() for word in path.stem.split("_"))
            verbs.append(Verb(name, path.stem, class_name, " ".join(found[1].split())))
    return tuple(verbs)


VERBS = find_verbs()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        arguments: the words after `falconwing`; None takes them from the command line.

    Returns:
        The exit code. An unknown option of a verb ends in SystemExit(2), its `--help` in
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
        hint = _suggestion(words[0])
        return _refuse(f"{words[0]!r} is not a verb of falconwing{hint}; see `falconwing --help`")
    return _run_verb(*chosen[:3], words[1:])


def help_text() -> str:
    """The text of `falconwing --help`."""
    width = max(len(name) for name, *_ in VERBS)
    lines = [f"  {name:<{width}}  {summary}" for name, _, _, summary in VERBS]
    head = ["usage: falconwing VERB [options]", "", "verbs (options: falconwing VERB --help):"]
    tail = ["", "exit codes: 0 done, 1 the answer is no, 2 wrong use"]
    return "\n".join([*head, *lines, *tail])


def _run_verb(name: str, module: str, class_name: str, words: list[str]) -> int:
    """Import the verb, fill its fields from the words with tyro, run it; an error is one line."""
    import tyro

    from falconwing_kit.core.checks import InputError

    with warnings.catch_warnings():
        warnings.showwarning = _print_warning
        try:
            file = importlib.import_module(f"falconwing_kit.tools.cli.{module}")
            settings = tyro.cli(
                getattr(file, class_name),
                prog=f"falconwing {name}",
                args=words,
                # a switch is `--json` alone, without `--no-json`
                config=(tyro.conf.FlagCreatePairsOff,),
            )
            code = int(settings.run())
            sys.stdout.flush()  # here, and not at exit, a closed pipe can still be told
            return code
        except InputError as error:
            return _refuse(str(error))
        except BrokenPipeError:  # `falconwing ... | head` closed our output, which is no error
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        except Exception as error:
            sentence = sentence_of(error)
            if not sentence:
                raise  # a fault of the kit, whose place in the code is needed to mend it
            return _refuse(sentence)


def sentence_of(error: Exception) -> str:
    """One sentence for an error of files, memory or numbers; empty for any other.

    What a verb checks itself has a better sentence; this is the last door.
    """
    if isinstance(error, OSError):
        has_both = error.filename and error.strerror
        return f"{error.filename}: {error.strerror}" if has_both else str(error)
    if isinstance(error, ModuleNotFoundError):
        return f"the library {error.name} is not installed; `falconwing doctor` suggests a fix"
    if isinstance(error, ImportError):
        return (
            f"a library cannot be loaded ({error}); is there memory left? `falconwing doctor`"
            " checks the installation"
        )
    if isinstance(error, MemoryError):
        return "the memory is full; close other programs, or take a smaller input"
    if isinstance(error, RecursionError):
        return "the input is nested too deeply; is it the right file?"
    if isinstance(error, UnicodeDecodeError):
        return f"expected text in UTF-8, got another encoding ({error.reason}); save it as UTF-8"
    if type(error).__name__ == "LinAlgError":  # NumPy's and SciPy's, loaded by the verb
        return (
            f"the numbers cannot be solved for ({error}); is the flight long enough, and do its"
            " values change?"
        )
    if type(error).__name__ == "DecompressionBombError":
        return f"an image is too large ({error}); scale it down"
    return ""


def _suggestion(word: str) -> str:
    """A hint at a verb of similar spelling, or nothing."""
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
    """Print a warning as one line without file and line number (signature of `showwarning`)."""
    print(f"warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
