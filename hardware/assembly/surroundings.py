"""Bench and hall of the assembly drawing: envelope sizes, pad, marker -> build123d solids."""

from collections.abc import Sequence
from typing import Any

from solids import box, rod, tube

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.vision.marker import Marker


def ground(size: dict[str, Any]) -> dict[str, Any]:
    """Solids of the bench: x to the right, y away from the builder, z up; the board at the origin.

    Args:
        size: the table [ground] of envelope.toml.
    """
    from build123d import Compound

    wide, deep, thin = size["board"]
    sockets = [
        box((0.6, 8.0, thin), (12.0, 12.0, 11.0), corner="low"),  # USB
        box((0.6, 34.0, thin), (14.0, 9.0, 11.0), corner="low"),  # supply
        box((22.0, deep - 3.6, thin), (72.0, 2.5, 8.5), corner="low"),
        box((26.0, 1.2, thin), (62.0, 2.5, 8.5), corner="low"),
        box((94.0, 6.0, thin), (5.0, 44.0, 8.5), corner="low"),  # pins 22 to 53
        box((48.0, 20.0, thin), (14.0, 14.0, 1.6), corner="low"),
    ]
    board = [box((0.0, 0.0, 0.0), (wide, deep, thin), corner="low"), *sockets]
    thick, long = size["plug"]
    lead = _lead([(44.0, deep - 2.0, 12.0), (60.0, 95.0, 8.0), (150.0, 118.0, 8.0)], 3, thick, long)
    second = _lead([(97.0, 12.0, 12.0), (125.0, 30.0, 8.0), (190.0, 60.0, 8.0)], 1, thick, long)
    w, h, d = size["transmitter"]
    left, away = 225.0, 75.0
    stick, switch = away + 0.52 * h, (left + 0.12 * w, away + 0.92 * h)
    radio = [
        box((left, away, 0.0), (w, h, d), corner="low"),
        *(
            part
            for x in (0.27, 0.73)
            for part in (
                rod((left + x * w, stick, d), (left + x * w, stick, d + 5.0), 46.0),
                rod((left + x * w, stick, d), (left + x * w, stick, d + 28.0), 7.0),
            )
        ),
        box((left + 0.36 * w, away + 0.08 * h, d), (0.28 * w, 0.24 * h, 1.5), corner="low"),
        rod((left + 0.5 * w, away + h, 0.6 * d), (left + 0.5 * w, away + h + 85.0, 0.9 * d), 9.0),
        rod((*switch, d), (*switch, d + 16.0), 5.0),
    ]
    v, s = size["video_receiver"], size["capture_card"]
    video = [
        box((-150.0, 175.0, 0.0), v, corner="low"),
        *(
            rod((-150.0 + x, 175.0 + v[1], 14.0), (-150.0 + x, 175.0 + v[1] + 8.0, 80.0), 7.0)
            for x in (14.0, v[0] - 14.0)
        ),
    ]
    card = [
        box((-45.0, 188.0, 0.0), s, corner="low"),
        tube([(-150.0 + v[0], 200.0, 10.0), (-60.0, 200.0, 8.0), (-45.0, 200.0, 6.0)], 4.0),
        tube([(-45.0 + s[0], 200.0, 6.0), (40.0, 215.0, 5.0), (60.0, 250.0, 8.0)], 4.0),
    ]
    c = size["computer"]
    laptop = [
        box((60.0, 220.0, 0.0), c, corner="low"),
        box((78.0, 232.0, c[2]), (c[0] - 36.0, 95.0, 1.5), corner="low"),
        box((60.0, 220.0 + c[1], c[2]), (c[0], 8.0, c[1]), corner="low"),
    ]
    scale, charger, bag = size["scale"], size["charger"], size["charge_bag"]
    meter, iron = size["multimeter"], size["iron"]
    return {
        "board": Compound(children=board),
        "lead": lead,
        "measuring lead": second,
        "reset capacitor": rod((52.0, 2.4, 12.0), (52.0, 2.4, 23.0), 5.0),
        "transmitter": Compound(children=radio),
        "video receiver": Compound(children=video),
        "capture card": Compound(children=card),
        "computer": Compound(children=laptop),
        "scale": Compound(
            children=[
                box((0.0, 0.0, 0.0), scale, corner="low"),
                rod((65.0, 75.0, scale[2]), (65.0, 75.0, scale[2] + 4.0), 96.0),
                box((40.0, 5.0, scale[2]), (50.0, 16.0, 1.5), corner="low"),
            ]
        ),
        "charger": Compound(
            children=[
                box((0.0, 190.0, 0.0), charger, corner="low"),
                box((15.0, 215.0, charger[2]), (60.0, 25.0, 1.5), corner="low"),
                tube([(charger[0], 220.0, 12.0), (120.0, 215.0, 6.0), (150.0, 190.0, 8.0)], 4.0),
            ]
        ),
        "charge bag": Compound(
            children=[
                box((130.0, 60.0, 0.0), (bag[0], bag[1], 3.0), corner="low"),
                box((130.0, 60.0, 3.0), (3.0, bag[1], bag[2]), corner="low"),
                box((127.0 + bag[0], 60.0, 3.0), (3.0, bag[1], bag[2]), corner="low"),
                box((130.0, 57.0 + bag[1], 3.0), (bag[0], 3.0, bag[2]), corner="low"),
            ]
        ),
        "multimeter": Compound(
            children=[
                box((-130.0, 0.0, 0.0), meter, corner="low"),
                box((-122.0, 95.0, meter[2]), (meter[0] - 16.0, 38.0, 1.5), corner="low"),
                rod((-92.0, 60.0, meter[2]), (-92.0, 60.0, meter[2] + 6.0), 36.0),
                tube(
                    [
                        (-105.0, 8.0, 36.0),
                        (-70.0, -40.0, 6.0),
                        (20.0, -30.0, 6.0),
                        (44.0, -8.0, 14.0),
                        (44.0, 6.0, 26.0),
                    ],
                    4.0,
                ),
            ]
        ),
        "soldering iron": Compound(
            children=[
                rod((115.0, 150.0, 16.0), (170.0, 205.0, 60.0), iron[0]),
                rod((88.0, 123.0, 3.0), (115.0, 150.0, 16.0), 2.0, 6.0),
                tube([(170.0, 205.0, 60.0), (200.0, 240.0, 30.0), (190.0, 290.0, 4.0)], 5.0),
            ]
        ),
    }


def _lead(path: Sequence[Sequence[float]], resistors: int, thick: float, long: float) -> Any:
    """A cable with its resistors on the way and a plug at its end."""
    from build123d import Compound

    (ax, ay, az), (bx, by, bz) = path[-2], path[-1]
    parts = [tube(path, 2.4)]
    for k in range(resistors):
        share = 0.25 + 0.2 * k
        x, y, z = ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)
        parts.append(rod((x, y, z), (x + 0.1 * (bx - ax), y + 0.1 * (by - ay), z), 7.0))
    parts += [
        rod((bx, by, bz), (bx + 22.0, by + 5.0, bz), 9.0),
        rod((bx + 22.0, by + 5.0, bz), (bx + 22.0 + long, by + 5.0 + long / 4.4, bz), thick),
    ]
    return Compound(children=parts)


def hall(board_thickness: float) -> dict[str, Any]:
    """Pad and the marker's board where simulator and detector have them; x along the runway."""
    pad, marker = LandingPad(), Marker()
    x, y = 1000.0 * pad.x_start, 1000.0 * (pad.y_centre - pad.width / 2.0)
    mat = box(
        (x, y, 0.0), (1000.0 * pad.length, 1000.0 * pad.width, 1000.0 * pad.height), corner="low"
    )
    side, cells = 1000.0 * marker.size, cells_of(marker)
    quiet = side * (len(cells) + 2) / len(cells)  # a white cell on each side
    cx, cy, cz = (1000.0 * float(value) for value in marker.T_world_marker[:3, 3])
    board = box((cx + board_thickness / 2.0, cy, cz), (board_thickness, quiet, quiet))
    return {"pad": mat, "marker": board}


def marker_cells() -> Any:
    """The marker's black cells, on the side that faces the approach [mm]."""
    from build123d import Compound

    marker = Marker()
    side, cells = 1000.0 * marker.size, cells_of(marker)
    cx, cy, cz = (1000.0 * float(value) for value in marker.T_world_marker[:3, 3])
    cell, parts = side / len(cells), []
    for row, line in enumerate(cells):
        for column, black in enumerate(line):
            if black:
                left = cy + side / 2.0 - (column + 0.5) * cell
                up = cz + side / 2.0 - (row + 0.5) * cell
                parts.append(box((cx - 1.5, left, up), (3.0, cell, cell)))
    return Compound(children=parts)


def usb_cable() -> Any:
    """From the board's socket to the computer on the bench."""
    return tube(
        [(0.6, 14.0, 7.0), (-25.0, 20.0, 5.0), (-25.0, 150.0, 5.0), (60.0, 235.0, 8.0)], 4.0
    )


def cells_of(marker: Marker) -> list[list[bool]]:
    """The marker's cells, black ones True, border included, from its upper left [OpenCV]."""
    import cv2

    names = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    count = names.markerSize + 2
    image = cv2.aruco.generateImageMarker(names, marker.id, count)
    return [[bool(value == 0) for value in line] for line in image]
