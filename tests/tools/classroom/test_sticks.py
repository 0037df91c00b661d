"""Sticks of the page in Chromium: shaping, keys, a gamepad, two thumbs; and their Python copy."""

import math
from pathlib import Path

import numpy as np
import pytest

import falconwing_kit
from falconwing_kit.flight.manual import SILENCE_S
from tests.chromium import headless_chromium
from tests.tools.classroom.stick_keys import key_step, shape

PAGE = Path(falconwing_kit.__file__).parent / "tools" / "classroom" / "page"
ADDRESS = "http://sticks.test/"
HTML = '<!doctype html><input id="text"><div id="box" style="width:360px"></div>'
# The page's clock is `now` [ms], so that key presses last as long as the test says.
OPEN = """async () => {
  window.now = 0;
  performance.now = () => window.now;
  window.kit = await import("/sticks.js");
  window.sticks = new window.kit.Sticks(document.getElementById("box"), {});
}"""
READ = "ms => { window.now = ms; return window.sticks.read(); }"
PADS = """gamepads => { navigator.getGamepads = () => gamepads; }"""


@pytest.fixture(scope="module")
def browser():
    with headless_chromium() as browser:
        yield browser


@pytest.fixture
def page(browser):
    """A page with sticks in it, in a browser that keeps nothing from before."""
    context = browser.new_context(viewport={"width": 390, "height": 844})
    page = context.new_page()

    def answer(route):
        if route.request.url.endswith("sticks.js"):
            text = (PAGE / "sticks.js").read_text(encoding="utf-8")
            route.fulfill(body=text, content_type="text/javascript")
        else:
            route.fulfill(body=HTML, content_type="text/html")

    page.route("**/*", answer)
    page.goto(ADDRESS)
    page.evaluate(OPEN)
    yield page
    context.close()


def surfaces(read):
    """Aileron, elevator, rudder."""
    return [read[name] for name in ("aileron", "elevator", "rudder")]


def gamepad(axes, pressed=()):
    """A gamepad as the browser has it."""
    buttons = [{"pressed": k in pressed, "value": float(k in pressed)} for k in range(12)]
    return {"connected": True, "axes": list(axes), "buttons": buttons, "mapping": "standard"}


def test_shape_by_hand():
    """Dead band 0.1 and expo 0.5 at 0.55: x = 0.45 / 0.9 = 1/2, so 1/4 + 1/16; the ends stay."""
    assert shape(0.55, 0.1, 0.5) == pytest.approx(0.3125, abs=1e-15)
    assert shape(-0.55, 0.1, 0.5, reverse=True) == pytest.approx(0.3125, abs=1e-15)
    assert [shape(x, 0.1, 0.5) for x in (0.1, -0.05, 1.0, -1.0, 3.0)] == [0, 0, 1, -1, 1]
    assert shape(0.3) == 0.3


def test_a_tap_by_hand():
    """0.2 s at 2/s is 0.4; back at 4/s it is half way after 50 ms; the throttle keeps its 0.1."""
    sticks = {"throttle": 0.5, "aileron": 0.0, "elevator": 0.0, "rudder": 0.0}
    for _ in range(10):
        sticks = key_step(sticks, {"aileron": -1, "throttle": 1}, 0.02)
    assert sticks["aileron"] == pytest.approx(-0.4) and sticks["throttle"] == pytest.approx(0.6)
    sticks = key_step(sticks, {}, 0.05)
    assert sticks["aileron"] == pytest.approx(-0.2) and sticks["throttle"] == pytest.approx(0.6)
    # The other key: through the centre without a jump.
    assert key_step(sticks, {"aileron": 1}, 0.1)["aileron"] == 0.0
    assert key_step(sticks, {"aileron": -1}, 60.0)["aileron"] == pytest.approx(-0.4)  # it slept


def test_the_page_and_its_python_copy_agree_number_by_number(page):
    """300 random steps of keys, and 300 shapes."""
    rng = np.random.default_rng(2)
    sticks = {"throttle": 0.3, "aileron": 0.0, "elevator": 0.0, "rudder": 0.0}
    steps = [
        ({name: int(rng.integers(-1, 2)) for name in sticks}, float(rng.uniform(0.0, 0.12)))
        for _ in range(300)
    ]
    ours, now = [], sticks
    for keys, dt in steps:
        now = key_step(now, keys, dt)
        ours.append(now)
    theirs = page.evaluate(
        "([sticks, steps]) => steps.map(([keys, dt]) => (sticks = kit.keyStep(sticks, keys, dt)))",
        [sticks, [[keys, dt] for keys, dt in steps]],
    )
    for mine, its in zip(ours, theirs, strict=True):
        assert its == pytest.approx(mine, abs=1e-14)
    drawn = [
        (float(x), float(d), float(e), bool(r))
        for x, d, e, r in zip(
            rng.uniform(-1.3, 1.3, 300), rng.uniform(0.0, 0.5, 300), rng.uniform(0.0, 1.0, 300),
            rng.integers(0, 2, 300), strict=True,
        )
    ]  # fmt: skip
    found = page.evaluate(
        """all => all.map(([x, deadBand, expo, reversed]) =>
            kit.shape(x, {deadBand, expo, reversed}))""",
        [list(each) for each in drawn],
    )
    assert found == pytest.approx([shape(*each) for each in drawn], abs=1e-14)
    assert page.evaluate("[NaN, Infinity, undefined].map(x => kit.shape(x, {}))") == [0, 0, 0]


def test_keys_move_the_sticks(page):
    """Right, up (stick forward: nose down) and W for 0.1 s: 0.2, -0.2 and 0.05; let go, back."""
    assert page.evaluate(READ, 0)["source"] == "none"
    for key in ("Space", "ArrowRight", "ArrowUp", "w"):
        page.keyboard.down(key)
    read = page.evaluate(READ, 100)
    assert surfaces(read) == pytest.approx([0.2, -0.2, 0.0])
    assert read["throttle"] == pytest.approx(0.55)
    assert (read["hold"], read["source"]) == (True, "keyboard")
    for key in ("Space", "ArrowRight", "ArrowUp", "w"):
        page.keyboard.up(key)
    read = page.evaluate(READ, 125)
    assert surfaces(read) == pytest.approx([0.1, -0.1, 0.0]) and read["hold"] is False
    read = page.evaluate(READ, 200)
    assert surfaces(read) == [0.0, 0.0, 0.0] and read["throttle"] == pytest.approx(0.55)


def test_what_is_typed_into_a_field_is_no_key(page):
    """Somebody writes a name with a, d, s and w in it."""
    page.evaluate(READ, 0)
    page.focus("#text")
    page.keyboard.down("d")
    assert surfaces(page.evaluate(READ, 100)) == [0.0, 0.0, 0.0]


def test_a_page_that_loses_the_focus_lets_go(page):
    """No key-up comes then; without this the phone would fly on with the stick held."""
    page.evaluate(READ, 0)
    page.keyboard.down("Space")
    page.keyboard.down("ArrowLeft")
    assert page.evaluate(READ, 100)["hold"]
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    assert page.evaluate(READ, 100 + 1000 * SILENCE_S)["hold"] is False
    assert surfaces(page.evaluate(READ, 500)) == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("mode", "throttle", "aileron", "elevator", "rudder"),
    [
        (1, 0.90, 0.3, 0.2, 0.1),
        (2, 0.40, 0.3, -0.8, 0.1),
        (3, 0.90, 0.1, 0.2, 0.3),
        (4, 0.40, 0.1, -0.8, 0.3),
    ],
)
def test_modes_of_a_gamepad(page, mode, throttle, aileron, elevator, rudder):
    """Left stick 0.1 right and 0.2 back, right stick 0.3 right and 0.8 forward: by mode 1 to 4,
    back is nose up; a throttle of half way is 0.5 with the assist.
    """
    settings = {"mode": mode, "deadBand": 0, "expo": 0, "assist": True}
    axes, buttons = [0.1, 0.2, 0.3, -0.8], [{"pressed": k == 5, "value": 0} for k in range(8)]
    found = page.evaluate("all => kit.gamepadSticks(...all)", [axes, buttons, settings])
    assert found.pop("hold") is True
    assert found == pytest.approx(
        {"throttle": throttle, "aileron": aileron, "elevator": elevator, "rudder": rudder}
    )


def test_a_gamepad_takes_the_sticks_when_it_moves_and_is_missed_when_it_goes(page):
    """It lies there with its sticks centred while somebody flies by keys."""
    page.evaluate("sticks.settings = {deadBand: 0, expo: 0, assist: false, throttleHalf: 0.2}")
    page.evaluate(PADS, [None, gamepad([0.0, 0.02, 0.0, 0.0])])
    page.keyboard.down("ArrowRight")
    page.evaluate(READ, 0)
    assert page.evaluate(READ, 100)["source"] == "keyboard"
    page.evaluate(PADS, [None, gamepad([0.0, 0.0, -0.5, 0.25], pressed=(4,))])
    read = page.evaluate(READ, 120)
    assert (read["source"], read["hold"]) == ("gamepad", True)
    assert surfaces(read) == [-0.5, 0.25, 0.0] and read["throttle"] == pytest.approx(0.2)
    page.evaluate(PADS, [None, gamepad([float("inf"), 0.0, -0.5, 0.25])])
    assert math.isfinite(page.evaluate(READ, 140)["rudder"])
    page.evaluate(PADS, [None, None])
    assert page.evaluate(READ, 160)["hold"] is False


def test_the_axis_that_moved_is_found(page):
    """For a transmitter on USB whose axes are in another order."""
    moved = "([a, b]) => kit.movedAxis(a, b)"
    assert page.evaluate(moved, [[0, 0, 0.1, 0], [0.1, -0.1, -0.9, 0.4]]) == {
        "index": 2,
        "sign": -1,
    }
    assert page.evaluate(moved, [[0, 0], [0.3, -0.3]]) is None


POINTER = """([side, type, id, right, up]) => {
  const pad = document.querySelector(`[data-side=${side}]`);
  const {left, top, width} = pad.getBoundingClientRect();
  const place = {clientX: left + width / 2 * (1 + right), clientY: top + width / 2 * (1 - up)};
  const how = {pointerId: id, bubbles: true, cancelable: true, pointerType: "touch", ...place};
  pad.dispatchEvent(new PointerEvent(type, how));
}"""


def test_two_thumbs_fly_and_the_throttle_stays(page):
    """Mode 2: the left thumb goes half a radius up, a quarter of the throttle's travel; the right
    one 0.5 right and 0.25 back. A thumb that is lifted leaves neutral, the throttle stays.
    """
    page.evaluate("sticks.settings = {mode: 2, deadBand: 0, expo: 0}")
    page.evaluate("sticks.drawTouch()")
    page.evaluate("sticks.match(0.4)")
    for side, number in (("left", 7), ("right", 8)):
        page.evaluate(POINTER, [side, "pointerdown", number, 0.2, 0.1])
    assert page.evaluate(READ, 20) == {
        "throttle": 0.4, "aileron": 0, "elevator": 0, "rudder": 0, "hold": True, "source": "touch",
    }  # fmt: skip
    page.evaluate(POINTER, ["left", "pointermove", 7, 0.2, 0.6])
    page.evaluate(POINTER, ["right", "pointermove", 8, 0.7, -0.15])
    page.evaluate(POINTER, ["right", "pointermove", 9, -1.0, 1.0])  # a third finger is nothing
    read = page.evaluate(READ, 40)
    assert surfaces(read) == pytest.approx([0.5, 0.25, 0.0], abs=1e-6)
    assert read["throttle"] == pytest.approx(0.65, abs=1e-6) and read["hold"]
    page.evaluate(POINTER, ["right", "pointercancel", 8, 0.7, -0.15])
    assert surfaces(page.evaluate(READ, 60)) == [0.0, 0.0, 0.0]
    assert page.evaluate(READ, 60)["hold"]
    page.evaluate(POINTER, ["left", "pointerup", 7, 0.2, 0.6])
    read = page.evaluate(READ, 80)
    assert read["hold"] is False and read["throttle"] == pytest.approx(0.65, abs=1e-6)


def test_settings_are_kept_and_bad_ones_are_not_taken(page):
    """In the browser, over a reload; a damaged store counts as none."""
    page.evaluate("""sticks.settings = {
        mode: 1, expo: 0.6, deadBand: 9, assist: false, reversed: {elevator: true, x: true}}""")
    page.evaluate("sticks.settings = {mode: 7, expo: NaN, assist: 'yes', axes: [1, 2], mode2: 1}")
    page.reload()
    page.evaluate(OPEN)
    kept = page.evaluate("sticks.settings")
    assert (kept["mode"], kept["expo"], kept["deadBand"], kept["assist"]) == (1, 0.6, 0.5, False)
    reversed_names = [name for name, on in kept["reversed"].items() if on]
    assert reversed_names == ["elevator"] and kept["axes"] == [0, 1, 2, 3]
    page.keyboard.down("ArrowUp")
    page.evaluate(READ, 0)
    assert page.evaluate(READ, 100)["elevator"] == pytest.approx(0.2)  # reversed: nose up
    page.evaluate("localStorage.setItem('falconwing.sticks', '{broken')")
    page.reload()
    page.evaluate(OPEN)
    assert page.evaluate("sticks.settings.mode") == 2
    assert page.evaluate("new kit.Sticks(null, {mode: 3, storage: null}).settings.mode") == 3
