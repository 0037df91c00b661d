"""Manoeuvres: the `MANOEUVRE` of every file of this folder -> the table of a leader's flights.

To add one, add a file. Its name fixes its random draws, so no other leader changes.
"""

from importlib import import_module
from pkgutil import iter_modules

from falconwing_kit.control.plan import Manoeuvre, manoeuvre_table

MANOEUVRES: dict[str, Manoeuvre] = manoeuvre_table(
    import_module(f"{__name__}.{file.name}").MANOEUVRE for file in iter_modules(__path__)
)
