"""falconwing gap: locate where a flight disagrees with the model and name what is missing."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import load_airframe, scaling_sentence
from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.user_file import CODE_NOTICE, load_effects
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.model_file import read_model
from falconwing_kit.tools.bridge.flight_file import read_flight
from falconwing_kit.tools.cli.show import next_line, print_json, print_table


@dataclass(frozen=True)
class Gap:
    """Find where a flight disagrees with the calm aircraft, name the missing effect, and show the
    gap close.

    Writes report.json, report.html, its figures, model.toml and, where an effect is named,
    model_with_effect.toml; `falconwing fly --model` flies with either. Exit code 0 when an effect
    is named or nothing is missing, 1 when the answer is ambiguous or outside the catalogue.
    """

    calm: tuple[Path, ...]
    """baseline flights of the aircraft with nothing changed, a minute or two each: flight tables
    (CSV), or logs as export reads them
    """
    flight: Path
    """a flight of the same aircraft when something was different, in the same form"""
    out: Path
    """folder for page, figures, record and models; made where it is missing"""
    effects: Path | None = None
    """Python file with EFFECTS = [...], tried beside the catalogue; it is code that runs with your
    rights
    """
    airframe: Path | None = None
    """an airframe file (mass_g, wing_area_m2, span_m): the fit starts from the 150 g aircraft
    scaled to it; without one, scaled to the speed flown
    """
    model: Path | None = None
    """a model file that the fit of the baseline starts from"""
    sigma: tuple[float, float] | None = None
    """noise of the poses, in metres and degrees; estimated if not given"""
    improve: bool = False
    """write model_improved.toml too: the best model of the aircraft as it is now"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Study both flights, write the report and print the answer.

        Returns:
            0 where the verdict is named or none, 1 where it is ambiguous or outside.

        Raises:
            FileNotFoundError: there is no such flight.
            InputError: a flight or the file of effects cannot be used, or the folder is a file.
        """
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        if not self.calm:
            raise InputError("--calm: expected at least one flight table, got none")
        if self.airframe is not None and self.model is not None:
            raise InputError("gap: expected --airframe or --model, got both; drop one")
        effects = self._effects()
        calm = [read_flight(path) for path in self.calm]
        record = self._study(calm, read_flight(self.flight), effects)
        page = self.out / "report.html"
        if self.json:
            print_json({**record, "page": str(page)})
        else:
            print_gap(record)
            print(f"page: {page}")
            next_line(record["next_flight"])
        return 0 if record["verdict"] in ("named", "none") else 1

    def _effects(self) -> tuple[Effect, ...]:
        if self.effects is None:
            return ()
        print(CODE_NOTICE.format(file=self.effects), file=sys.stderr)
        return load_effects(self.effects)

    def _study(
        self, calm: list[FlightTable], flight: FlightTable, effects: tuple[Effect, ...]
    ) -> dict[str, Any]:
        from tqdm import tqdm

        from falconwing_kit.tools.reports.gap_report import gap_report

        with tqdm(
            bar_format="{desc} {elapsed}", leave=False, disable=True if self.json else None
        ) as bar:
            return gap_report(
                calm if len(calm) > 1 else calm[0], flight, self.out, bar.set_description_str,
                effects, **self._start(),
            )  # fmt: skip

    def _start(self) -> dict[str, Any]:
        """Airframe, model, noise and --improve, as `gap_report` takes them; nothing by default."""
        start: dict[str, Any] = {"improve": True} if self.improve else {}
        if self.airframe is not None:
            airframe = load_airframe(self.airframe)
            start["airframe"] = airframe
            if sentence := scaling_sentence(airframe):
                print(sentence, file=sys.stderr)
        if self.model is not None:
            start["model"] = read_model(self.model).model
        if self.sigma is not None:
            position = require_range("--sigma", self.sigma[0], low=1e-4, high=10.0)
            attitude = require_range("--sigma", self.sigma[1], low=1e-3, high=60.0)
            start["sigma"] = np.array([position] * 3 + [np.radians(attitude)] * 3)
        return start


def print_gap(record: dict[str, Any]) -> None:
    """Print the answer as tables.

    Args:
        record: as of gap.report.gap_record.
    """
    print(f"verdict: {record['verdict']}. {record['headline']}")
    sizes = [
        (name, p["value"], p["low95"], p["high95"], p["unit"])
        for name, p in record["parameters"].items()
    ]
    if sizes:
        print_table(("parameter", "value", "low 95 %", "high 95 %", "unit"), sizes)
    print()
    best = [(r["effect"], r["gain"], r["probability"]) for r in record["ranking"][:4]]
    print_table(
        ("effect", "evidence", "probability"),
        best,
        title=f"evidence, {record['threshold']:.0f} needed",
    )
    print()
    rmse = record["gap_rmse"]
    rows = [
        (label, record["gap"][key], rmse["position_m"][key], rmse["attitude_deg"][key])
        for key, label in (
            ("before", "without the effect"),
            ("after", "with what was found"),
            ("calm", "calm flight"),
        )
    ]
    print_table(
        ("2 s ahead, held-out", "chi2 per dof", "position [m]", "attitude [deg]"), rows,
    )  # fmt: skip
    for sentence in record["warnings"]:
        print(f"warning: {sentence}")
