"""Parts list: a CSV of bought and printed parts -> mass, centre of gravity, costs, paper's sums.

Positions are in millimetres behind the wing's leading edge at the root, as usual for model
aircraft: negative ahead of the wing.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError, require_file, require_range
from falconwing_kit.core.files import read_text, shipped_path, short_name

COLUMNS = (
    "id",
    "part",
    "quantity",
    "unit_mass_g",
    "mass_source",
    "x_mm",
    "price_usd",
    "price_source",
    "used_in",
    "inside",
    "replaces",
    "paper_value",
    "alternatives",
)
USES = ("aircraft", "option", "ground", "tools", "spares")
ORIGINS = ("paper", "data sheet", "drawing", "measured", "estimate", "not counted")
ROUNDING = 1e-9


@dataclass(frozen=True)
class Item:
    """One row of the list."""

    id: str
    part: str
    quantity: int
    unit_mass: float | None  # [kg]; None if not on the aircraft
    mass_source: str  # one of ORIGINS, and a remark after a colon
    # behind the wing's leading edge at the root [m]; None inside another part or on the ground
    x: float | None
    price: float | None  # of one [US dollars]; None if not counted
    price_source: str  # as mass_source
    used_in: str  # one of USES
    inside: str  # id of the part whose mass includes this one's; empty for none
    replaces: str  # of an option: id of the replaced part
    paper_value: str  # the paper's mass or price: "137 g", "$80", or empty
    alternatives: str

    @property
    def mass(self) -> float:
        """Mass of the whole quantity [kg]; 0 if not on the aircraft."""
        return 0.0 if self.unit_mass is None else self.quantity * self.unit_mass

    @property
    def counts(self) -> bool:
        """Whether its mass is added to the aircraft's."""
        return self.used_in == "aircraft" and not self.inside

    @property
    def paper_mass(self) -> float | None:
        """The paper's mass of one [kg], or None."""
        return (
            float(self.paper_value.removesuffix(" g")) / 1000.0
            if self.paper_value.endswith(" g")
            else None
        )

    @property
    def paper_price(self) -> float | None:
        """The paper's price of one [US dollars], or None."""
        return float(self.paper_value[1:]) if self.paper_value.startswith("$") else None


@dataclass(frozen=True)
class RollUp:
    """Sums over the parts."""

    mass: float  # of the aircraft [kg]
    x_cg: float  # its centre of gravity, behind the wing's leading edge at the root [m]
    costs: dict[str, float]  # by use [US dollars], without options
    unpriced: tuple[str, ...]  # ids of parts without a price

    @property
    def moment(self) -> float:
        """Moment about the wing's leading edge [kg m], positive tail-heavy."""
        return self.mass * self.x_cg

    @property
    def cost(self) -> float:
        """Total cost [US dollars]."""
        return math.fsum(self.costs.values())


def load_parts(path: str | Path | None = None) -> tuple[Item, ...]:
    """Read a list of parts.

    Args:
        path: the CSV file with the columns of COLUMNS; None takes the kit's own.

    Returns:
        A record per row.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a column, a cell or a reference is wrong, or a mass or price "paper" is not the
            paper's.
    """
    path = shipped_path("hardware/parts.csv", "name a file") if path is None else require_file(path)
    name = short_name(path)
    try:
        rows = list(csv.reader(read_text(path).splitlines(), strict=True))
    except csv.Error as error:
        raise InputError(f"{name}: expected a CSV: {error}") from None
    if not rows or tuple(rows[0]) != COLUMNS:
        raise InputError(
            f"{name}: expected the columns {','.join(COLUMNS)} in this order, "
            f"got {','.join(rows[0][:20]) if rows else 'an empty file'!r}"
        )
    items = []
    for number, row in enumerate(rows[1:], 2):
        try:
            items.append(_item(row))
        except InputError as error:
            raise InputError(f"{name}, row {number}: {error}") from None
    try:
        _check_references(items)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return tuple(items)


def roll_up(items: Sequence[Item]) -> RollUp:
    """Mass, balance and cost.

    m = sum m_i,  x_cg = sum m_i x_i / m      [moments about the leading edge, textbook]

    Args:
        items: the list; of parts inside another one only the price counts.

    Raises:
        InputError: no part belongs to the aircraft.
    """
    flying = [(item.mass, item.x) for item in items if item.counts]
    mass = math.fsum(m for m, _ in flying)
    if mass <= 0.0:
        raise InputError(
            "parts: expected at least one part with used_in aircraft and a mass, got none"
        )
    moment = math.fsum(m * x for m, x in flying if x is not None)
    bought = [item for item in items if item.used_in != "option"]
    costs = {
        use: math.fsum(
            item.quantity * (item.price or 0.0) for item in bought if item.used_in == use
        )
        for use in USES
        if use != "option"
    }
    return RollUp(
        mass, moment / mass, costs, tuple(item.id for item in bought if item.price is None)
    )


def with_option(items: Sequence[Item], option: str) -> tuple[Item, ...]:
    """The list with an option, the id of a row with used_in "option", instead of its part.

    Raises:
        InputError: there is no such option.
    """
    chosen = _named(items, option)
    if chosen.used_in != "option":
        raise InputError(
            f"parts: expected the id of an option, got {option!r}, used in {chosen.used_in}"
        )
    others = [item for item in items if item.id not in (option, chosen.replaces)]
    return (*others, replace(chosen, used_in="aircraft"))


def balance_move(items: Sequence[Item], mover: str, x_goal: float) -> float:
    """Displacement of one part that moves the centre of gravity to a position.

    dx = m (x_goal - x_cg) / m_mover      [moments, textbook]

    Args:
        mover: id of the part to move, such as the battery; it may be inside another one.
        x_goal: behind the wing's leading edge at the root [m].

    Returns:
        [m], backward positive.

    Raises:
        InputError: there is no such part, or it has no mass.
    """
    part = _named(items, mover)
    if part.mass <= 0.0:
        raise InputError(f"parts: expected a part with a mass to move, got {mover!r} without one")
    whole = roll_up(items)
    return whole.mass * (x_goal - whole.x_cg) / part.mass


def paper_sums(items: Sequence[Item]) -> list[tuple[str, float]]:
    """Sums of the paper's masses, for every reading of them.

    Args:
        items: the list; its `paper_value` and `inside` columns are used.

    Returns:
        Pairs of description and mass [kg]: the sum of the paper's numbers, then for each part taken
        to be inside another one the sum if it is not.
    """
    printed = [item for item in items if item.paper_mass is not None]
    base = [item for item in printed if item.counts]
    total = math.fsum(item.paper_mass or 0.0 for item in base)
    sums = [
        (
            " + ".join(f"{1000.0 * (item.paper_mass or 0.0):g}" for item in base) + " g as printed",
            total,
        )
    ]
    for item in items:
        if item.inside and item.mass > 0.0:
            own = item.mass if item.paper_mass is None else item.paper_mass
            sums.append((f"the same if {item.id} is not inside {item.inside}", total + own))
    return sums


def _named(items: Sequence[Item], name: str) -> Item:
    for item in items:
        if item.id == name:
            return item
    raise InputError(f"parts: expected one of {', '.join(item.id for item in items)}, got {name!r}")


def _item(row: list[str]) -> Item:
    """One row, with every cell checked."""
    if len(row) != len(COLUMNS):
        raise InputError(
            f"expected {len(COLUMNS)} cells, got {len(row)}; put texts with commas in quotes"
        )
    cells: dict[str, Any] = {
        column: cell.strip() for column, cell in zip(COLUMNS, row, strict=True)
    }
    quantity = require_range("quantity", cells["quantity"], low=1, high=1000)
    if not cells["id"].isidentifier() or not cells["part"] or quantity != int(quantity):
        raise InputError(
            f"expected an id like trainer_board, a name and a whole quantity, got {row[:3]}"
        )
    if cells["used_in"] not in USES:
        raise InputError(f"used_in: expected one of {', '.join(USES)}, got {cells['used_in']!r}")
    mass_g, x_mm = (
        _number(cells, "unit_mass_g", 0.001, 1e4),
        _number(cells, "x_mm", -1000.0, 1000.0),
    )
    item = Item(
        cells["id"],
        cells["part"],
        int(quantity),
        None if mass_g is None else mass_g / 1000.0,
        cells["mass_source"],
        None if x_mm is None else x_mm / 1000.0,
        _number(cells, "price_usd", 0.0, 1e5),
        cells["price_source"],
        *(cells[name] for name in ("used_in", "inside", "replaces", "paper_value", "alternatives")),
    )
    _check_item(item)
    return item


def _number(cells: dict[str, Any], column: str, low: float, high: float) -> float | None:
    """A cell's number; None if empty."""
    return require_range(column, cells[column], low=low, high=high) if cells[column] else None


def _check_item(item: Item) -> None:
    """Check mass, position and source of a part, and that the paper's numbers are the paper's."""
    if item.used_in in ("aircraft", "option") and item.unit_mass is None:
        raise InputError(f"{item.id}: expected unit_mass_g of a part that flies, got none")
    if item.x is None and (item.counts or item.used_in == "option"):
        raise InputError(f"{item.id}: expected x_mm of a part that flies, got none")
    if bool(item.replaces) != (item.used_in == "option"):
        raise InputError(f"{item.id}: expected replaces of an option, and of nothing else")
    origins = [("price_source", item.price_source)]
    origins += [("mass_source", item.mass_source)] if item.unit_mass is not None else []
    for column, source in origins:
        if source.split(":")[0] not in ORIGINS:
            raise InputError(
                f"{item.id}: {column}: expected one of {', '.join(ORIGINS)} first, got {source!r}"
            )
    try:
        paper = {"mass": item.paper_mass, "price": item.paper_price}
    except ValueError:
        paper = {}
    if not paper or (item.paper_value and set(paper.values()) == {None}):
        raise InputError(
            f'{item.id}: paper_value: expected "137 g", "$80" or nothing, got {item.paper_value!r}'
        )
    ours = {"mass": (item.unit_mass, item.mass_source), "price": (item.price, item.price_source)}
    for what, (value, source) in ours.items():
        printed = paper[what]
        if source == "paper" and (
            printed is None or value is None or abs(printed - value) > ROUNDING
        ):
            raise InputError(
                f"{item.id}: {what}: expected the paper's {item.paper_value or 'none'}, as its "
                "source says, got another value"
            )


def _check_references(items: Sequence[Item]) -> None:
    """Check that ids are unique, and that `inside` and `replaces` name parts of the aircraft."""
    ids = [item.id for item in items]
    counted = [item.id for item in items if item.counts]
    for item in items:
        if ids.count(item.id) > 1:
            raise InputError(f"expected every id once, got {item.id!r} twice")
        for column, target in (("inside", item.inside), ("replaces", item.replaces)):
            if target and target not in counted:
                raise InputError(
                    f"{item.id}: {column}: expected the id of an aircraft part, got {target!r}"
                )
