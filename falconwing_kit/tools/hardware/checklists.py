"""Checklists: a TOML file -> steps of bench test and preflight check, for terminal and manual."""

from dataclasses import dataclass
from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import shipped_path

AUTOMATIC = ("", "board", "sticks", "picture")


@dataclass(frozen=True)
class Step:
    """One action with its expected result."""

    id: str
    do: str
    see: str
    if_not: str  # remedy for another result
    stop: bool  # later steps require this one to pass
    automatic: str = ""  # automatic check, one of AUTOMATIC; "" is left to the person
    spoken: bool = False  # said aloud after the program has ended, such as the last before take-off

    def __post_init__(self) -> None:
        if not self.id.isidentifier() or not (self.do and self.see and self.if_not):
            raise InputError(
                f"{self.id!r}: expected an id like camera_voltage, and sentences in do, see, if_not"
            )
        if self.automatic not in AUTOMATIC:
            wanted = ", ".join(AUTOMATIC[1:])
            raise InputError(
                f"{self.id}: automatic: expected one of {wanted} or nothing, got {self.automatic!r}"
            )


@dataclass(frozen=True)
class Checklist:
    """Steps in order."""

    title: str
    steps: tuple[Step, ...]

    def __post_init__(self) -> None:
        ids = [step.id for step in self.steps]
        twice = [name for name in ids if ids.count(name) > 1]
        if not ids or twice:
            raise InputError(f"steps: expected at least one and every id once, got {twice or ids}")
        spoken = [step.spoken for step in self.steps]
        if spoken != sorted(spoken) or all(spoken):
            raise InputError("steps: expected the spoken ones last, and at least one before them")

    @property
    def asked(self) -> tuple[Step, ...]:
        """The steps that the program asks for or checks: all but the spoken ones."""
        return tuple(step for step in self.steps if not step.spoken)


@dataclass(frozen=True)
class Checklists:
    """The checklists of a file."""

    bench: Checklist  # propeller off
    preflight: Checklist  # before each flight


def load_checklists(path: str | Path | None = None) -> Checklists:
    """Read a file of checklists.

    Args:
        path: the TOML file; None takes the kit's own.

    Returns:
        Both lists.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a key is missing or unknown, or a step is incomplete.
    """
    return from_toml(
        Checklists,
        shipped_path("hardware/checklists.toml", "name a file") if path is None else path,
    )
