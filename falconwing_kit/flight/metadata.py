"""Metadata of a simulated flight's log: task, trial, scene and pilot -> what was flown, as text.

A log with these facts can be shown in its own scene and judged again: task, manoeuvre and seed give
the world, the logged commands the flight.
"""

import hashlib
import json

import falconwing_kit
from falconwing_kit.aircraft.model import Model
from falconwing_kit.flight.trial import FlightTask, TrialSetup

DIGITS = 8  # of a model's digest


def flight_metadata(
    task: FlightTask, trial: TrialSetup, *, scene: str = "", pilot: str = "", port: str = ""
) -> dict[str, str]:
    """Facts about a SIMULATED flight for `FlightLogWriter.metadata`, before its first step.

    Args:
        task: the task.
        trial: its world, at the start.
        scene: name of the hall, or the file of one, as `--scene` takes it.
        pilot: the pilot's name, with the file of its model if it has an own one.
        port: the simulated board that commands go through; empty without one.

    Returns:
        simulated, task, manoeuvre (of the leader; empty without one), scene, seed, pilot, aircraft,
        model, kit_version, start (true state, JSON list of 12), port, p_body_camera (JSON list of
        3 [m]).
    """
    manoeuvre = str(getattr(task, "manoeuvre", ""))
    return {
        "simulated": "yes",
        "task": task.name.removesuffix(manoeuvre).strip(),
        "manoeuvre": manoeuvre,
        "scene": scene,
        "seed": str(trial.seed),
        "pilot": pilot,
        "aircraft": task.airframe.name,
        "model": describe_model(getattr(task, "model", None)),
        "kit_version": falconwing_kit.__version__,
        "start": json.dumps(trial.world.state.vector.tolist()),
        "port": port,
        "p_body_camera": json.dumps([float(x) for x in task.airframe.p_body_camera]),
    }


def describe_model(model: Model | None) -> str:
    """Form and effects of a model, and a digest of its terms and values: "rates, wind; 1a2b3c4d".

    Models of equal terms and values have equal texts. None, an aircraft that another simulator
    flies, gives an empty one.
    """
    if model is None:
        return ""
    parts = [model.form, *(term.name for term in model.terms)]
    parts += [wind.name for wind in model.winds]
    parts += [f"{name}={float(value)!r}" for name, value in sorted(model.values.items())]
    parts += [effect.name for effect in model.effects]
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:DIGITS]
    return f"{', '.join([model.form, *(effect.name for effect in model.effects)])}; {digest}"
