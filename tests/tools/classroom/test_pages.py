"""Wall, seat and desk in Chromium against a tiny class that speaks the protocol by `struct`: what
they show, what they send, and what they say when the connection is gone.

Renderer, cameras, sticks and player are stand-ins here; they have tests of their own.
"""

import re
import struct
import time

import numpy as np
import pytest

from tests.chromium import headless_chromium
from tests.tools.classroom.fake_class import PAGE, FakeClass, picture_bytes, state_bytes

SPLATS = """
export class SplatView {
  constructor() { globalThis.drawn = 0; }
  static supported() { return !location.search.includes("nogl"); }
  async load() {}
  setAircraft(list) { globalThis.aircraft = list.length; }
  draw() { globalThis.drawn += 1; }
}
"""
CAMERA = """
export const poseMatrix = (x, y, z) => [1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, z, 0, 0, 0, 1];
export const chaseCamera = (pose) => pose;
export const noseCamera = (pose) => pose;
export const towerCamera = (pose) => pose;
export const interpolatePoses = (a, b) => b;
"""
# Sticks at a quarter, -0.5, 0.75 and 1: numbers that 32 bits hold exactly.
STICKS = """
export const STICK_MODES = { 2: ["rudder", "throttle", "aileron", "elevator"] };
export function movedAxis(before, after) {
  const index = after.findIndex((value, i) => Math.abs(value - before[i]) > 0.5);
  return index < 0 ? null : { index, sign: Math.sign(after[index] - before[index]) };
}
export class Sticks {
  constructor() {
    const reversed = { throttle: false, aileron: false, elevator: false, rudder: false };
    this._settings = { mode: 2, deadBand: 0.05, expo: 0.3, assist: true, reversed };
    globalThis.given = [];
  }
  read() {
    const hold = Boolean(globalThis.keyHeld);
    return { throttle: 0.25, aileron: -0.5, elevator: 0.75, rudder: 1, hold, source: "keyboard" };
  }
  get settings() { return this._settings; }
  set settings(change) {
    given.push(change);
    this._settings = { ...this._settings, ...change };
  }
  match() {}
  drawTouch() {}
  dispose() {}
}
"""
AFTER = """
export class AfterFlight {
  constructor(box) { this.box = box; }
  async open(number) { this.box.textContent = `player of flight ${number}`; }
  close() {}
}
"""
STUBS = {"splats.js": SPLATS, "camera.js": CAMERA, "sticks.js": STICKS, "after.js": AFTER}
UNPACK = """async (bytes) => {
  const { unpackState } = await import("/page/channel.js");
  return unpackState(new Uint8Array(bytes).buffer);
}"""
FLIGHT = {
    "type": "flight", "number": 7, "task": "follow", "manoeuvre": "figure_eight", "seed": 1,
    "pilot": "expert", "start": {"t": 0}, "phases": ["approach", "flare"], "effects": ["wind"],
}  # fmt: skip
WHO = {
    "type": "who", "holder": "autopilot", "name": "", "client": 0, "reason": "", "queue": [],
    "owner_may": 0,
}  # fmt: skip
VERDICT = {
    "type": "verdict", "flight": 6, "sentence": "On the pad, 4 cm left.", "success": True,
    "numbers": {"touchdown speed": [0.26, "m/s"], "beside": [-3.04, "cm left"]},
    "holders": ["Mia"], "logged": None,
}  # fmt: skip


def until(page, condition, wait_s=20.0):
    """Wait for a condition in JavaScript; Playwright's own wait needs an eval that the security
    policy forbids.
    """
    give_up = time.monotonic() + wait_s
    while not page.evaluate(condition):
        assert time.monotonic() < give_up, condition
        page.wait_for_timeout(20)


@pytest.fixture(scope="module")
def browser():
    """One browser for this file."""
    with headless_chromium() as browser:
        yield browser


@pytest.fixture
def school():
    """A class without anybody in it."""
    with FakeClass(STUBS) as school:
        yield school


@pytest.fixture
def visit(browser, school):
    """Opens pages of the class; a page's error, or a line against the security policy, fails."""
    contexts, complaints = [], []

    def visit(path, width=1920, height=1080, wait=True, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "console",
            lambda line: complaints.append(line.text) if "Policy" in line.text else None,
        )
        page.goto(school.url + path)
        if wait:
            page.wait_for_selector("html[data-connected=true]")
            until(page, "classroomPage.hello !== null")
        return page

    yield visit
    for context in contexts:
        context.close()
    assert complaints == []


def test_pages_hold_no_script_style_or_foreign_address_of_their_own():
    """The security policy allows none, and the pages need no network but the class's."""
    for file in PAGE.glob("*.html"):
        text = file.read_text(encoding="utf-8")
        if file.name == "share.html":
            continue  # one file by purpose
        assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\ssrc=)", text), file.name
        assert not re.search(r"https?://", text), file.name
    assert not re.search(r"@import|url\(", (PAGE / "style.css").read_text(encoding="utf-8"))


def test_modules_can_be_joined_into_one_file():
    """Names at the top are unique over all modules, and imports and exports have one plain form,
    so that joining them is dropping import lines and the word export.
    """
    names = []
    for file in PAGE.glob("*.js"):
        lines = file.read_text(encoding="utf-8").splitlines()
        assert lines[0].startswith("// "), file.name
        for line in lines:
            if line.startswith("import"):
                assert re.fullmatch(r'import \{ [\w, ]+ \} from "\./\w+\.js";', line), (
                    file.name,
                    line,
                )
            if line.startswith("export"):
                assert re.match(r"export (async )?(function|class|const) \w", line), (
                    file.name,
                    line,
                )
            found = re.match(r"(?:export )?(?:async )?(?:function|class|const|let) (\w+)", line)
            names += [found[1]] if found else []
    assert len(names) > 30
    assert sorted(set(names)) == sorted(names)


def luminance(color):
    """Relative luminance of #rrggbb. [WCAG 2.2, definition of relative luminance]"""
    parts = np.array([int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    parts = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(parts @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", ["light", "dark", "contrast"])
def test_text_has_enough_contrast_in_every_theme(theme):
    """4.5 : 1 for text, 7 : 1 in high contrast. [WCAG 2.2, success criteria 1.4.3 and 1.4.6]"""
    style = (PAGE / "style.css").read_text(encoding="utf-8")
    blocks = [":root {"] + ([] if theme == "light" else [f'\n[data-theme="{theme}"] {{'])
    colors = {}
    for block in blocks:
        body = style[style.index(block) :].split("}", 1)[0]
        colors.update(re.findall(r"--([\w-]+): (#\w{6})\b", body))
    on_ground = ("ink", "quiet", "blue", "rust", "accent", "good", "bad")
    pairs = [*((text, ground) for text in on_ground for ground in ("paper", "card"))]
    pairs += [("on-who", f"who-{who}") for who in ("autopilot", "student", "safe")]
    pairs += [("on-accent", "accent"), ("on-danger", "danger")]
    for pair in pairs:
        low, high = sorted(luminance(colors[name]) for name in pair)
        assert (high + 0.05) / (low + 0.05) >= (7.0 if theme == "contrast" else 4.5), pair


def test_bytes_are_read_and_written_as_the_protocol_says(visit):
    """Packed and unpacked here by `struct`, field by field from the protocol's table."""
    page = visit("/wall")
    numbers = [float(i) + 0.5 for i in range(21)]
    packed = struct.pack("<BBBBHHf21f", 1, 1 | 2 | 32, 3, 4, 600, 65535, 2.5, *numbers)
    state = page.evaluate(UNPACK, list(packed))
    assert state == {
        "paused": True, "stretched": False, "over": False, "port": False, "assist": True,
        "holder": "safe", "phase": 4, "flight": 600, "step": 65535, "t": 2.5,
        "pose": numbers[:6], "velocity": numbers[6:9], "command": numbers[9:13],
        "leader": numbers[13:19], "rate": 19.5, "speed": 20.5,
    }  # fmt: skip
    sticks = page.evaluate(
        """async () => {
          const { packSticks } = await import("/page/channel.js");
          const sticks = { throttle: 7, aileron: -0.5, elevator: NaN, rudder: -3 };
          return [...new Uint8Array(packSticks(sticks, true, true, 65537, 2 ** 32 + 9.7))];
        }"""
    )
    assert struct.unpack("<BBHI4f", bytes(sticks)) == (3, 3, 1, 9, 1.0, -0.5, 0.0, -1.0)
    for broken in (b"", packed[:-1], packed[:50], b"\x09" + packed[1:]):
        assert page.evaluate(UNPACK, list(broken)) is None


def test_wall_says_who_flies_and_what_happens(visit, school):
    """The words of the issue; a name is text, so an injected tag is seen and makes nothing bold."""
    page = visit("/wall")
    school.say(FLIGHT)
    school.say(WHO)
    until(page, "who.textContent === 'AUTOPILOT' && task.textContent === 'Follow: figure eight'")
    school.say({**WHO, "holder": "safe", "reason": "no sticks for 200 ms"})
    until(page, "who.textContent === 'SAFE: sticks neutral, motor idle'")
    school.say({**WHO, "holder": "student", "name": "<b>Mia</b>", "reason": "<i>x</i>"})
    until(page, "who.textContent === 'STUDENT: <b>Mia</b>' && reason.textContent === '<i>x</i>'")
    assert page.locator("#who b, #reason i").count() == 0
    row = {"name": "<b>Li</b>", "task": "landing", "score": 4.2, "unit": "cm", "flight": 1}
    school.say({"type": "board", "rows": [row]})
    school.say({"type": "event", "t": 1.0, "flight": 7, "name": "hands", "text": "<u>Li</u> asks."})
    until(
        page, "board.textContent.includes('<b>Li</b>') && events.textContent === '<u>Li</u> asks.'"
    )
    school.say({**VERDICT, "holders": ["<b>Mia</b>"]})
    until(page, "verdict.offsetHeight > 0 && verdict.textContent.includes('0.26 m/s')")
    assert "3.04 cm right" in page.text_content("#verdict")
    assert page.locator("main b, main u").count() == 0
    assert page.text_content("#simulation") == "SIMULATION"
    assert page.is_hidden("#qr"), "this class has no /qr.svg"
    assert page.is_hidden("#time")
    school.say(state_bytes(1.0, flags=4, speed=0.6))
    until(page, "time.offsetHeight > 0 && time.textContent.startsWith('TIME IS STRETCHED')")
    school.say(state_bytes(1.05, speed=0.25))
    until(page, "time.textContent === 'SLOW MOTION: 0.25 of real time'")
    school.say(state_bytes(1.1, flags=16))
    until(page, "simulation.textContent === 'SIMULATION, through the board' && !time.offsetHeight")
    page.keyboard.press("r")
    until(page, "replay.open && replay.textContent.trim() === 'player of flight 6'")
    school.say({**WHO, "holder": "student", "name": "Mia"})
    until(page, "!replay.open")


def test_wall_uses_no_type_under_24_px(visit, school):
    """Every text that is seen at 1080p, the canvases' own too; who flies in 40 px."""
    page = visit("/wall")
    row = {"name": "Li", "task": "landing", "score": 4.2, "unit": "cm", "flight": 1}
    for message in (
        FLIGHT, {**WHO, "holder": "student", "name": "Mia", "reason": "Mia holds"}, VERDICT,
        {"type": "board", "rows": [row]}, {"type": "event", "t": 1.0, "text": "Wind is on."},
        state_bytes(1.0, flags=4, speed=0.5),
    ):  # fmt: skip
        school.say(message)
    until(page, "verdict.offsetHeight > 0 && time.offsetHeight > 0")
    for theme in ("light", "dark", "contrast"):
        sizes = page.evaluate(
            """() => [...document.querySelectorAll("body *")].filter((one) => {
              const text = [...one.childNodes].some((one) => one.nodeType === 3 && one.data.trim());
              return one.checkVisibility() && (text || one.tagName === "CANVAS");
            }).map((one) => [one.outerHTML, parseFloat(getComputedStyle(one).fontSize)])"""
        )
        assert len(sizes) > 25
        assert [row for row in sizes if row[1] < 24.0] == [], theme
        page.keyboard.press("t")
    who = page.evaluate("parseFloat(getComputedStyle(who).fontSize)")
    assert 40.0 <= who < 44.0
    assert page.evaluate("document.documentElement.scrollHeight") <= 1080


def test_without_webgl2_pictures_are_shown_and_that_is_said(visit, school):
    """Pictures are asked for and drawn, and no longer asked for while the hall itself is seen."""
    page = visit("/?nogl", 390, 844)
    assert school.next_text("picture")["on"] is True
    assert "no WebGL2" in page.text_content(".hall-note")
    school.say(picture_bytes(1))
    until(page, "document.querySelector('.hall-picture').dataset.pictures === '1'")
    pixel = page.evaluate(
        """[...document.querySelector(".hall-picture").getContext("2d")
            .getImageData(160, 120, 1, 1).data]"""
    )
    np.testing.assert_allclose(pixel[:3], 220, atol=6)  # JPEG
    other = visit("/", 390, 844)
    school.say(state_bytes(1.0))
    until(other, "globalThis.drawn > 0 && globalThis.aircraft === 1")
    other.click("text=Picture")
    assert school.next_text("picture")["on"] is True
    other.click("text=Tower")
    assert school.next_text("picture")["on"] is False


def test_a_flight_that_stands_still_is_not_drawn_again(visit, school):
    """The server repeats the newest state: after 700 ms, when the last order has come, the wall
    draws neither the hall nor the charts for it; it does for the next one that moves.
    """
    page = visit("/wall")
    school.say(state_bytes(1.0))
    until(page, "globalThis.drawn > 0 && document.querySelector('.chart canvas').width > 20")
    until(page, "classroomPage.state && !classroomPage.drawn")  # the pad is drawn before a state
    page.evaluate(
        """() => {
          const { view, charts } = classroomPage;
          const wake = view.wake.bind(view), draw = charts.draw.bind(charts);
          Object.assign(globalThis, { wakes: 0, charted: 0, heard: 0 });
          view.wake = () => { wakes += 1; wake(); };
          charts.draw = () => { charted += 1; draw(); };
          classroomPage.channel.on("state", () => { heard += 1; });
        }"""
    )
    for _ in range(20):
        school.say(state_bytes(1.0))
    until(page, "heard === 20")
    page.wait_for_timeout(800)
    before = page.evaluate("drawn")
    school.say(state_bytes(1.0))
    until(page, "heard === 21")
    page.wait_for_timeout(100)
    assert page.evaluate("[wakes, charted, drawn]") == [0, 0, before]
    school.say(state_bytes(1.05))
    until(page, "wakes === 1 && charted === 1 && drawn > " + str(before))
    # A page that had no time for a second, or was hidden, still draws the newest state.
    before = page.evaluate(
        """() => {
          classroomPage.view.wake();
          const end = performance.now() + 1000;
          while (performance.now() < end);
          return drawn;
        }"""
    )
    until(page, "drawn > " + str(before))


def test_seat_asks_waits_and_flies_only_while_held(visit, school):
    """24 bytes at about 50 Hz while the button is held, one more with hold = 0, no others."""
    page = visit("/", 390, 844, has_touch=True, is_mobile=True)
    page.fill("#name", "<b>Mia</b>")
    page.click("#ask")
    assert school.next_text("name")["name"] == "<b>Mia</b>"
    school.next_text("ask")
    me = page.evaluate("classroomPage.channel.client")
    queue = [{"client": 77, "name": "Li"}, {"client": me, "name": "Mia"}]
    school.say({**WHO, "queue": queue})
    until(page, "line.textContent === 'You are 2nd in the queue.'")
    assert page.is_hidden("#hold")
    page.evaluate("globalThis.keyHeld = true")  # held before there is leave to fly
    time.sleep(0.1)
    assert school.binaries.empty()
    page.evaluate("globalThis.keyHeld = false")
    school.say({**WHO, "owner_may": me})
    hold = page.locator("#hold")
    hold.wait_for(state="visible")
    assert school.binaries.empty()
    hold.dispatch_event("pointerdown", {"pointerId": 1, "isPrimary": True})
    page.wait_for_timeout(400)
    hold.dispatch_event("pointerup", {"pointerId": 1})
    until(page, "hold.getAttribute('aria-pressed') === 'false'")
    page.wait_for_timeout(100)
    messages = [
        struct.unpack("<BBHI4f", school.binaries.get()) for _ in range(school.binaries.qsize())
    ]
    assert 5 <= len(messages) <= 40  # 20 on a free machine
    assert {message[0] for message in messages} == {3}
    assert [message[1] for message in messages] == [3] * (len(messages) - 1) + [2]
    assert [message[2] for message in messages] == list(range(len(messages)))
    assert {message[4:] for message in messages} == {(0.25, -0.5, 0.75, 1.0)}
    assert 200 <= messages[-1][3] - messages[0][3] <= 5000  # ms of the browser's clock
    # The button says that this seat flies only when the class says so.
    page.evaluate("globalThis.keyHeld = true")
    until(page, "hold.textContent === 'HOLD AGAIN'")
    mine = {**WHO, "holder": "student", "name": "Mia", "client": me, "owner_may": me}
    school.say(mine)
    until(page, "hold.textContent === 'YOU FLY'")
    page.evaluate("globalThis.keyHeld = false")
    until(page, "hold.textContent === 'HOLD TO FLY'")
    while school.binaries.get(timeout=20)[1] != 2:
        pass
    # Every way out of the page lets go: here the window loses the focus.
    page.evaluate("globalThis.keyHeld = true")
    assert school.binaries.get(timeout=20)[1] == 3
    page.evaluate("globalThis.keyHeld = false; dispatchEvent(new Event('blur'))")
    while school.binaries.get(timeout=20)[1] != 2:
        pass
    # The teacher takes back.
    page.evaluate("globalThis.keyHeld = true")
    assert school.binaries.get(timeout=20)[1] == 3
    school.say(WHO)
    while school.binaries.get(timeout=20)[1] != 2:
        pass
    page.wait_for_timeout(60)
    assert school.binaries.empty()


def test_seat_keeps_settings_and_learns_a_gamepad(visit, school):
    """A gamepad whose axes are swapped in pairs, one of them turned around, moved as asked."""
    page = visit("/", 390, 844)
    page.click("text=Sticks: settings")
    page.select_option("#set-mode", "1")
    page.fill("#set-expo", "0.6")
    page.check("#set-elevator")
    page.uncheck("#set-assist")
    assert school.next_text("assist")["on"] is True  # with the greeting
    assert school.next_text("assist")["on"] is False
    last = page.evaluate("given.at(-1)")
    assert (last["mode"], last["expo"], last["assist"]) == (1, 0.6, False)
    assert last["reversed"]["elevator"] and not last["reversed"]["aileron"]
    page.select_option("#set-mode", "2")
    page.evaluate(
        """() => {
          globalThis.axes = [0, 0, 0, 0];
          navigator.getGamepads = () => [{ connected: true, axes: globalThis.axes, buttons: [] }];
        }"""
    )
    page.click("text=Assign the gamepad's sticks")
    for step, (axis, value) in enumerate([(2, 1), (3, 1), (0, -1), (1, 1)]):
        until(page, f"document.querySelector('.assign').textContent.startsWith('{step + 1} of 4')")
        page.evaluate(f"axes[{axis}] = {value}")
        until(page, "document.querySelector('.assign').textContent === 'Let go.'")
        page.evaluate(f"axes[{axis}] = 0")
    until(page, "document.querySelector('.assign').textContent.startsWith('Done')")
    last = page.evaluate("given.at(-1)")
    assert last["axes"] == [2, 3, 0, 1]
    assert last["reversed"] == {
        "rudder": False, "throttle": False, "aileron": True, "elevator": False,
    }  # fmt: skip


def test_no_page_is_wider_than_a_phone(visit, school):
    """Nothing to scroll sideways upright at 390 px nor on its side at 844, with long names."""
    long = "Ein-ganz-langer-Name-ohn"
    for path, width, height in (("/", 390, 844), ("/", 844, 390), ("/desk?key=k", 390, 844)):
        page = visit(path, width, height, has_touch=True, is_mobile=True)
        me = page.evaluate("classroomPage.channel.client")
        school.say({**FLIGHT, "effects": ["wind", "control delay", "drag", "trim"]})
        school.say(
            {**WHO, "holder": "student", "name": long, "queue": [{"client": 9, "name": long}]}
        )
        school.say(
            {
                "type": "board",
                "rows": [{"name": long, "task": "landing", "score": 1.0, "unit": "cm"}],
            }
        )
        school.say({**VERDICT, "sentence": long * 3})
        school.say(state_bytes(1.0, flags=4, speed=0.5))
        until(page, "verdict.textContent.includes('Success')")
        for details in page.locator("summary").all():
            details.click()
        for owner in (0, me):
            school.say({**WHO, "owner_may": owner})
            page.wait_for_timeout(50)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, (
                path,
                width,
                owner,
            )
        page.close()


def test_desk_buttons_send_what_they_say(visit, school):
    """Each control of the desk, one message each; taking back by button and by Escape."""
    page = visit("/desk?key=k", 1366, 768)
    school.say({**WHO, "queue": [{"client": 5, "name": "<b>Li</b>"}]})
    page.click("text=Give")
    assert school.next_text("give") == {"type": "give", "client": 5}
    assert page.locator("#queue b").count() == 0
    page.click("#take")
    school.next_text("take")
    page.focus("#task")
    page.keyboard.press("Escape")
    school.next_text("take")
    school.say(state_bytes(1.0))
    page.click("#pause")
    assert school.next_text("pause")["on"] is True
    school.say(state_bytes(1.0, flags=2))
    until(page, "pause.getAttribute('aria-pressed') === 'true'")
    page.click("#pause")
    assert school.next_text("pause")["on"] is False
    page.click("text=Slow 0.25")
    assert school.next_text("speed")["value"] == 0.25
    page.click("#restart")
    school.next_text("restart")
    page.click("#record")
    assert school.next_text("record")["on"] is True
    drag = page.locator("[role=switch]", has_text="More drag than the model has.")
    drag.click()
    assert school.next_text("effect") == {"type": "effect", "name": "drag", "on": True}
    assert drag.get_attribute("aria-checked") == "false", "until the class says so"
    school.say({"type": "effects", "active": ["drag"]})
    until(page, "document.querySelectorAll('[aria-checked=true]').length === 1")
    drag.click()
    assert school.next_text("effect")["on"] is False
    page.select_option("#task", "follow")
    page.select_option("#manoeuvre", "figure_eight")
    page.click("text=Fly this")
    assert school.next_text("task") == {
        "type": "task",
        "task": "follow",
        "manoeuvre": "figure_eight",
    }
    page.click("#end")
    page.click("#end")
    page.wait_for_timeout(100)
    assert school.texts.empty(), "the class ends after two questions"
    page.click("#end")
    school.next_text("end")


def test_lost_connection_is_said_and_mended(visit, school):
    """An abnormal end is retried, then the sentence goes; a normal end is the end of the class."""
    page = visit("/", 390, 844)
    me = page.evaluate("classroomPage.channel.client")
    school.say({**WHO, "owner_may": me})
    page.locator("#hold").wait_for(state="visible")
    page.evaluate(
        """globalThis.sentences = [];
        classroomPage.channel.on("status", (status) => sentences.push(status.sentence))"""
    )
    school.drop(1011)
    until(page, "sentences.some((text) => text.startsWith('The connection to the class is lost.'))")
    until(page, "document.documentElement.dataset.connected === 'true' && connection.hidden")
    assert page.is_hidden("#hold"), "leave to fly ends with the connection"
    school.drop(1001)
    until(page, "connection.textContent.startsWith('The class has ended.') && !connection.hidden")


def test_buttons_and_fields_have_names(visit):
    """A screen reader has a word for every control; the line that says who flies is announced."""
    for path, width in (("/wall", 1920), ("/", 390), ("/desk?key=k", 1366)):
        page = visit(path, width, 800)
        nameless = page.evaluate(
            """() => [...document.querySelectorAll("button, input, select, canvas, dialog, img")]
            .filter((one) => {
              const label = one.labels && one.labels.length ? one.labels[0].textContent : "";
              const words = one.getAttribute("aria-label") || one.getAttribute("alt");
              return !(label || one.textContent).trim() && !words;
            }).map((one) => one.outerHTML.slice(0, 80))"""
        )
        assert nameless == [], path
        assert page.get_attribute("#who", "aria-live") in ("polite", "assertive")
        page.close()
