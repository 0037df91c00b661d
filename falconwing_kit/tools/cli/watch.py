"""falconwing watch: run the nominal model along a live or recorded flight; alarm, then name."""

import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import Model, rates_model, scale_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.gap import (
    Monitor,
    NominalModel,
    Row,
    WatchEvent,
    build_monitor,
    build_nominal_model,
    nominal_model_from_file,
    rows_table,
    stream_rows,
    table_rows,
)
from falconwing_kit.gap import (
    Watch as FlightWatch,
)
from falconwing_kit.sysid.identify import identify
from falconwing_kit.sysid.model_file import read_model
from falconwing_kit.tools.cli.show import json_line, next_line

LEARNING_S = 40.0  # of the flight itself, taken as healthy, where there is no baseline flight


@dataclass(frozen=True)
class Watch:
    """Run the nominal model along a flight, row by row: an alarm as soon as the aircraft no longer
    flies as modelled, and a name for what is missing some seconds later.

    FLIGHT is a flight table (CSV), which is replayed, or - for rows on standard input as they are
    written, header first: `logger | falconwing watch - --calm calm.csv`. Exit code 0 when nothing
    was found, 1 after an alarm. Ctrl-C ends the watch with its summary.
    """

    flight: Annotated[str, tyro.conf.Positional]
    """flight table (CSV), or - for standard input"""
    calm: tuple[Path, ...] = ()
    """baseline flights of the same aircraft (CSV), a minute or two each"""
    model: Path | None = None
    """model file of the aircraft; without --calm the first 40 s of FLIGHT, taken as healthy, give
    the process noise
    """
    airframe: Path | None = None
    """an airframe file: start from the 150 g aircraft scaled to its mass, wing area and span"""
    false_alarm_hours: float = 1.0
    """wanted mean time between false alarms [h]"""
    json: bool = False
    """print JSON, one object per line, instead of text"""

    def run(self) -> int:
        """Build the monitor from the baseline, watch, print events as they happen.

        Returns:
            0 where nothing was found, 1 after an alarm.

        Raises:
            FileNotFoundError: there is no such flight or model.
            InputError: a flight cannot be used, or neither --calm nor --model is given.
        """
        if not self.calm and self.model is None:
            raise InputError(
                "watch: expected --calm CSV or --model MODEL, got neither; record a flight with "
                "nothing changed and give it as --calm"
            )
        if self.calm and self.model is not None and self.airframe is not None:
            raise InputError("--airframe: expected no --model beside it, got both; drop one")
        rows = self._rows()
        if self.calm:
            tables = [read_flight_table(path) for path in self.calm]
            self._say(0.0, "start", "identifying the baseline flight")
            base = build_nominal_model(identify(tables, model=self._start()))
        else:
            base, tables, rows = self._learn(rows)
        monitor = build_monitor(base, tables, 3600.0 * self.false_alarm_hours)
        return self._watch(monitor, rows)

    def _rows(self) -> Iterator[Row]:
        """Rows of the file, checked as a whole, or of standard input as they arrive."""
        if self.flight == "-":
            return stream_rows(sys.stdin.buffer, self._warn)
        return table_rows(read_flight_table(self.flight))

    def _start(self) -> Model | None:
        if self.model is not None:
            return read_model(self.model).model
        if self.airframe is None:
            return None
        airframe = load_airframe(self.airframe)
        return scale_model(rates_model(), airframe.mass, airframe.wing_area, airframe.span)

    def _learn(self, rows: Iterator[Row]) -> tuple[NominalModel, list[FlightTable], Iterator[Row]]:
        """Process noise from the first seconds of the flight, whose rows are then watched too."""
        assert self.model is not None
        file = read_model(self.model)
        self._say(
            0.0, "start",
            f"the first {LEARNING_S:.0f} s are taken as healthy and give the process noise",
        )  # fmt: skip
        first: list[Row] = []
        for row in rows:
            if not first or row.t > first[-1].t:
                first.append(row)
            if first and row.t - first[0].t >= LEARNING_S:
                break
        else:
            raise InputError(
                f"{self.flight}: expected more than {LEARNING_S:.0f} s of flight to learn the "
                "process noise from, got less; give a baseline flight as --calm"
            )
        table = rows_table(first, "the first seconds")
        return nominal_model_from_file(file, table), [table], chain(first, rows)

    def _watch(self, monitor: Monitor, rows: Iterable[Row]) -> int:
        watch, spent = FlightWatch(monitor), 0.0
        self._say(
            0.0, "start",
            f"watching {self.flight if self.flight != '-' else 'standard input'}; thresholds "
            f"{monitor.step_threshold:.0f} (step) and {monitor.spread_threshold:.0f} (spread) for "
            f"a false alarm every {self.false_alarm_hours:g} h",
        )  # fmt: skip
        interrupted = False
        try:
            for row in rows:
                began = time.process_time()
                events = watch.update(row)
                if watch.naming is None:
                    spent += time.process_time() - began
                for event in events:
                    self._event(event)
        except KeyboardInterrupt:
            interrupted = True
        for event in watch.finish():
            self._event(event)
        self._end(watch, spent, interrupted)
        return 1 if watch.alarm else 0

    def _end(self, watch: FlightWatch, spent: float, interrupted: bool) -> None:
        seconds = watch.seconds
        ms = 1e3 * spent / max(watch.rows, 1)
        verdict = "no alarm" if watch.alarm is None else f"alarm at {watch.alarm.t:.2f} s"
        text = (
            f"{'interrupted; ' if interrupted else ''}{watch.rows} rows, {seconds:.1f} s: {verdict}"
            f"; {ms:.1f} ms of one core a row, {seconds / max(spent, 1e-9):.0f} times faster than "
            "real time"
        )
        if watch.skipped:
            text += f"; {watch.skipped} rows skipped, since their time did not increase"
        self._say(
            watch.last_time, "end", text, rows=watch.rows, seconds=seconds, ms_per_row=ms,
            alarm=watch.alarm.t if watch.alarm else None, skipped=watch.skipped,
        )  # fmt: skip
        if not self.json:
            next_line(self._next(watch))

    def _next(self, watch: FlightWatch) -> str:
        if watch.alarm is None:
            return "nothing to do; the aircraft flies as modelled"
        if not watch.named:
            return "fly on for half a minute with all controls moving, and watch that flight"
        calm = self.calm[0] if self.calm else "CALM.csv"
        flight = self.flight if self.flight != "-" else "FLIGHT.csv"
        return f"falconwing gap --calm {calm} --flight {flight} --out gap"

    def _event(self, event: WatchEvent) -> None:
        self._say(event.t, event.kind, event.text, **event.details)

    def _say(self, t: float, kind: str, text: str, **details: object) -> None:
        """One event on one line, at once: a reader of the pipe waits for it."""
        if self.json:
            print(json_line({"t": t, "event": kind, "text": text, **details}), flush=True)
        else:
            print(f"{t:8.2f} s  {kind}: {text}", flush=True)

    def _warn(self, text: str) -> None:
        print(f"warning: {text}", file=sys.stderr)
