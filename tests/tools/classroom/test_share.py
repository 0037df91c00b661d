"""One HTML file per flight: small, closed to the network, and drawn in a real browser from disk."""

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.classroom.results import flight_data, refly
from falconwing_kit.tools.classroom.scene_file import scene_bytes
from falconwing_kit.tools.classroom.share import (
    LARGEST_BYTES,
    PAGE,
    inline_modules,
    page_of_data,
    share_page,
)
from falconwing_kit.tools.cli.main import main
from tests.chromium import headless_chromium
from tests.tools.classroom.flights import fly_log

SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WIND = {"wind_x": 0.0, "wind_y": 1.0}
NO_WEBGL2 = """const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind === "webgl2" ? null : get.call(this, kind, ...rest);
};
OffscreenCanvas.prototype.getContext = () => null;"""


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A landing in wind from 0.5 s on, in which Mia takes the sticks after a second."""
    return fly_log(
        tmp_path_factory.mktemp("flight") / "flight.mcap",
        hands=[(0.0, "autopilot", "expert"), (1.0, "student", "Mia")],
        effects=[(0.5, "wind", True, WIND)],
    )[0]


@pytest.fixture(scope="module")
def hall():
    """The whole arena as a page loads it."""
    return scene_bytes(load_scene("arena"))


@pytest.fixture(scope="module")
def shared(flight, hall, tmp_path_factory):
    """The file of this flight with the whole arena."""
    path = tmp_path_factory.mktemp("shared") / "flight.html"
    path.write_text(share_page(flight, hall), encoding="utf-8")
    return path


def content(page: str, name: str) -> bytes:
    """What an element of the page holds, unpacked."""
    text = re.search(rf'id="{name}">(.*?)</script>', page, re.DOTALL)[1]
    return gzip.decompress(base64.b64decode(text))


def test_file_with_the_arena_is_small(shared):
    """The limit that the class's handout names: two million bytes."""
    assert 500_000 < shared.stat().st_size <= LARGEST_BYTES


def test_file_holds_flight_and_hall_as_they_are(shared, flight, hall):
    """Unpacked by Python's gzip: the player's data and the renderer's bytes."""
    page = shared.read_text()
    assert json.loads(content(page, "flight")) == json.loads(json.dumps(flight_data(flight)))
    assert content(page, "scene") == hall


def test_file_allows_its_own_script_and_no_request(shared):
    """The policy names the digests of the one script and the one style; no address but data."""
    page = shared.read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    script, style = (
        re.search(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)[1] for tag in ("script", "style")
    )
    for text in (script, style):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy and "connect-src" not in policy
    assert "unsafe" not in policy and "http" not in policy
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page)
    assert "SIMULATION" in page


def test_text_of_a_flight_is_no_markup(flight):
    """A scene or a name that is HTML stays text."""
    data = {**flight_data(flight), "scene": "<img src=x>", "title": "</script><b>"}
    page = page_of_data(data, None)
    assert "<img" not in page and "<b>" not in page


def test_modules_become_one_script(tmp_path):
    """What a module needs comes before it, once; imports and the word export are gone."""
    (tmp_path / "a.js").write_text('import { b } from "./b.js";\nexport const a = b + 1;\n')
    (tmp_path / "b.js").write_text("export function b() {}\n")
    assert inline_modules("a.js", tmp_path) == "function b() {}\n\nconst a = b + 1;\n"


@pytest.mark.parametrize(
    "text, message",
    [
        ('import { none } from "./none.js";', "none.js"),
        ('import * as b from "./b.js";', "plain imports"),
        ('import { b } from "./b.js";\nconst b = 1;', "one module with it"),
        ("const a = '</script>';", "without </script"),
        ("export default 1;", "plain imports and exports"),
    ],
)
def test_modules_that_cannot_be_inlined_are_one_sentence(tmp_path, text, message):
    """The form that the pages' modules keep to."""
    (tmp_path / "a.js").write_text(text)
    (tmp_path / "b.js").write_text("export const b = 1;\n")
    with pytest.raises(InputError, match=message):
        inline_modules("a.js", tmp_path)


def test_every_module_begins_with_what_comes_in_and_goes_out():
    """As every file of the kit."""
    for name in ("player.js", "after.js", "share.js"):
        assert (PAGE / name).read_text().startswith("// ")


def test_file_opened_from_disk_draws_the_flight(shared, flight):
    """By double click, with the network off: the hall loads, the bar, keys and ghost work, and what
    is drawn at 2 s is where the flight was then.
    """
    truth = refly(flight).states[40]  # 2 s at 20 Hz
    asked, errors = [], []
    with headless_chromium(SOFTWARE_GL) as browser:
        context = browser.new_context(viewport={"width": 640, "height": 480})
        context.set_offline(True)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url.split(":")[0]))
        page.on("console", lambda message: errors.append(message.text))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(shared.as_uri())
        page.wait_for_selector("#player[data-ready]", timeout=60_000)

        def drawn(name: str) -> str:
            return page.get_attribute("#player", f"data-{name}")

        assert drawn("camera") == "chase"
        page.locator(".fw-bar input").fill("2")
        assert drawn("t") == "2.000"
        position = [float(x) for x in drawn("position").split()]
        assert position == pytest.approx(truth[:3], abs=2e-3)  # rows are rounded to mm
        assert page.inner_text(".fw-clock").startswith("2.00 of")
        assert "Mia" in page.inner_text(".fw-who")
        assert float(drawn("ghost").split()[1]) < position[1] - 0.05  # wind to the left, +y
        page.focus(".fw-stage")
        page.keyboard.press("ArrowLeft")
        assert drawn("t") == "1.950"
        page.keyboard.press("g")
        assert drawn("ghost") == ""
        page.keyboard.press("End")
        assert float(drawn("t")) == pytest.approx(refly(flight).t[-1], abs=1e-3)
        page.keyboard.press("Home")
        page.select_option("select[aria-label='Speed of time']", "4")
        page.keyboard.press("Escape")
        page.click(".fw-play")
        for _ in range(100):  # the policy forbids the polling that Playwright would inject
            if float(drawn("t")) > 1.0:
                break
            page.wait_for_timeout(100)
        assert float(drawn("t")) > 1.0
        assert drawn("rate") == "4"
        assert "SIMULATION" in page.inner_text(".fw-stamp")
        pixels = page.evaluate(
            """() => { const c = document.querySelector('.fw-canvas');
            const flat = document.createElement('canvas'); flat.width = 64; flat.height = 36;
            const pen = flat.getContext('2d');
            return new Promise((done) => requestAnimationFrame(() => {
              pen.drawImage(c, 0, 0, 64, 36);
              done(new Set(pen.getImageData(0, 0, 64, 36).data).size); })); }"""
        )
    assert set(asked) <= {"file", "blob"}
    assert errors == []
    assert pixels > 1  # a picture, not one colour


def test_a_browser_without_webgl2_shows_the_map_and_says_so(shared):
    """The 2D canvas takes over; the same bar, the same position."""
    with headless_chromium() as browser:
        page = browser.new_page(viewport={"width": 390, "height": 844})
        page.add_init_script(NO_WEBGL2)
        page.goto(shared.as_uri())
        page.wait_for_selector("#player[data-ready]", timeout=60_000)
        page.locator(".fw-bar input").fill("1")
        assert page.get_attribute("#player", "data-camera") == "map"
        assert page.get_attribute("#player", "data-t") == "1.000"
        assert "no WebGL2" in page.inner_text(".fw-note")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_class_page_shows_a_flight_and_asks_what_is_missing(flight):
    """after.js against answers of a class: player, links, and the question over the channel."""
    data = flight_data(flight)
    answers = {
        "/flights/1.json": ("application/json", json.dumps(data)),
        "/": ("text/html", "<!DOCTYPE html><body><div id='box'></div>"),
    }

    def answer(route):
        path = route.request.url.removeprefix("http://class.test")
        kind, body = answers.get(path, ("", ""))
        name = path.removeprefix("/page/")
        if path.startswith("/page/"):
            body = (PAGE / name).read_text(encoding="utf-8")
            kind = "text/css" if name.endswith("css") else "text/javascript"
        if kind:
            route.fulfill(body=body, content_type=kind)
        else:
            route.fulfill(status=404)

    with headless_chromium() as browser:
        page = browser.new_page()
        page.add_init_script(NO_WEBGL2)
        page.route("**/*", answer)
        page.goto("http://class.test/")
        page.evaluate(
            """async () => {
            const { AfterFlight } = await import("/page/after.js");
            window.sent = []; window.heard = {};
            const channel = { on: (kind, f) => { window.heard[kind] = f; },
                              send: (message) => window.sent.push(message) };
            window.after = new AfterFlight(document.getElementById("box"), channel);
            await window.after.open(1); }"""
        )
        assert data["sentence"] in page.inner_text("#box")
        page.click("text=Name what is missing")
        assert page.evaluate("window.sent") == [{"type": "gap", "flight": 1}]
        page.evaluate(
            "window.heard.gap({flight: 1, state: 'done', sentence: 'Missing: wind.', report: {}})"
        )
        assert "Missing: wind." in page.inner_text("#box")
        links = [page.get_attribute(f"a:has-text('{text}')", "href") for text in ("Share", "Log")]
        assert links == ["/flights/1.html", "/flights/1.mcap"]
        page.evaluate("window.after.open(2)")
        page.wait_for_selector("text=Flight 2 cannot be shown (the server answered 404).")
        page.evaluate("window.after.close()")
        assert page.evaluate("document.getElementById('box').hidden")


def test_export_writes_the_page_of_any_log(flight, tmp_path, capsys):
    """The hall that the log names; a model file's name and scene on the command line."""
    out = tmp_path / "flight.html"
    assert main(["export", str(flight.log), "--to", "html", "--out", str(out)]) == 0
    assert "in a browser" in capsys.readouterr().out.splitlines()[-1]
    assert out.stat().st_size < LARGEST_BYTES
    assert json.loads(content(out.read_text(), "flight"))["scene"] == "arena"
    assert main(["export", str(flight.log), "--scene", "arena", "--out", str(out)]) == 2
    assert "--scene: expected it with --to html" in capsys.readouterr().err


def test_export_of_a_log_without_a_place_is_a_map(flight, tmp_path, capsys):
    """A log of an earlier version: the flight on a map, and a sentence."""
    record, _ = fly_log(tmp_path / "x.mcap", metadata={"scene": ""}, duration=1.0)
    out = tmp_path / "x.html"
    assert main(["export", str(record.log), "--to", "html", "--out", str(out)]) == 0
    assert "does not say where" in capsys.readouterr().out
    assert 'id="scene"></script>' in out.read_text()
    assert replace(record, scene="").scene == ""
