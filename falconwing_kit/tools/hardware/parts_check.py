"""Parts list, airframe and hall -> what of mass, balance, propeller and camera does not fit.

A finding is a sentence with the number and the part. Positions are in millimetres behind the wing's
leading edge at the root, as in the list; the airframe file's `leading_edge_x_m` converts them.
"""

import math
from collections.abc import Sequence

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.hardware.cameras import CameraHardware, load_camera
from falconwing_kit.tools.hardware.parts import Item, load_parts, roll_up

# Of the mean chord: how far ahead of the maker's mark the aircraft may balance; behind it, never. A
# twentieth makes it nose-heavy by less than the pilot's trim (estimate, not measured in flight).
BALANCE_AHEAD = 0.05
PROPELLER_CLEARANCE = 0.020  # [m], from the disc to the front of anything added
SAME_PLACE = 0.002  # [m], as exactly as a ruler measures on foam
CAMERA = "camera_analog"


def find_problems(
    items: Sequence[Item], airframe: Airframe, largest_mass: float,
    camera: CameraHardware | None = None,
) -> tuple[str, ...]:  # fmt: skip
    """What of the list does not fit, a sentence each; empty where all of it does.

    Args:
        items: the list.
        airframe: with `x_leading_edge` and `propeller`; without them only the mass is checked.
        largest_mass: the hall's [kg].
        camera: whose lens is at `p_body_camera`; None for the kit's analog one.

    Raises:
        InputError: no part belongs to the aircraft.
    """
    camera = load_camera() if camera is None else camera
    sentences = [_mass(items, largest_mass)]
    if airframe.x_leading_edge is not None:
        sentences += [_balance(items, airframe), _camera(items, airframe, camera)]
        if airframe.propeller is not None:
            sentences += [_propeller(item, airframe, camera) for item in items if item.counts]
    return tuple(sentence for sentence in sentences if sentence)


def balance_range(items: Sequence[Item], airframe: Airframe) -> tuple[float, float]:
    """First and last balance point that pass [m behind the leading edge]; the last is the mark.

    Raises:
        InputError: the list has no part with others inside, which is the aircraft as bought.
    """
    holders = {item.inside for item in items if item.inside}
    mark = next((item.x for item in items if item.id in holders), None)
    if mark is None:
        raise InputError(
            "parts: expected a part with others inside, the aircraft as bought, got none; name it"
            " in the column inside of its receiver"
        )
    return mark - BALANCE_AHEAD * airframe.mean_chord, mark


def _mass(items: Sequence[Item], largest: float) -> str:
    mass = roll_up(items).mass
    if mass <= largest:
        return ""
    own = {item.id: item.mass for item in load_parts()}
    part = max(
        (item for item in items if item.counts), key=lambda item: item.mass - own.get(item.id, 0.0)
    )
    more = 1000.0 * (part.mass - own.get(part.id, 0.0))
    advice = "no part is heavier than in the kit's list: take a wider hall"
    if more > 0.05:
        advice = (
            f"{part.id} weighs {1000.0 * part.mass:.1f} g, {more:.1f} g more than in the kit's"
            " list: take a lighter one, or a wider hall"
        )
    return (
        f"mass: expected at most {1000.0 * largest:.1f} g for this hall, got {1000.0 * mass:.1f} g;"
        f" {advice}"
    )


def _balance(items: Sequence[Item], airframe: Airframe) -> str:
    first, mark = balance_range(items, airframe)
    x_cg = roll_up(items).x_cg
    if first - 1e-9 <= x_cg <= mark + 1e-9:
        return ""
    way = -1.0 if x_cg < first else 1.0
    part = max(
        (item for item in items if item.counts),
        key=lambda item: way * item.mass * ((item.x or 0.0) - mark),
    )
    shift = 1000.0 * part.mass * ((part.x or 0.0) - mark) / roll_up(items).mass
    toward = "nose-heavy: move it back" if way < 0.0 else "tail-heavy: move it forward"
    return (
        f"balance: expected {1000.0 * first:.1f} to {1000.0 * mark:.1f} mm behind the leading edge,"
        f" got {1000.0 * x_cg:.1f} mm; {part.id} at {1000.0 * (part.x or 0.0):g} mm shifts it by"
        f" {shift:+.1f} mm, {toward}, or the battery"
    )


def _camera(items: Sequence[Item], airframe: Airframe, camera: CameraHardware) -> str:
    """The lens is `lens_ahead` ahead of the screws, which are where the list has the camera."""
    item = next((each for each in items if each.id == CAMERA and each.counts), None)
    if item is None or item.x is None or airframe.x_leading_edge is None:
        return ""
    x_lens = airframe.x_leading_edge - item.x + camera.body_mm.lens_ahead / 1000.0
    if math.isclose(x_lens, airframe.p_body_camera[0], abs_tol=SAME_PLACE):
        return ""
    return (
        f"camera: expected p_body_camera_m to begin with {x_lens:.3f}, since {item.id} is at"
        f" {1000.0 * item.x:g} mm and its lens {camera.body_mm.lens_ahead:g} mm ahead of it, got"
        f" {airframe.p_body_camera[0]:.3f}; correct the airframe file or the list"
    )


def _propeller(item: Item, airframe: Airframe, camera: CameraHardware) -> str:
    """The part's front against the plane of the disc."""
    if item.x is None or airframe.propeller is None or airframe.x_leading_edge is None:
        return ""
    reach = camera.body_mm.lens_ahead / 1000.0 if item.id == CAMERA else 0.0
    x_disc = airframe.x_leading_edge - airframe.propeller.x  # behind the leading edge
    gap = item.x - reach - x_disc
    if gap >= PROPELLER_CLEARANCE:
        return ""
    return (
        f"propeller: expected {item.id} at least {1000.0 * PROPELLER_CLEARANCE:.0f} mm behind the"
        f" disc at {1000.0 * x_disc:.0f} mm, got {1000.0 * gap:.0f} mm; move it back"
    )
