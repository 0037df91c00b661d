"""Effects: every file of this folder -> the catalogue of effects that the model lacks.

A new effect is one new file here with `EFFECTS`, a tuple of `Effect`, and its test; no other file
names it. A file of the same form outside the kit is tried by `falconwing gap --effects FILE`.
"""

from importlib import import_module
from pkgutil import iter_modules

from falconwing_kit.aircraft.effect import Effect, effect_catalogue

CATALOGUE: tuple[Effect, ...] = effect_catalogue(
    effect
    for file in iter_modules(__path__)
    for effect in import_module(f"{__name__}.{file.name}").EFFECTS
)
EFFECT_NAMES = tuple(dict.fromkeys(effect.name for effect in CATALOGUE))
