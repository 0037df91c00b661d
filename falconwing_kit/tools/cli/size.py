"""falconwing size: minimum speed, turn radius and mass budget of an airframe."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import (
    Airframe,
    builder_airframe_path,
    load_airframe,
    scaling_sentence,
)
from falconwing_kit.aircraft.sizing import (
    largest_mass,
    level_turn_bank,
    level_turn_radius,
    level_turn_speed,
    load_factor,
    minimum_speed,
    paper_turn_radius,
    unlisted_mass,
    wing_loading,
)
from falconwing_kit.core.checks import require_range
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.tools.cli.size_parts import as_parts, parts_record, print_parts
from falconwing_kit.tools.hardware.parts import Item, load_parts, roll_up
from falconwing_kit.tools.hardware.parts_check import find_problems

LIMITS = {  # of the options: from an insect to a large drone; more is a slip of the unit
    "mass_g": (0.1, 1e6),
    "wing_area_m2": (1e-5, 100.0),
    "cl_max": (0.01, 10.0),
    "bank_deg": (0.1, 89.9),
    "hall_width_m": (0.1, 1e5),
}
# Marker, mass and meaning. The paper states 300 g with a 174 g onboard computer; the sum is 324 g.
_PAPER_MASSES = (
    ("o", 150.0, "the paper's aircraft"),
    ("s", 300.0, "the paper's sum of 150 + 174 g"),
    ("^", 324.0, "150 + 174 g"),
)


@dataclass(frozen=True)
class Size:
    """Compute minimum speed, turn radius and the maximum mass of an aircraft for a hall.

    Exit code 1 when a full circle is wider than the hall, or when a parts list breaks mass,
    balance, camera place or propeller clearance.
    """

    mass_g: float | None = None  # mass as flown; the airframe file's if not given
    wing_area_m2: float | None = None  # instead of the airframe file's
    cl_max: float | None = None  # maximum lift coefficient, instead of the airframe file's
    bank_deg: float | None = None  # bank of the turn, instead of the airframe file's
    hall_width_m: float = 20.0  # the circle must fit across it
    margin_m: float = 0.0  # part of the width that must stay free
    hold_height: bool = False  # decide by the level turn, not by the paper's formula
    airframe: Path | None = None  # airframe file; the paper's aircraft, with --parts the builder's
    parts: str | None = None  # parts list for mass, balance and cost: "kit" or a CSV file
    json: bool = False  # print JSON instead of tables
    out: Path | None = None  # folder for the figure and the JSON

    def run(self) -> int:
        """Size the aircraft, print the results and write them under `out`.

        Returns:
            0 if the aircraft fits the hall and its parts fit it, else 1.

        Raises:
            InputError: a number is out of range, or the airframe file is invalid.
            FileNotFoundError: there is no airframe file.
        """
        items = (
            None if self.parts is None else load_parts(None if self.parts == "kit" else self.parts)
        )
        airframe = self._aircraft(items)
        record = sizing_record(airframe, self.hall_width_m, self.margin_m)
        turn = record["level_turn" if self.hold_height else "paper_turn"]
        fits, problems = bool(turn["fits"]), tuple[str, ...]()
        if items is not None:
            record |= parts_record(items, airframe, load_airframe(self.airframe).mass)
            problems = find_problems(items, airframe, turn["largest_mass_g"] / 1000.0)
            record["problems"] = list(problems)
        record["fits"] = fits
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.out / "size.json", text=True) as handle:
                handle.write(json.dumps(record, indent=2, allow_nan=False) + "\n")
            draw_sizing(self.out / "size.png", airframe, self.hall_width_m, self.margin_m)
        if self.json:
            print_json(record)
        else:
            if sentence := scaling_sentence(airframe):
                print(sentence + "\n")
            _print_record(record, self.out)
        return 0 if fits and not problems else 1

    def _aircraft(self, items: Sequence[Item] | None = None) -> Airframe:
        """The airframe of the file with the changes of the parts list and the options."""
        for option, (low, high) in LIMITS.items():
            value = getattr(self, option)
            if value is not None:
                require_range("--" + option.replace("_", "-"), value, low=low, high=high)
        if items is None or self.airframe is not None:
            airframe = load_airframe(self.airframe)
        else:
            airframe = load_airframe(builder_airframe_path())
        if items is not None:
            airframe = replace(airframe, mass=roll_up(items).mass, parts=as_parts(items))
        return replace(
            airframe,
            mass=airframe.mass if self.mass_g is None else self.mass_g / 1000.0,
            wing_area=airframe.wing_area if self.wing_area_m2 is None else self.wing_area_m2,
            bank_limit=airframe.bank_limit
            if self.bank_deg is None
            else math.radians(self.bank_deg),
            aero=airframe.aero
            if self.cl_max is None
            else replace(airframe.aero, CL_max=self.cl_max),
        )


def sizing_record(airframe: Airframe, hall_width: float, margin: float = 0.0) -> dict[str, Any]:
    """All results of `falconwing size`, as they go to JSON.

    Args:
        airframe: its mass and bank limit are used.
        hall_width: [m], > 0.
        margin: part of the width that must stay free [m], >= 0.

    Returns:
        Numbers and texts, units in the names.

    Raises:
        InputError: the margin is negative or not less than the width.
    """
    mass, bank = airframe.mass, airframe.bank_limit
    heaviest = [
        float(largest_mass(hall_width, airframe, margin=margin, hold_height=hold))
        for hold in (False, True)
    ]
    needed = float(level_turn_bank(mass, airframe, (hall_width - margin) / 2.0))
    return {
        "name": airframe.name,
        "mass_g": _grams(mass),
        "bank_deg": round(math.degrees(bank), 6),
        "hall_width_m": hall_width,
        "margin_m": margin,
        "wing_loading_n_per_m2": float(wing_loading(mass, airframe)),
        "minimum_speed_m_per_s": float(minimum_speed(mass, airframe)),
        "paper_turn": {
            "speed_m_per_s": float(minimum_speed(mass, airframe)),
            "load_factor": 1.0,
            "radius_m": float(paper_turn_radius(mass, airframe)),
            "largest_mass_g": _grams(heaviest[0]),
            "fits": mass <= heaviest[0],
        },
        "level_turn": {
            "speed_m_per_s": float(level_turn_speed(mass, airframe)),
            "load_factor": float(load_factor(bank)),
            "radius_m": float(level_turn_radius(mass, airframe)),
            "largest_mass_g": _grams(heaviest[1]),
            "fits": mass <= heaviest[1],
            "bank_needed_deg": None if math.isnan(needed) else math.degrees(needed),
        },
        "parts": [
            {"name": p.name, "mass_g": _grams(p.mass), "inside": p.inside} for p in airframe.parts
        ],
        "parts_mass_g": _grams(airframe.parts_mass),
        "unlisted_mass_g": _grams(unlisted_mass(airframe)),
        "scaled": list(airframe.scaled),
        "contradictions": list(airframe.contradictions),
    }


def _grams(mass: float) -> float:
    return round(1000.0 * mass, 6)  # to a microgram: 9 g would print as 9.000000000000002


def draw_sizing(path: Path, airframe: Airframe, hall_width: float, margin: float = 0.0) -> None:
    """Draw minimum speed and turn radius over mass, with the hall's limit and the paper's masses.

    Args:
        hall_width: [m], > 0.
        margin: part of the width that must stay free [m], >= 0.
    """
    from matplotlib.figure import Figure

    own_g = 1000.0 * airframe.mass
    points = [
        ("D", own_g, "this aircraft"),
        *(point for point in _PAPER_MASSES if abs(point[1] - own_g) > 0.5),
    ]
    largest_g = 1.15 * max(point[1] for point in points)
    bank = f"{math.degrees(airframe.bank_limit):.3g} deg bank"
    mass = np.linspace(0.1, 1.0, 200) * largest_g / 1000.0
    figure = Figure(figsize=(7.2, 7.2), layout="constrained")
    speed, radius = figure.subplots(2, 1, sharex=True)
    title = f"{airframe.name}: minimum speed and turn radius over mass"
    speed.set_title(title, loc="left", fontsize=11)
    speed.plot(1000.0 * mass, minimum_speed(mass, airframe), color="0.1")
    speed.set(ylabel="minimum speed [m/s]", ylim=(0.0, None), xlim=(0.0, largest_g))
    radius.plot(
        1000.0 * mass,
        level_turn_radius(mass, airframe),
        "--",
        color="0.1",
        label=f"level turn, {bank}",
    )
    radius.plot(
        1000.0 * mass,
        paper_turn_radius(mass, airframe),
        color="0.1",
        label=f"paper's formula, {bank}",
    )
    radius.set(ylabel="turn radius [m]", xlabel="mass [g]", ylim=(0.0, None))
    limit, top = (hall_width - margin) / 2.0, radius.get_ylim()[1]
    if limit < top:
        radius.axhspan(limit, top, color="0.9", zorder=0)
        radius.text(
            0.02 * largest_g,
            0.96 * top,
            f"grey: the circle is wider than {hall_width - margin:g} m",
            va="top",
        )
    for axes, law, unit in ((speed, minimum_speed, "m/s"), (radius, paper_turn_radius, "m")):
        for marker, mass_g, what in points:
            value = float(law(mass_g / 1000.0, airframe))
            fill = "0.1" if mass_g == own_g else "white"
            label = f"{mass_g:g} g, {what}: {value:.2f} {unit}"
            axes.plot(
                mass_g,
                value,
                marker,
                color="0.1",
                markerfacecolor=fill,
                markersize=7,
                label=label,
                linestyle="",
            )
        axes.grid(color="0.8", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(loc="lower right", fontsize=9, framealpha=1.0, edgecolor="white")
    with atomic_write(path) as handle:
        figure.savefig(handle, format="png", dpi=150)


def _print_record(record: dict[str, Any], out: Path | None) -> None:
    """Print the tables, a sentence on the fit and the next line."""
    paper, level = record["paper_turn"], record["level_turn"]
    title = f"{record['name']}, {record['mass_g']:g} g, bank {record['bank_deg']:g} deg, "
    title += f"hall {record['hall_width_m']:g} m wide" + (
        f" less {record['margin_m']:g} m" if record["margin_m"] else ""
    )
    rows = [
        (
            "minimum speed, wings level [m/s]",
            record["minimum_speed_m_per_s"],
            record["minimum_speed_m_per_s"],
        ),
        ("wing loading [N/m^2]", record["wing_loading_n_per_m2"], record["wing_loading_n_per_m2"]),
        ("speed in the turn [m/s]", paper["speed_m_per_s"], level["speed_m_per_s"]),
        ("load factor in the turn [-]", paper["load_factor"], level["load_factor"]),
        ("turn radius [m]", paper["radius_m"], level["radius_m"]),
        ("full circle, wall to wall [m]", 2.0 * paper["radius_m"], 2.0 * level["radius_m"]),
        ("maximum mass for the hall [g]", paper["largest_mass_g"], level["largest_mass_g"]),
    ]
    print_table(("quantity", "paper's formula", "level turn"), rows, title=title)
    print()
    parts = [
        (p["name"], p["mass_g"], f"inside {p['inside']}, not added" if p["inside"] else "")
        for p in record["parts"]
    ]
    parts += [("sum of the parts", record["parts_mass_g"], ""), ("aircraft", record["mass_g"], "")]
    missing = record["unlisted_mass_g"]
    if abs(missing) > 0.05:
        remark = (
            "not in the list of parts" if missing > 0 else "the parts are heavier than the aircraft"
        )
        parts.append(("difference", missing, remark))
    if record["parts"]:
        print_table(("part", "mass [g]", "remark"), parts)
        print()
    if "balance" in record:
        print_parts(record)
    free = record["hall_width_m"] - record["margin_m"]
    fits = "fits" if record["fits"] else "does NOT fit"
    print(f"{fits} across {free:g} m. {_level_turn_sentence(level)}")
    for problem in record.get("problems", ()):
        print(problem)
    if out is not None:
        next_line(f"look at {out / 'size.png'}")
    elif record["fits"]:
        next_line(
            "falconwing size --mass-g 324 adds the paper's 174 g onboard computer; "
            "--out DIR draws it"
        )
    else:
        next_line(
            f"falconwing size --mass-g {math.floor(paper['largest_mass_g'])} still fits; "
            "--out DIR draws it"
        )


def _level_turn_sentence(level: dict[str, Any]) -> str:
    """The bank that a level turn needs, as a sentence."""
    if level["bank_needed_deg"] is None:
        return "No bank is steep enough for a level turn."
    return f"A level turn needs a bank of at least {level['bank_needed_deg']:.1f} deg."
