"""`falconwing size --parts`: a parts list and an airframe -> tables of balance, options, cost."""

from collections.abc import Sequence
from typing import Any

from falconwing_kit.aircraft.airframe import Airframe, AirframePart
from falconwing_kit.tools.cli.show import print_table
from falconwing_kit.tools.hardware.parts import Item, balance_move, paper_sums, roll_up, with_option

MOVER = "battery"  # the part that is moved to balance the aircraft


def as_parts(items: Sequence[Item]) -> tuple[AirframePart, ...]:
    """The parts of the aircraft, in the form of an airframe file's parts."""
    return tuple(
        AirframePart(i.id, i.mass, i.inside)
        for i in items
        if i.used_in == "aircraft" and i.mass > 0.0
    )


def parts_record(items: Sequence[Item], airframe: Airframe, stated_mass: float) -> dict[str, Any]:
    """All results of `--parts`, as they go to JSON.

    Args:
        items: the list; the first part that contains others is the aircraft as bought, in balance.
        airframe: for the mean chord, the unit of the centre of gravity in per cent.
        stated_mass: mass of the aircraft in its airframe file [kg].

    Returns:
        Numbers and texts, units in the names.

    Raises:
        InputError: no part of the list belongs to the aircraft.
    """
    whole, rows = roll_up(items), []
    for item in items:
        if item.used_in == "option":
            other = roll_up(with_option(items, item.id))
            moved, heavier = 1000.0 * (other.x_cg - whole.x_cg), 1000.0 * (other.mass - whole.mass)
            rows.append(
                {"option": item.id, "for": item.replaces, "mass_g": heavier, "cg_mm": moved}
            )
    holders = {item.inside for item in items if item.inside}
    goal = next((item.x for item in items if item.id in holders), None)
    movable = goal is not None and any(item.id == MOVER for item in items)
    return {
        "balance": {
            "cg_mm": 1000.0 * whole.x_cg,
            "cg_percent_chord": 100.0 * whole.x_cg / airframe.mean_chord,
            "moment_g_mm": 1e6 * whole.moment,
            "as_bought_mm": None if goal is None else 1000.0 * goal,
            "battery_move_mm": 1000.0 * balance_move(items, MOVER, goal)
            if movable and goal is not None
            else None,
            "places": [
                {"part": i.id, "mass_g": 1e3 * i.mass, "x_mm": 1e3 * (i.x or 0.0)}
                for i in items
                if i.counts
            ],
        },
        "options": rows,
        "paper_sums": [
            {
                "reading": words,
                "sum_g": 1000.0 * mass,
                "over_stated_g": 1000.0 * (mass - stated_mass),
            }
            for words, mass in paper_sums(items)
        ],
        "stated_mass_g": 1000.0 * stated_mass,
        "costs_usd": {**whole.costs, "sum": whole.cost},
        "unpriced": list(whole.unpriced),
        "estimated": [i.id for i in items if i.counts and i.mass_source.startswith("estimate")],
    }


def print_parts(record: dict[str, Any]) -> None:
    """Print the tables of `parts_record`."""
    balance = record["balance"]
    rows = [(p["part"], p["mass_g"], p["x_mm"], p["mass_g"] * p["x_mm"]) for p in balance["places"]]
    print_table(("part", "mass [g]", "behind leading edge [mm]", "moment [g mm]"), rows)
    percent = balance["cg_percent_chord"]
    print(
        f"centre of gravity {balance['cg_mm']:.1f} mm behind the leading edge, "
        f"{percent:.0f} % of the mean chord"
    )
    if balance["battery_move_mm"] is not None:
        way = "back" if balance["battery_move_mm"] > 0 else "forward"
        print(
            f"as bought it is at {balance['as_bought_mm']:g} mm; to restore it, move the battery "
            f"{abs(balance['battery_move_mm']):.0f} mm {way}, or the camera nearer to the wing"
        )
    print()
    if record["options"]:
        options = [(o["option"], o["for"], o["mass_g"], o["cg_mm"]) for o in record["options"]]
        print_table(
            ("option", "instead of", "mass [g]", "shift of centre of gravity [mm]"), options
        )
        print()
    sums = [(s["reading"], s["sum_g"], s["over_stated_g"]) for s in record["paper_sums"]]
    print_table(
        ("paper's masses", "sum [g]", f"above the stated {record['stated_mass_g']:g} g"), sums
    )
    print()
    print_table(("cost", "US dollars"), list(record["costs_usd"].items()))
    print(
        f"not included: {', '.join(record['unpriced']) or 'nothing'}; "
        "prices are estimates, except the paper's two"
    )
    print(f"estimated masses: {', '.join(record['estimated']) or 'none'}")
    print()
