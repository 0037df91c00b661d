"""The assembly's solids stand where the files say, nothing collides, and the book's steps, parts
and pictures agree with them; planted disagreements are found.
"""

import importlib.util
import io
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from falconwing_kit.aircraft.sizing import largest_mass
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.hardware.parts import balance_move, roll_up
from falconwing_kit.tools.hardware.parts_check import PROPELLER_CLEARANCE
from falconwing_kit.tools.hardware.prints import CHECK_MM, CHECK_TOLERANCE_MM
from falconwing_kit.trainer_port.safety import SafetyConfig
from falconwing_kit.vision.marker import Marker

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "manual" / "figures" / "steps"


def script(name):
    """A program of hardware/assembly as a module."""
    spec = importlib.util.spec_from_file_location(
        name, ROOT / "hardware" / "assembly" / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


assembly, draw = script("assembly"), script("draw")
STEPS = draw.load_steps()
HAND_TOOLS = tomllib.loads((ROOT / "manual" / "assembly.toml").read_text("utf-8"))["hand_tools"]


@pytest.fixture(scope="module")
def sources():
    return assembly.load_sources()


@pytest.fixture(scope="module")
def shapes(sources):
    return assembly.build(sources)


@pytest.fixture(scope="module")
def book(shapes, sources):
    return draw.Book(shapes, sources, STEPS)


def moved(sources, part, x_mm):
    """The kit's files with one part elsewhere."""
    items = tuple(
        replace(item, x=x_mm / 1000.0) if item.id == part else item for item in sources.items
    )
    return replace(sources, items=items)


def middle(shape):
    """Middle of a shape's box along the fuselage [mm]."""
    box = shape.solid.bounding_box()
    return (box.min.X + box.max.X) / 2.0


# -- places ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "part", "x_mm"),
    [("battery", "battery", -40.0), ("inductor", "filter_inductor", -20.0),
     ("capacitor", "filter_capacitor", -20.0), ("resistor", "filter_resistor", -20.0)],
)  # fmt: skip
def test_parts_stand_where_the_list_has_them(shapes, name, part, x_mm):
    """By hand: the leading edge is 36 mm ahead of the origin, x of the list counts backward."""
    assert shapes[name].part == part
    assert middle(shapes[name]) == pytest.approx(36.0 - x_mm, abs=0.01)


def test_camera_and_bracket_stand_where_list_and_airframe_file_have_them(shapes, sources):
    """The list's camera is its screws, 12 mm behind the leading edge, lens 12 mm ahead of them:
    flush. The list's bracket is its centre of mass, 16 mm: 36 - 16 = 20. The screws through its
    holes are then the camera's, to half a millimetre.
    """
    camera = shapes["camera"].solid.bounding_box()
    assert pytest.approx(36.0, abs=0.01) == camera.max.X
    assert pytest.approx(75.0, abs=0.01) == (camera.min.Z + camera.max.Z) / 2.0
    assert float(shapes["bracket"].solid.center().X) == pytest.approx(20.0, abs=0.01)
    assert assembly.clearances(shapes, sources)["holes_off"] == pytest.approx(0.0, abs=0.5)
    assert middle(shapes["screws"]) == pytest.approx(24.0, abs=0.01)


def test_wing_wheels_and_propeller_are_the_airframe_files(shapes, sources):
    """Span 700, chord 0.076 / 0.70 = 108.57, wheels' lowest points 110 and 40 mm below the axis,
    a disc of 156 mm at 200 mm.
    """
    wing = shapes["wing"].solid.bounding_box()
    assert pytest.approx(700.0, abs=0.1) == wing.size.Y
    assert pytest.approx(36.0, abs=0.1) == wing.max.X
    tail = shapes["flaps"].solid.bounding_box().min.X
    assert tail == pytest.approx(36.0 - 108.57, abs=0.1)
    assert pytest.approx(-110.0, abs=0.01) == shapes["main gear"].solid.bounding_box().min.Z
    assert pytest.approx(-40.0, abs=0.01) == shapes["tail wheel"].solid.bounding_box().min.Z
    disc = shapes["propeller"].solid.bounding_box()
    assert pytest.approx(156.0, abs=0.01) == disc.size.Z
    assert pytest.approx(200.0, abs=1.1) == disc.max.X  # half a blade's thickness


def test_a_part_moved_in_the_list_moves_in_the_drawing(sources, book):
    """The battery 25 mm further back, in a written copy of the list: its solid moves by -25 mm,
    and the picture that shows it changes.
    """
    there = moved(sources, "battery", -15.0)
    shapes = assembly.build(there)
    assert middle(shapes["battery"]) == pytest.approx(36.0 + 15.0, abs=0.01)
    step = next(step for step in STEPS if step["id"] == "battery")
    ours = pixels(book.step_picture(step)[0])
    assert differing(ours, pixels(draw.Book(shapes, there, STEPS).step_picture(step)[0])) > 0.005


def test_pad_and_marker_are_the_detectors_and_the_simulators(shapes):
    """Their boxes against LandingPad and Marker; the board is 800 * 8 / 6 mm wide."""
    pad, marker = LandingPad(), Marker()
    box = shapes["pad"].solid.bounding_box()
    assert pytest.approx((1000.0 * pad.x_start, 1000.0 * (pad.x_start + pad.length))) == (
        box.min.X,
        box.max.X,
    )
    assert pytest.approx((-3000.0, -1000.0, 100.0)) == (box.min.Y, box.max.Y, box.max.Z)
    board = shapes["marker"].solid.bounding_box()
    assert pytest.approx(800.0 * 8.0 / 6.0) == board.size.Y
    assert pytest.approx(750.0) == (board.min.Z + board.max.Z) / 2.0
    # The border of a 4 x 4 code is black all around, and so are some of its cells, not all.
    cells = np.array(draw.surroundings().cells_of(marker))
    assert cells.shape == (6, 6)
    assert cells[[0, -1]].all() and cells[:, [0, -1]].all() and 0 < cells[1:-1, 1:-1].sum() < 16


# -- interference ------------------------------------------------------------------------------


def test_nothing_collides_in_the_kits_own_assembly(shapes, sources):
    """20 mm behind the disc are required; by hand the camera's lens is 200 - 36 = 164 mm behind it
    and the wires' front 134.7 mm: the capacitor at 36 + 20 mm ends 5.5 mm further on, its wire of
    1.6 mm turns 3 mm ahead of it, 200 - 56 - 5.5 - 3 - 0.8. Exact volumes of the CAD kernel for
    the rest.
    """
    found = assembly.clearances(shapes, sources)
    assert assembly.find_problems(shapes, sources) == []
    assert 1000.0 * PROPELLER_CLEARANCE < found["disc_gap"] == pytest.approx(134.7, abs=0.05)
    assert found["battery_outside"] == pytest.approx(0.0, abs=1e-6)
    assert found["bracket_in_wing"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("part", "x_mm", "words"),
    [
        ("camera_analog", -140.0, ("propeller: expected at least 20 mm", "got 12.0 mm")),
        ("camera_analog", 20.0, ("camera: expected the lens at 36 mm", "got 28 mm")),
        ("camera_analog", 20.0, ("bracket: expected its holes", "-7.8 mm off")),
        ("bracket", 26.0, ("bracket: expected its holes", "+10.2 mm off")),
        ("battery", -145.0, ("battery: expected it inside", "outside")),
        ("battery", 20.0, ("battery: expected it clear of receiver", "shared")),
    ],
)
def test_planted_place_is_said_with_the_part(sources, part, x_mm, words):
    """By hand: a lens at 36 + 140 + 12 = 188 mm is 12 mm behind the disc; the camera 8 mm back has
    its lens at 28. A battery of 45 mm around 145 mm ahead ends 3 mm behind the spinner's front; one
    20 mm behind the leading edge ends at 42.5 mm, and the receiver begins at 16 mm.
    """
    there = moved(sources, part, x_mm)
    found = assembly.find_problems(assembly.build(there), there)
    assert any(all(word in sentence for word in words) for sentence in found), found


def test_the_wing_is_below_camera_bracket_and_tape(sources):
    """The wing's top is derived: the lens less bracket (15.77 mm by its script), 1 mm of tape."""
    assert sources.wing_top == pytest.approx(75.0 - 15.77 - 1.0, abs=0.05)
    low = replace(sources.airframe, p_body_camera=(0.036, 0.0, -0.065))
    assert replace(sources, airframe=low).wing_top == pytest.approx(sources.wing_top - 10.0)


def test_a_shape_of_a_missing_part_is_one_sentence(sources):
    """A row of the list that the drawing needs is taken out."""
    items = tuple(item for item in sources.items if item.id != "battery")
    with pytest.raises(InputError, match="expected battery with x_mm"):
        assembly.build(replace(sources, items=items))


def test_the_command_writes_a_step_and_says_no(tmp_path, capsys):
    """The kit's list: 0 and a file that the kernel reads. A list with the camera at the nose: 1."""
    assert assembly.main(["--out", str(tmp_path)]) == 0
    assert (tmp_path / "assembly.step").read_bytes().startswith(b"ISO-10303-21;")
    text = (ROOT / "hardware" / "parts.csv").read_text("utf-8")
    changed = re.sub(r"(paper,)12(,35,estimate: a public parts)", r"\g<1>-140\2", text)
    assert changed != text
    (tmp_path / "mine.csv").write_text(changed, encoding="utf-8")
    capsys.readouterr()
    assert assembly.main(["--parts", str(tmp_path / "mine.csv"), "--out", str(tmp_path)]) == 1
    assert "propeller: expected at least 20 mm" in capsys.readouterr().out


# -- steps -------------------------------------------------------------------------------------


def step_problems(steps, sources):
    """What of the steps does not agree with the parts list and the shapes, a sentence each."""
    rows = {item.id: item for item in sources.items}
    shapes = {f"{row['part']}.{row['name']}": row for row in sources.envelope["shape"]}
    part_of = {row["name"]: row["part"] for row in sources.envelope["shape"]}
    found, handled = [], set()
    for step in steps:
        for name in step["parts"]:
            handled.add(name.split(".")[0])
            if name not in rows and name not in shapes:
                found.append(f"{step['id']}: no part {name}")
        for name in step["tools"]:
            handled.add(name)
            if name not in HAND_TOOLS and (name not in rows or rows[name].used_in != "tools"):
                found.append(f"{step['id']}: no tool {name}")
        mine = {name.split(".")[0] for name in step["parts"]} | set(step["tools"])
        for name in step["picture"].get("adds", []):
            part = part_of.get(name)
            if part not in mine and name not in draw.EXTRAS and part != "airframe":
                found.append(f"{step['id']}: adds {name}, which is not among its parts")
        for key in ("title", "do", "see", "if_not"):
            if not step[key].strip():
                found.append(f"{step['id']}: {key} is empty")
        if not 5 <= step["minutes"] <= 60:
            found.append(f"{step['id']}: {step['minutes']} min")
    found += [
        f"no step handles {item.id}"
        for item in sources.items
        if item.used_in in ("aircraft", "ground", "tools") and item.id not in handled
    ]
    return found


def test_steps_are_enough_and_agree_with_the_list(sources):
    """At least 25, ids once, each part of aircraft, ground and tools in one of them or more."""
    assert len(STEPS) >= 25
    assert len({step["id"] for step in STEPS}) == len(STEPS)
    assert step_problems(STEPS, sources) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda steps: steps["weigh"]["parts"].append("rocket"), "weigh: no part rocket"),
        (lambda steps: steps["weigh"]["tools"].append("laser"), "weigh: no tool laser"),
        (
            lambda steps: steps["wing"].update(parts=["airframe.tailfeather"]),
            "wing: no part airframe.",
        ),
        (lambda steps: steps.pop("pad"), "no step handles pad"),
        (lambda steps: steps["battery"].update(parts=["tape"]), "battery: adds battery"),
        (lambda steps: steps["install"].update(see=" "), "install: see is empty"),
    ],
)
def test_planted_step_is_found(sources, change, words):
    """Each change breaks one agreement."""
    steps = {
        step["id"]: {**step, "parts": [*step["parts"]], "tools": [*step["tools"]]} for step in STEPS
    }
    change(steps)
    found = step_problems(list(steps.values()), sources)
    assert any(sentence.startswith(words) for sentence in found)


def test_order_is_safe():
    """Propeller off before the first battery, throttle cut before the camera, supervisor and range
    before the propeller, which is on last but storage.
    """
    at = {step["id"]: k for k, step in enumerate(STEPS)}
    assert at["propeller_off"] < at["charge"] < at["bind"] < at["throttle_cut"] < at["mount"]
    assert at["radio"] < at["bind"]  # a receiver binds to a model that has its throttle cut
    assert at["antenna"] < at["supply"] < at["video"]  # no transmitter without antenna
    assert at["supervisor"] < at["bench"] < at["range"] < at["propeller_on"] == len(STEPS) - 2


ONLY_PROPELLER = ("propeller_off",)  # before the first battery is charged


def battery_problems(steps):
    """Steps at which a battery could be connected where hands are in danger; one line each."""
    found = []
    for step in steps:
        words = step["do"]
        connected = re.search(r"[Bb]attery in\b(?! the bag)", words)
        soldered = "soldering" in step["tools"] and "battery" in words.lower()
        in_hand = "airframe.propeller" in step["parts"] and step["id"] not in ONLY_PROPELLER
        if connected and not re.search(r"[Tt]hrottle cut|[Pp]ropeller off", words):
            found.append(f"{step['id']}: battery in, propeller and throttle cut not named")
        if soldered and not words.startswith("*Battery out.*"):
            found.append(f"{step['id']}: soldering, battery out not the first words")
        if in_hand and not re.search(r"[Bb]attery out|unplugged", words):
            found.append(f"{step['id']}: propeller in the hand, battery out not named")
    return found


def test_no_battery_where_hands_are_near():
    """Each step that connects a battery names what keeps the motor still; where one solders at its
    lead or handles the propeller, it is out. Three faults planted.
    """
    assert battery_problems(STEPS) == []
    steps = {step["id"]: dict(step) for step in STEPS}
    for name, words in (
        ("supply", "Throttle cut on, battery in"),
        ("filter", "*Battery out.*"),
        ("mount", "Battery out. "),
    ):
        assert words in steps[name]["do"]
        changed = steps[name]["do"].replace(words, words.split(", ")[-1] if "," in words else "")
        planted = {**steps, name: {**steps[name], "do": changed}}
        (sentence,) = battery_problems(planted.values())
        assert sentence.startswith(f"{name}: ")


def test_numbers_in_the_steps_are_the_files(sources, shapes):
    """Each number of the text against the file that it is from."""
    text = {step["id"]: " ".join((step["do"], step["see"], step["if_not"])) for step in STEPS}
    found = assembly.clearances(shapes, sources)
    lens = sources.lens
    assert f"lens {lens[2]:.0f} mm above" in text["mount"]
    assert f"drawn are {1000.0 * sources.airframe.propeller.x - lens[0]:.0f} mm" in text["mount"]
    assert f"at least {1000.0 * PROPELLER_CLEARANCE:.0f} mm behind its disc" in text["mount"]
    assert found["lens_edge"] == pytest.approx(0.0, abs=0.5) and "flush" in text["mount"]
    wing = script_jig().load_wing(sources.items, sources.airframe)
    assert f"at {wing.mark:.1f} mm" in text["balance"]
    assert f"at {wing.first:.1f} mm" in text["balance"]
    assert f"{script_jig().spacer_thickness(wing):.1f} mm thick" in text["jig"]
    assert f"{script_jig().wall_at(wing):.1f} mm from the wall" in text["jig"]
    below = sources.wing_top - sources.envelope["aircraft"]["wing_thickness"]
    lowest = shapes["main gear"].solid.bounding_box().min.Z
    (boxes,) = re.findall(r"at least (\d+) cm, so that the wheels", text["balance"])
    assert 10.0 * int(boxes) > below - lowest - script_jig().RIDGE_HEIGHT
    (battery,) = (item for item in sources.items if item.id == "battery")
    assert f"{-1000.0 * battery.x:.0f} mm ahead of the leading edge" in text["battery"]
    supply = sources.camera.supply
    assert f"{supply.low_v:.1f} to {supply.high_v:.1f} V" in text["supply"]
    assert f"{supply.high_v:.1f} V at most" in text["charge"]
    row = {item.id: k for k, item in enumerate(sources.items, 1)}
    assert f"(row {row['extension_lead']}, socket and plug" in text["filter"]
    assert f"the converter (row {row['converter_5v']})" in text["supply"]
    (screws,) = (item for item in sources.items if item.id == "screws")
    (length,) = re.findall(r"M2 x (\d+)", screws.part)
    cheek = assembly.script("bracket").WALL
    said = (
        f"A screw of {length} mm goes {int(length) - cheek:g} mm deep behind a cheek of {cheek:g}"
    )
    assert said in text["camera"]
    power = sources.camera.power_filter
    assert f"about {power.damping_ohm + power.coil_ohm:.1f} ohm" in text["filter_check"]
    back = 1000.0 * balance_move(sources.items, "battery", wing.mark / 1000.0)
    ahead = wing.mark - 1000.0 * roll_up(sources.items).x_cg
    assert f"{back:.0f} mm back takes the balance {ahead:.0f} mm back" in text["balance"]
    mass_g = 1000.0 * roll_up(sources.items).mass
    largest_g = 1000.0 * float(largest_mass(25.0, sources.airframe, margin=2.0, hold_height=True))
    assert f"weighs {mass_g:.1f} g of {largest_g:.1f} g" in text["weigh"]
    board = SafetyConfig()
    assert f"more than {board.pilot_moved_us // 10} % of its travel" in text["supervisor"]
    assert f"within {board.host_timeout_ms} ms" in text["supervisor"]
    assert f"check line is {CHECK_MM:.0f} mm within {CHECK_TOLERANCE_MM} mm" in text["marker"]
    assert f"At most {assembly.script('bracket').LARGEST_G:.0f} g" in text["bracket"]
    pad, marker = LandingPad(), Marker()
    assert f"the board {1000.0 * marker.size * 8.0 / 6.0:.0f} mm" in text["marker"]
    assert f"{pad.length:g} x {pad.width:g} m and {pad.height:g} m high" in text["pad"]
    x, y, z = marker.T_world_marker[:3, 3]
    assert f"begins {pad.x_start - x:g} m behind the marker" in text["pad"]
    assert f"centre line is {y - pad.y_centre:g} m to the right" in text["pad"]
    assert f"its centre {z:g} m above the floor" in text["marker"]
    assert f"black square {1000.0 * marker.size:.0f} mm" in text["marker"]


def test_facts_state_what_the_solids_measure(sources, shapes):
    """Rows 36 to 42 of the table of sources against solids, envelope, jig, pad and marker."""
    page = (ROOT / "manual" / "site" / "builder" / "facts.md").read_text("utf-8")
    found, wing = (
        assembly.clearances(shapes, sources),
        script_jig().load_wing(sources.items, sources.airframe),
    )
    lens_gap = 1000.0 * sources.airframe.propeller.x - sources.lens[0]
    size, pad = sources.envelope, LandingPad()
    below = sources.wing_top - size["aircraft"]["wing_thickness"]
    lowest = shapes["main gear"].solid.bounding_box().min.Z
    for words in (
        f"{found['disc_gap']:.0f} mm from the wires and {lens_gap:.0f} mm from the lens",
        f"wing {size['aircraft']['wing_thickness']:g} mm thick",
        f"ridge {wing.mark:.1f} mm behind the leading edge, {wing.first:.1f} mm with the spacer",
        f"wheels {below - lowest:.0f} mm below the wing less a ridge of "
        f"{script_jig().RIDGE_HEIGHT:.0f} mm",
        f"board of {size['ground']['board'][0]:.1f} x {size['ground']['board'][1]:.1f} mm",
        f"pad {pad.length:g} x {pad.width:g} x {pad.height:g} m, {pad.x_start:g} m behind",
    ):
        assert words in page


def script_jig():
    """hardware/jig/jig.py."""
    return assembly.script("jig")


# -- pictures ----------------------------------------------------------------------------------


def pixels(content):
    """(H, W, 3) of a PNG."""
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(np.int64)


def differing(one, other):
    """Share of pixels whose colours differ clearly."""
    return float(np.mean(np.abs(one - other).max(axis=-1) > 60))


def test_every_step_has_its_picture_and_words():
    """One PNG below 150 kB and one description for each step and the exploded view, none more."""
    wanted = {*(step["id"] for step in STEPS), "exploded"}
    assert {path.stem for path in PICTURES.glob("*.png")} == wanted
    assert {path.stem for path in PICTURES.glob("*.txt")} == wanted
    for name in wanted:
        assert 1000 < (PICTURES / f"{name}.png").stat().st_size < 150_000
        assert len((PICTURES / f"{name}.txt").read_text("utf-8")) > 80


def test_pictures_are_what_the_command_makes(book):
    """All drawn again: the words letter by letter, of the pixels at most one in 200 apart, since
    machines round outlines differently.
    """
    for step in STEPS:
        content, words = book.step_picture(step)
        path = PICTURES / f"{step['id']}.png"
        assert words + "\n" == path.with_suffix(".txt").read_text("utf-8")
        assert differing(pixels(content), pixels(path.read_bytes())) < 0.005, step["id"]
    content, words = book.exploded()
    assert words + "\n" == (PICTURES / "exploded.txt").read_text("utf-8")
    assert differing(pixels(content), pixels((PICTURES / "exploded.png").read_bytes())) < 0.005


@pytest.mark.parametrize("x", [0.0, 450.0, 900.0])
def test_words_near_a_side_of_a_picture_stay_whole(x):
    """By geometry: centred where there is room, else against the side; the box is in the image."""
    scale = draw.SMOOTH
    sheet = draw.Sheet(np.full((600 * scale, 900 * scale, 3), 255.0))
    left, _, right, _ = sheet.text_box((x * scale, 300.0 * scale), "36.0 mm to the ridge")
    assert 0.0 <= left < right <= 900 * scale
    assert right - left == pytest.approx(
        scale * (draw.label_width("36.0 mm to the ridge") - 30), abs=scale
    )
    if x == 450.0:
        assert (left + right) / 2.0 == pytest.approx(450 * scale)


def test_every_picture_shows_its_steps_parts_in_colour():
    """Orange pixels, at least one in a thousand; of the white marker black ones."""
    for step in STEPS:
        r, g, b = np.moveaxis(pixels((PICTURES / f"{step['id']}.png").read_bytes()), -1, 0)
        orange, ink = (r > g + 30) & (g > b + 20), np.maximum(r, np.maximum(g, b)) < 60
        assert np.mean(ink if step["id"] == "marker" else orange) > 0.001, step["id"]


def test_exploded_view_names_every_flying_part(book, sources):
    """By number and name; the jig does not fly."""
    words = (PICTURES / "exploded.txt").read_text("utf-8")
    known = assembly.numbers(sources)
    for row in sources.envelope["shape"]:
        if row["scene"] == "aircraft" and row["part"] != "balance_jig":
            number = known[".".join((row["part"], row["name"]))]
            assert f"{number} {row['name']}" in words


def test_numbers_are_rows_of_the_list_with_letters(sources):
    """Counted by hand in parts.csv: airframe first, its wing second; battery third, alone."""
    known = assembly.numbers(sources)
    assert known["airframe.wing"] == "1b" and known["battery.battery"] == "3"
    assert known["camera_analog.antenna"] == "4b" and known["bracket"] == "5"


def test_projection_by_hand():
    """Seen from ahead, left is to the right of the image; from the right side, forward is; from
    above at 89 deg, up is nearest to the eye.
    """
    forward, left, up = np.eye(3)
    ahead = draw.axes_of(0.0, 0.0)
    assert ahead @ left == pytest.approx([1.0, 0.0, 0.0])
    assert ahead @ up == pytest.approx([0.0, 1.0, 0.0])
    assert ahead @ forward == pytest.approx([0.0, 0.0, 1.0])
    side = draw.axes_of(-90.0, 0.0)
    assert side @ forward == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    assert (draw.axes_of(30.0, 89.0) @ up)[2] == pytest.approx(1.0, abs=1e-3)
    for turn, lift in ((20.0, 30.0), (-130.0, 5.0)):
        axes = draw.axes_of(turn, lift)
        assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)


def test_nearer_part_hides_the_other():
    """Two squares on the optical axis: the nearer one's number where both are, whatever the order;
    turned around, the other one.
    """
    flat = np.array([[[0, -1, -1], [0, 1, -1], [0, 1, 1]], [[0, -1, -1], [0, 1, 1], [0, -1, 1]]])
    none = np.zeros(3)
    near = draw.Part("near", "near", flat + np.array([5.0, 0.0, 0.0]), True, False, none)
    far = draw.Part("far", "far", 2.0 * flat, False, False, none)
    for parts in ((near, far), (far, near)):
        for turn, wanted in ((0.0, near), (180.0, far)):
            points = np.concatenate([part.mesh for part in parts])
            view = draw.fit(points, draw.axes_of(turn, 0.0), (120, 120), (20, 20, 20))
            _, owner = draw.shaded(parts, view)
            assert parts[owner[120, 120]] is wanted
    mesh = draw.triangles(importlib.import_module("solids").box((0.0, 0.0, 0.0), (2.0, 4.0, 6.0)))
    assert np.ptp(mesh.reshape(-1, 3), axis=0) == pytest.approx([2.0, 4.0, 6.0])


def test_a_wrong_shape_in_a_step_is_one_sentence(shapes, sources, capsys):
    """A name that is no shape, and a picture that is no step."""
    steps = [{**STEPS[0], "picture": {"scene": "ground", "adds": ["toaster"]}}]
    with pytest.raises(InputError, match=r"install: adds: expected one of .*, got 'toaster'"):
        draw.Book(shapes, sources, steps)
    with pytest.raises(SystemExit) as end:
        draw.main(["nothing"])
    assert end.value.code == 2 and "expected names of" in capsys.readouterr().err
