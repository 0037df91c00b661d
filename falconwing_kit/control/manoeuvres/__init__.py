"""Manoeuvres: every file of this folder -> one entry of the table of what a leader can fly.

A new manoeuvre is one new file here with a `MANOEUVRE`; its name fixes its draws, so it changes no
other leader.
"""

from importlib import import_module
from pkgutil import iter_modules

from falconwing_kit.control.plan import Manoeuvre, manoeuvre_table

MANOEUVRES: dict[str, Manoeuvre] = manoeuvre_table(
    import_module(f"{__name__}.{file.name}").MANOEUVRE for file in iter_modules(__path__)
)
