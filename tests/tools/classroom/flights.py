"""Flights of the classroom for tests, flown by the kit's own loop and written to real logs."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.flight.loop import Loop, LoopStep
from falconwing_kit.flight.sources import MeasuredStates, fpv_camera
from falconwing_kit.flight.tasks import TASKS
from falconwing_kit.tools.classroom.results import FlightRecord, model_with_effects

SEED = 10_000


def fly_log(
    path: Path, task: str = "landing", manoeuvre: str = "", seed: int = SEED, *,
    hands: Sequence[tuple[float, str, str]] = (), duration: float | None = None,
    effects: Sequence[tuple[float, str, bool, Mapping[str, float]]] = (), bend: float = 0.0,
    metadata: Mapping[str, object] | None = None, pilot=None,
) -> tuple[FlightRecord, dict]:  # fmt: skip
    """Fly the expert, log it as the classroom does, and return the record and the live measures.

    hands: (t, holder, name); effects: (t, name, on, parameters), each noted in the step at t;
    bend: added to the aileron, so that the flight misses.
    """
    maker = TASKS[task]
    made = maker.make(*((manoeuvre or maker.manoeuvre,) if maker.manoeuvre else ()))
    trial = made.trial(seed)
    judge = made.judge(trial, fpv_camera())
    expert = (pilot or made.expert)(trial)
    active: dict[str, Mapping[str, float]] = {}

    class Bent:
        mode = ""

        def act(self, observation):
            from dataclasses import replace

            command = expert.act(observation)
            return replace(command, aileron=max(-1.0, min(1.0, command.aileron + bend)))

    with FlightLogWriter(path) as log:
        log.metadata(
            {
                "simulated": "yes", "task": task, "seed": seed, "scene": "arena", "port": "",
                "manoeuvre": manoeuvre or maker.manoeuvre, "pilot": "expert", **(metadata or {}),
            }
        )  # fmt: skip

        def note(step: LoopStep) -> None:
            for t, holder, name in hands:
                if abs(t - step.t) < 1e-6:
                    log.event(step.t, "hands", {"holder": holder, "name": name, "reason": "asked"})
            for t, name, on, parameters in effects:
                if abs(t - step.t) < 1e-6:
                    details = {"name": name, "on": on, "parameters": dict(parameters)}
                    log.event(step.t, "effect", details)
                    active.pop(name, None)
                    if on:
                        active[name] = parameters
                    trial.world.change_model(model_with_effects(made.model, active))

        loop = Loop(
            Bent() if bend else expert, trial.world, None, MeasuredStates(trial.world),
            trial.leader, log=log, hooks=(note,),
        )  # fmt: skip
        loop.run(duration or trial.duration, judge.watch)
    holders = tuple(dict.fromkeys(name for _, _, name in hands)) or ("expert",)
    record = FlightRecord(
        1, path, task, manoeuvre or maker.manoeuvre, "arena", seed, "expert", holders, ()
    )
    return record, judge.result()


def edit_log(source: Path, target: Path, change) -> Path:
    """Copy a log; `change` gets the topic and the record of each JSON message and may alter it."""
    from mcap.writer import Writer

    from falconwing_kit.core.flight_log import read_mcap_records

    with target.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="falconwing")
        topics = {}
        for record in read_mcap_records(source, []):
            kind = type(record).__name__
            if kind == "Channel":
                number = writer.register_channel(record.topic, record.message_encoding, 0)
                topics[record.id] = record.topic, number
            elif kind == "Metadata":
                writer.add_metadata(record.name, record.metadata)
            elif kind == "Message":
                topic, number = topics[record.channel_id]
                if topic not in ("/command", "/state", "/event"):
                    continue
                values = json.loads(record.data)
                change(topic, values)
                data = json.dumps(values).encode()
                writer.add_message(number, record.log_time, data, record.publish_time)
        writer.finish()
    return target
