"""Builder's tables: every row has its origin, agrees with the files that the programs use, and its
arithmetic is right; planted disagreements are found.
"""

import copy
import csv
import json
import math
import re
import shutil
import tomllib

import cv2
import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe
from falconwing_kit.aircraft.sizing import largest_mass
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.checklists import load_checklists
from falconwing_kit.tools.hardware.parts import load_parts
from falconwing_kit.trainer_port.safety import SafetyConfig
from tests.manual.book import MANUAL, ROOT, Page, elements, html, page, pdf_objects, script

BUILD = script("build.py")  # makes the site's programs importable
from stage import Settings, Stage, book_pages  # noqa: E402

FOLDER = MANUAL / "builder"
DATA = {path.stem: tomllib.loads(path.read_text("utf-8")) for path in sorted(FOLDER.glob("*.toml"))}
PORT = tomllib.loads((ROOT / "hardware" / "trainer_port.toml").read_text("utf-8"))
CONFIG = (ROOT / "firmware" / "trainer_bridge" / "config.h").read_text("utf-8")
PARTS = {item.id: item for item in load_parts()}
# Which kinds of a source a row's own kind needs; "file" is a path of the repository.
NEEDS = {
    "maker": {"maker"},
    "sister": {"maker"},
    "authority": {"authority"},
    "association": {"association"},
    "secondary": {"secondary"},
    "kit": {"file"},
    "calculated": {"file", "secondary", "authority", "maker"},
    "estimate": set(),
    "open": set(),
}
PUBLISHED = Settings("https://falconwing.example.org/kit", "https://github.com/someone/kit")


def rows_with_source(data):
    """(file, name, row) of every row that cites."""
    return [
        (file, row.get("id", row.get("where", "")), row)
        for file, content in data.items()
        for rows in content.values()
        if isinstance(rows, list)
        for row in rows
        if isinstance(row, dict) and ("kind" in row or "source" in row)
    ]


def source_problems(data):
    """Rows without an origin, or with one that is not there; one line each."""
    problems = []
    for file, name, row in rows_with_source(data):
        place, kind = f"{file}.toml: {name}", row.get("kind")
        if kind not in NEEDS:
            problems.append(f"{place}: expected a kind of {', '.join(NEEDS)}, got {kind}")
            continue
        found = {
            "file" if "/" in key else data["sources"].get(key, {}).get("kind")
            for key in row.get("source", [])
        }
        lost = [key for key in row.get("source", []) if "/" in key and not (ROOT / key).is_file()]
        if None in found or lost:
            problems.append(f"{place}: expected known sources, got {row['source']}")
        if NEEDS[kind] and not found & NEEDS[kind]:
            problems.append(f"{place}: expected a source for {kind}, got {row.get('source', [])}")
        if kind == "open" and not row.get("unchecked"):
            problems.append(f"{place}: expected what was not checked, got nothing")
    return problems


def menu_problems(radio, port, config):
    """Where the menus differ from the calibration file, the firmware and the parts list."""
    problems = []
    setting = {
        name: values.split(",") for name, values in re.findall(r"#define (\w+) ([\d, ]+)", config)
    }
    order = radio["trainer"]["order"]
    theirs = sorted(order, key=lambda name: port[name]["channel"])
    if order != theirs or int(setting["THROTTLE_CHANNEL"][0]) != order.index("throttle"):
        problems.append(f"order: expected {theirs}, got {order}")
    (row,) = [row for row in radio["transmitter"] if row["id"] == "channels"]
    said = ", ".join(f"{k} {name}" for k, name in enumerate(theirs, 1))
    if not row["value"].startswith(said + ";"):
        problems.append(f"channels: expected {said}, got {row['value']}")
    if len(order) != int(setting["CHANNELS"][0]) or len(order) != port["channels"]:
        problems.append(f"channels: expected {port['channels']}, got {len(order)}")
    frame_us = radio["trainer"]["frame_us"]
    if {frame_us} != {port["frame_us"], int(setting["FRAME_US"][0])}:
        problems.append(f"frame: expected {port['frame_us']} us, got {frame_us}")
    (row,) = [row for row in radio["transmitter"] if row["id"] == "frame_rate"]
    if row["value"] != f"{frame_us / 1000:g} ms":
        problems.append(f"frame rate: expected {frame_us / 1000:g} ms, got {row['value']}")
    if f"{radio['radio']} transmitter with trainer port, mode {radio['mode']}" != (
        PARTS["transmitter"].part
    ):
        problems.append(f"radio: expected {PARTS['transmitter'].part}, got {radio['radio']}")
    return problems


def eirp_problems(table):
    """Cells of the printed EIRP table that are not the decibels' sum; one line each."""
    gains = [float(cell.split()[0]) for cell in table[0][1:]]
    return [
        f"{row[0]} at {gain:g} dBi: expected {right:.1f} mW, got {cell}"
        for row in table[1:]
        for gain, cell in zip(gains, row[1:], strict=True)
        for right in [10.0 ** ((10.0 * math.log10(float(row[0].split()[0])) + gain) / 10.0)]
        if abs(float(cell) - right) > max(0.5 if right >= 100.0 else 0.05, 1e-9) + 1e-9
    ]


def printed_table(first):
    """Cells of the HTML's table whose first heading is this."""
    for text in re.findall(r"<table.*?</table>", html(), re.DOTALL):
        rows = [
            [Page(cell).text.strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL)]
            for row in re.findall(r"<tr.*?</tr>", text, re.DOTALL)
        ]
        if rows[0][0] == first:
            return rows
    raise AssertionError(f"expected a table headed {first}")


def words_of(text):
    """Words as they are printed: marks of code and emphasis taken off."""
    return re.sub(r"\s+", " ", re.sub(r"[`*]", "", text)).strip()


def printed(text):
    """Whether it stands in the HTML, quotation marks straightened."""
    straight = re.sub("[“”]", '"', page().text).replace("’", "'")
    return words_of(text) in straight


def test_every_row_has_a_source_or_says_that_it_has_none():
    """Kinds, keys and paths; and no source stands there unused."""
    assert source_problems(DATA) == []
    cited = {key for _, _, row in rows_with_source(DATA) for key in row.get("source", [])}
    assert set(DATA["sources"]) == {key for key in cited if "/" not in key}
    for source in DATA["sources"].values():
        assert source["title"] and source["publisher"]
        assert source["kind"] in {"maker", "authority", "association", "secondary"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": []}, "expected a source for sister"),
        ({"source": ["nowhere"]}, "expected known sources"),
        ({"source": ["hardware/nothing.toml"]}, "expected known sources"),
        ({"kind": "hearsay"}, "expected a kind"),
        ({"kind": "open", "source": []}, "expected what was not checked"),
    ],
)
def test_a_planted_row_without_source_is_found(change, words):
    """One row of the menus, changed; exactly that row is named."""
    data = copy.deepcopy(DATA)
    (row,) = [row for row in data["radio"]["transmitter"] if row["id"] == "rates"]
    row.update(change)
    found = source_problems(data)
    assert found and all(text.startswith("radio.toml: rates: ") for text in found)
    assert any(words in text for text in found)


def test_menus_are_those_of_calibration_and_firmware():
    """Order, frame and radio by the files; the board's rules by its reference model."""
    radio = DATA["radio"]
    assert menu_problems(radio, PORT, CONFIG) == []
    wanted = {"model_type", "trainer_role", "channels", "rates", "expo", "sub_trim", "throttle_cut"}
    assert wanted | {"telemetry", "trainer_switch"} <= {row["id"] for row in radio["transmitter"]}
    assert {"failsafe", "safe_select", "as3x"} <= {row["id"] for row in radio["receiver"]}
    rules = SafetyConfig()
    rows = {row["id"]: row for row in radio["transmitter"]}
    assert f"the {rules.engage_near_us} µs within which the board engages" in rows["trims"]["why"]
    assert f"moves by {rules.pilot_moved_us // 10} %" in rows["trainer_override"]["why"]
    assert rows["trainer_role"]["value"].startswith(radio["trainer"]["role"] + ", wired")
    assert rows["trainer_measure"]["value"].startswith(radio["trainer"]["role_to_measure"])
    trim = DATA["trim_flights"]["numbers"]["trim_us"]
    assert trim < rules.engage_near_us and f"{trim} µs" in rows["trims"]["value"]
    assert f"{trim / 500:.2f} of zero" in rows["trims"]["see"]
    assert f"alarm at {2 * DATA['batteries']['cell']['land_v']:.1f} V" in rows["telemetry"]["value"]


def test_a_planted_order_of_channels_is_found():
    """Aileron and throttle exchanged, in the list, in the sentence, and in the radio's file."""
    radio = copy.deepcopy(DATA["radio"])
    radio["trainer"]["order"] = ["aileron", "throttle", "elevator", "rudder"]
    assert any(text.startswith("order: expected") for text in menu_problems(radio, PORT, CONFIG))
    radio = copy.deepcopy(DATA["radio"])
    (row,) = [row for row in radio["transmitter"] if row["id"] == "channels"]
    row["value"] = row["value"].replace("1 throttle, 2 aileron", "1 aileron, 2 throttle")
    (text,) = menu_problems(radio, PORT, CONFIG)
    assert text.startswith("channels: expected 1 throttle, 2 aileron")
    port = copy.deepcopy(PORT)
    port["throttle"]["channel"], port["aileron"]["channel"] = 2, 1
    assert len(menu_problems(DATA["radio"], port, CONFIG)) == 2
    config = CONFIG.replace("#define FRAME_US 22000", "#define FRAME_US 20000")
    assert any("frame: expected" in text for text in menu_problems(DATA["radio"], PORT, config))


def test_table_of_channels_is_the_file():
    """As printed, slot by slot."""
    table = printed_table("slot")
    for line in table[1:]:
        cells = [re.sub(r"^.*: ", "", cell) for cell in line]
        stick = PORT[cells[1]]
        assert int(cells[0]) == stick["channel"]
        ends = [f"{stick[name]} µs" for name in ("low_us", "centre_us", "high_us")]
        assert cells[3:] == [*ends, "yes" if stick["reversed"] else "no"]
    assert len(table) == 1 + PORT["channels"]


def test_eirp_is_power_times_gain():
    """By hand: 25 mW and 2 dBi are 25 * 1.585 = 39.6 mW, 3 dB twice (1.995), 0 dB once; a planted
    cell is found. The largest power is the inverse: 25 / 1.585 = 15.8 mW.
    """
    table = printed_table("power")
    assert eirp_problems(table) == []
    cells = {row[0]: dict(zip(table[0][1:], row[1:], strict=True)) for row in table[1:]}
    assert cells["25 mW"]["2 dBi"] == "39.6" and cells["25 mW"]["0 dBi"] == "25"
    assert float(cells["100 mW"]["3 dBi"]) == pytest.approx(199.5, abs=0.6)
    planted = copy.deepcopy(table)
    planted[3][3] = "25.0"
    assert eirp_problems(planted) == ["25 mW at 2 dBi: expected 39.6 mW, got 25.0"]
    most = printed_table("limit, EIRP")
    assert [row[0] for row in most[1:]] == ["25 mW", "0.75 mW"]
    assert most[1][3] == "15.8" and most[2][1] == "0.75"
    assert float(most[2][3]) == pytest.approx(0.75 / 1.585, abs=0.006)


def test_limit_of_the_usa_is_its_field_strength():
    """47 CFR 15.249: 50 mV/m at 3 m; (0.05 * 3)^2 / 30 = 0.75 mW. Every other number of a limit has
    a source or is said to be unchecked.
    """
    rows = {row["id"]: row for row in DATA["video"]["regions"]}
    assert (rows["usa"]["field_mv_m"], rows["usa"]["field_m"]) == (50, 3)
    power = (0.050 * 3.0) ** 2 / 30.0
    assert power == pytest.approx(0.75e-3)
    assert "50 mV/m at 3 m, 0.75 mW" in page().text
    for row in rows.values():
        assert "limit_mw" not in row or row["kind"] == "authority" or row["unchecked"]
    assert "No legal advice" in page().text


def test_the_camera_is_judged_before_it_is_ordered():
    """Chapter 3, by hand: 25 / 1.585 = 15.8 mW and 0.75 / 1.585 = 0.47 mW into 2 dBi; attenuators
    10 log(39.6 / 25) = 2.0 dB and 10 log(317 / 25) = 11.03 dB, so the next whole one is named.
    """
    rows = {row[0]: " ".join(row[1:]) for row in printed_table("where")[1:]}
    assert "at most 15.8 mW (0 dBi: 25 mW)" in rows["EU, EEA"]
    assert "at most 0.47 mW (0 dBi: 0.75 mW)" in rows["USA, without a licence"]
    assert "stop here" in rows["USA, without a licence"]
    for power, whole in ((25.0, 2), (200.0, 12)):
        needed = 10.0 * math.log10(power * 10.0**0.2 / 25.0)
        assert (
            whole == math.ceil(round(needed, 3))
            and f"{whole} dB for {power:g} mW" in rows["EU, EEA"]
        )
    regions = {row["id"] for row in DATA["video"]["regions"]}
    assert {row["region"] for row in DATA["video"]["order"]} == regions
    text = page().text
    assert text.index("Before you order the camera") < text.index("Next: order.")


def test_no_meter_at_an_aircraft_whose_propeller_may_turn():
    """Troubleshooting: no row has a propeller on and a multimeter."""
    for part in DATA["troubleshooting"]["parts"]:
        for row in part["rows"]:
            assert not ("propeller on" in row["test"] and "meter" in row["test"]), row["symptom"]


def test_mean_of_pulses_gives_their_height():
    """Five pulses of 0.4 ms in 22 ms are 1 / 11: of 9 V that rest low 0.82 V are read, of 3.3 V
    0.30 V and 3.0 V. A radio of 6 or 8 channels sends 7 or 9: by hand 2.8 / 22 = 0.127 and 3.6 / 22
    = 0.164. Chapter 7's border lies between 10 V resting low and 2.1 V resting high for all three.
    """
    share = 5 * 0.4 / 22.0
    assert 9.0 * share == pytest.approx(0.8, abs=0.03) and 3.3 * share == pytest.approx(0.3)
    text = page().text
    assert "A reading of 1.7 V or more" in text and "0.8 V are pulses of 9 V" in text
    table = printed_table("channels sent")
    assert table[1:] == [
        ["4", "5", "0.91", "0.09"], ["6", "7", "0.87", "0.13"], ["8", "9", "0.84", "0.16"]
    ]  # fmt: skip
    for row in table[1:]:
        low = int(row[1]) * 0.4 / 22.0
        assert 10.0 * low < 1.7 < 2.1 * (1.0 - low)
    for name in ("firmware/README.md", "manual/site/builder/facts.md"):  # the same border there
        text = (ROOT / name).read_text("utf-8")
        assert "1.7 V" in text and "1.3 V" not in text, name


def test_channels_inside_the_bands():
    """By hand, 9 MHz to both sides: A8 (5716 to 5734) and F8 (5871 to 5889) leave 5725 to 5875;
    in Japan 5740 and 5745 lie in 5730 to 5755, and 5780, 5785, 5800 in 5770 to 5810.
    """
    rows = {row[0]: row[1] for row in printed_table("name on most transmitters")[1:]}
    assert rows["band A"].endswith("5745, 5725 (not)") and rows["band F"].endswith("5880 (not)")
    assert (rows["band A"] + rows["band F"]).count("(not)") == 2
    assert "Inside Japan’s bands: 5740, 5745, 5780, 5785, 5800 MHz" in page().text


def test_numbers_of_the_battery_are_those_of_its_cells():
    """By hand for two cells of 300 mAh: 8.4 V full, 7.6 to 7.8 stored, 7.0 landed, 6.4 never; 0.3 A
    at 1 C; 0.8 * 300 = 240 mAh; 7.4 V * 0.3 Ah = 2.2 Wh; 15 + 65 + 2 = 82 min, so 9 packs for a
    flight every 10 min, and four make 240 / 82 = 2.9 flights an hour.
    """
    data = DATA["batteries"]
    part = PARTS["battery"].part
    assert f"{data['cells']}S LiPo {data['capacity_mah']} mAh" in part
    for words in (
        "set to 2 cells, 0.3 A (1 C), end at 8.4 V",
        "Between 0 and 40 °C",
        "charge or discharge to 7.6 to 7.8 V",
        "alarm of 7.0 V",
        "below 6.4 V under load",
        "time flown x 240 mAh / charged mAh",
        "2.2 Wh each, the limit is 100 Wh",
        "82 minutes from take-off to ready again",
        "9 packs keep one aircraft flying every 10 minutes; four make 2.9 flights an hour",
        f"computed for {load_camera().supply.low_v:.1f} V and more",
    ):
        assert words in page().text, words
    (step,) = [s for s in load_checklists().preflight.steps if s.id == "battery"]
    assert step.see.startswith(f"{data['use']['start_v']} V or more")
    owned = PARTS["battery"].quantity + PARTS["spare_batteries"].quantity
    assert owned == 4  # "four make ..."


def test_venue_agrees_with_the_kits_sizing():
    """Sizes by the airframe file; speeds and circle by C = 2 m g / (rho S V^2), n = 1 / cos 30 deg,
    R = V^2 / (g tan 30 deg); the lap by hand: 45 - 22.3 - 2 = 20.7 m.
    """
    venue, built = DATA["venue"], load_airframe(builder_airframe_path())
    for row in venue["sizes"]:
        most = largest_mass(row["hall_width_m"], built, margin=venue["margin_m"], hold_height=True)
        assert row["largest_g"] == pytest.approx(1000.0 * float(most), abs=0.05)
    flight = venue["flight"]
    mass, bank = flight["mass_g"] / 1000.0, math.radians(venue["bank_deg"])
    assert mass == pytest.approx(built.mass)
    slow = math.sqrt(2.0 * mass * 9.8 / (1.20 * 0.076 * 0.6))
    turn = slow / math.sqrt(math.cos(bank))
    circle = 2.0 * turn**2 / (9.8 * math.tan(bank))
    assert flight["speed_m_s"] == pytest.approx(slow, abs=0.006)
    assert flight["turn_speed_m_s"] == pytest.approx(turn, abs=0.006)
    assert flight["circle_m"] == pytest.approx(circle, abs=0.06)
    assert flight["energy_j"] == pytest.approx(0.5 * mass * turn**2, abs=0.06)
    length = venue["hall_m"][1]
    assert flight["straight_m"] == pytest.approx(length - circle - venue["margin_m"], abs=0.06)
    assert flight["reaction_m"] == round(turn)
    (people,) = [row for row in venue["rules"] if row["id"] == "people"]
    assert f"flight are {2 * flight['reaction_m']} m" in people["why"]
    (net,) = [row for row in venue["rules"] if row["id"] == "net"]
    front = venue["hall_m"][0] - circle - 0.5 * venue["margin_m"] - 2.0
    assert flight["net_m"] == pytest.approx(front, abs=0.06)
    assert f"2 m from it, so that the lap stays {flight['net_m']} m in front" in net["value"]
    divided = 2 * venue["hall_m"][1] / 3 - circle - venue["margin_m"]  # two of three court units
    assert f"a lap then has {divided:.1f} m of straight" in net["why"]
    assert len(venue["checklist"]) >= 10


def test_limits_of_the_trim_flights_are_computed_right():
    """By hand: 2 pi 11.16 / 7.95 = 8.8 s a circle; half a second at 7.40 m/s is 3.7 m; without
    thrust it loses g (CD / CL) t = 9.8 * (0.05 + 0.07 * 0.36) / 0.6 * 0.5 = 0.6 m/s; 20 m in 3.5 s
    are 5.71 m/s and C = 2 * 0.1527 * 9.8 / (1.2 * 0.076 * 5.71^2) = 1.01. The hop's tape: from 1 m
    it glides 0.6 / 0.0752 = 8.0 m; 45 - 7.4 - 8.0 - 8 - 2 = 19.6 m. Circle of 11.16 m at 40 deg:
    sqrt(9.8 * 11.16 * 0.839) = 9.58 m/s, C = 0.6 sin 30 deg / sin 40 deg = 0.467.
    """
    text = page().text
    for words in (
        "8.8 s a circle at 7.95 m/s",
        "22.3 m from wall to wall",
        "In 0.5 s it flies 3.7 m and loses 0.6 m/s of speed without thrust",
        "hold the switch for 0.5 s",
        "16 m to the wall",
        "bank by less than 10°",
        "A tape across the middle line, 19 m from the starting wall",
        "at 7.4 m/s, 8 m of descent",
        "at 40° of bank and 9.6 m/s have the same 22.3 m and a lift coefficient of 0.47",
    ):
        assert words in text, words
    table = printed_table("20 m in")
    assert table[0][1:] == ["2.7 s", "3 s", "3.5 s", "4 s"]
    assert table[1][3] == "5.71" and table[2][3] == "1.01"
    for time, speed, lift in zip(table[0][1:], table[1][1:], table[2][1:], strict=True):
        v = 20.0 / float(time.split()[0])
        assert float(speed) == pytest.approx(v, abs=0.006)
        assert float(lift) == pytest.approx(2 * 0.1527 * 9.8 / (1.2 * 0.076 * v * v), abs=0.006)


def test_each_trim_flight_has_its_conditions():
    """By hand first, then with the computer; each with entry, what is flown, note, limit, stop; no
    brace is left over, and the step of chapter 12 that is named is that one.
    """
    flights = DATA["trim_flights"]["flights"]
    assert [f["computer"] for f in flights] == sorted(f["computer"] for f in flights)
    assert len(flights) >= 8
    for flight in flights:
        assert all(len(flight[k]) > 15 for k in ("entry", "fly", "note", "limit", "stop"))
    assert not re.search(r"\{\w+\}", page().text)
    chapter = (MANUAL / "chapters" / "5_fly.typ").read_text("utf-8").split("= First autonomous")[1]
    steps = re.split(r"\n  step", chapter.split("#steps(")[1])[1:]
    assert "hand-overs last one second" in steps[6] and "THROTTLE_CEILING_US" in steps[5]


def test_what_a_no_at_the_step_of_the_throttle_cut_forbids():
    """That step is no STOP: a no forbids the computer's flights, not those by hand, and the trainer
    plug is out in all of them. Bench test, preflight, table of leads and flights say the same.
    """
    lists = load_checklists()
    number, step = next((k, s) for k, s in enumerate(lists.bench.steps, 1) if s.id == "cut_student")
    assert number == 12 and not step.stop
    assert "no flight with the computer, and every flight with the trainer plug out" in step.if_not
    plug = next(s for s in lists.preflight.steps if s.id == "trainer_plug")
    assert 'every flight after a no at the bench test\'s step "cut student": pull' in plug.do
    entry = {flight["id"]: flight["entry"] for flight in DATA["trim_flights"]["flights"]}
    assert 'after a no at "cut student" alone the trainer plug is out' in entry["ground"]
    assert all('"cut student" a yes' in entry[name] for name in ("drill_air", "one_second"))
    assert "the plug is out here too" in entry["log"]
    row = next(row for row in printed_table("when") if row[0] == "flight by hand with a log")
    assert row[1] == "16a, switch not held; none after a no at bench step 12"


def test_no_line_ends_inside_an_option():
    """Two hyphens and a word on two lines are typed as two words: each option of a command is one
    piece, in both forms by one rule.
    """
    code = re.findall(r"<code[^>]*>(.*?)</code>", html(), re.S)
    bare = [
        c for c in code if re.search(r"--[a-z]", re.sub(r'<span class="option">.*?</span>', "", c))
    ]
    assert bare == []
    assert '<span class="option">--hall-width-m</span>' in html()


def test_every_flight_has_all_people_behind_the_net():
    """A hand-over point is reached by a lap, so no flight of this book lets anyone stand beside the
    path: figures, preflight, venue and safety rules say the same; no chapter sends the pilots
    elsewhere. The charging place is outside the hall. Marker and pad stand in the hall in no flight
    before the log.
    """
    people = next(s for s in load_checklists().preflight.steps if s.id == "people")
    rules = {row["id"]: row["value"] for row in DATA["venue"]["rules"]}
    assert people.do.startswith("Everybody, the pilots too, behind the net")
    assert "in every flight of this book" in rules["people"] and "in approaches" in rules["pilots"]
    text = page().text
    assert "Everybody stands behind the net or outside, the pilots too" in text
    assert "behind the pilots" not in text and "traight approaches" not in text
    words = {n: (MANUAL / "figures" / f"{n}.txt").read_text("utf-8") for n in ("approach", "venue")}
    assert "pilots stand" not in words["approach"]
    assert "charging place with its guard is outside the hall" in words["venue"]
    flights = {flight["id"]: flight["entry"] for flight in DATA["trim_flights"]["flights"]}
    assert list(flights).index("log") > list(flights).index("circles")
    assert "Marker and pad out" in flights["ground"] and "marker and pad set up" in flights["log"]


def test_troubleshooting_quotes_messages_that_exist():
    """At least 25 symptoms, each with cause, test and remedy; a quoted message stands in its file;
    every command in the cells was given to the parser.
    """
    rows = [row for part in DATA["troubleshooting"]["parts"] for row in part["rows"]]
    assert len(rows) >= 25
    origins = {row["origin"] for row in rows}
    assert origins == {"message", "doctor", "firmware", "physics", "report"}
    for row in rows:
        assert all(len(row[name]) > 5 for name in ("symptom", "cause", "test", "remedy")), row
        assert ("message" in row) == (row["origin"] in ("message", "doctor")), row["symptom"]
        if "message" in row:
            assert row["message"] in (ROOT / row["file"]).read_text("utf-8"), row["symptom"]
    cells = [row[name] for row in rows for name in ("symptom", "cause", "test", "remedy")]
    typed = {line for text in cells for line in re.findall(r"`(falconwing \S+ [^`]+)`", text)}
    known = {found["value"]["line"] for found in elements("<command>")}
    assert len(typed) > 10 and typed <= known


def test_spares_cost_what_the_parts_list_says():
    """Summed here from the CSV."""
    with (ROOT / "hardware" / "parts.csv").open(encoding="utf-8", newline="") as file:
        price = {row["id"]: row["price_usd"] for row in csv.DictReader(file)}
    spares = DATA["spares"]
    total = sum(row["quantity"] * float(price[row["part"]]) for row in spares["spares"])
    assert f"for one term: {math.floor(total + 0.5)} US" in page().text
    assert spares["class_size"] == 10 == 2 * spares["pairs"]
    quantity = {row["part"]: row["quantity"] for row in spares["spares"]}
    assert quantity["trainer_board"] + 1 == spares["pairs"] == quantity["trainer_lead"]
    assert f"{quantity['spare_batteries'] + 1} packs keep one aircraft" in page().text
    for row in spares["spares"]:
        assert printed(PARTS[row["part"]].part), row["part"]


def test_every_row_is_printed_in_the_book_and_on_the_site(tmp_path):
    """Cells of the data against the HTML, and the HTML's chapters against the site's pages; rows of
    tables in the PDF by their tags.
    """
    cells = [
        row[name]
        for file in ("radio", "batteries", "venue", "video", "troubleshooting", "trim_flights")
        for rows in DATA[file].values()
        if isinstance(rows, list)
        for group in rows
        if isinstance(group, dict)
        for row in group.get("rows", [group])
        for name in ("menu", "value", "why", "see", "so", "says", "symptom", "remedy", "fly", "do")
        if name in row and "{" not in row[name]
    ]
    assert len(cells) > 200
    assert [cell for cell in cells if not printed(cell)] == []
    stage = Stage(tmp_path, Settings(), tmp_path / "nothing")
    (tmp_path / "_static").mkdir()
    book_pages(html(), stage)
    site = "".join(path.read_text("utf-8") for path in sorted(tmp_path.glob("builder/*.md")))
    words = re.sub(r"\s+", " ", Page(site).text)
    straight = re.sub("[“”]", '"', words).replace("’", "'")
    assert [cell for cell in cells if words_of(cell) not in straight] == []
    assert len(re.findall(r"/S\s*/TR\b", pdf_objects())) == len(page().all("tr")) > 250


def test_a_planted_broken_reference_stops_the_build(tmp_path, monkeypatch):
    """A label that no heading has, in a cell of a copy: the build names it."""
    copied = tmp_path / "manual"
    shutil.copytree(MANUAL, copied, ignore=shutil.ignore_patterns("site", "__pycache__"))
    for name in ("hardware", "labs"):
        shutil.copytree(ROOT / name, tmp_path / name)
    path = copied / "builder" / "radio.toml"
    text = path.read_text("utf-8")
    path.write_text(text.replace('value = "airplane"', 'value = "airplane @nowhere"'))
    monkeypatch.setattr(BUILD, "FOLDER", copied)
    monkeypatch.setattr(BUILD, "ROOT", tmp_path)
    with pytest.raises(RuntimeError, match="nowhere"):
        BUILD.compiled("html", Settings())


def test_codes_lead_to_the_chapters_pages(tmp_path):
    """Read from the pages as a camera would, by OpenCV: one code a chapter, each the address of a
    page that the site has, and one a step, each the address of a place on such a page.
    """
    (tmp_path / "_static").mkdir()
    book_pages(html(), Stage(tmp_path, Settings(), tmp_path / "nothing"))
    pages = [path.stem for path in (tmp_path / "builder").glob("*.md")]
    read = set()
    for image in BUILD.compiled("png", PUBLISHED, ppi=200):
        picture = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
        height, width = picture.shape
        for top in range(0, height, height // 20):  # strips: several codes stand on one page
            strip = np.ascontiguousarray(picture[top : top + height // 8, 3 * width // 4 :])
            coarse = cv2.resize(strip, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
            if coarse.min() > 64:  # no black square of 10 px, as in a code's corners
                continue
            for scale in (1.0, 0.7):  # a phone is moved until it reads, too
                sized = cv2.resize(strip, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                text, _, _ = cv2.QRCodeDetector().detectAndDecode(sized)
                read |= {text} - {""}
                if text:
                    break
    places = [
        f"{path.stem}.html#{place}"
        for path in (tmp_path / "builder").glob("*.md")
        for place in re.findall(r'id="(step-\w+)"', path.read_text("utf-8"))
    ]
    assert len(places) == len(set(places)) >= 25
    wanted = {f"{PUBLISHED.site_url}/builder/{name}.html" for name in pages}
    assert read == wanted | {f"{PUBLISHED.site_url}/builder/{place}" for place in places}
    assert len(pages) == len(re.findall(r"<h2[^>]*>\d+ ", html())) > 20


def test_without_a_published_place_there_is_no_code_and_no_button():
    """As shipped; and a repository elsewhere than GitHub has buttons no more than none has."""
    nothing = BUILD.published(Settings())
    assert nothing == {"codes": {}, "steps": {}, "labs": []}
    assert BUILD.published(Settings(repository_url="https://example.org/kit")) == nothing
    assert "Run in the browser" not in page().text and "mybinder" not in html()


def test_launch_buttons_start_notebooks_that_exist():
    """An address for each lab, its path at the end."""
    labs = BUILD.published(PUBLISHED)["labs"]
    paths = [lab["url"].split("labpath=")[1] for lab in labs]
    assert len(paths) == len(list((ROOT / "labs").glob("lab[0-9]*"))) >= 12
    assert all((ROOT / path).is_file() for path in paths)
    text = BUILD.compiled("html", PUBLISHED).decode("utf-8")
    assert [lab["url"] for lab in labs if f'href="{lab["url"]}"' not in text] == []
    assert json.dumps(BUILD.published(PUBLISHED)).count("<svg") >= BUILD.MAX_CHAPTERS + 25
