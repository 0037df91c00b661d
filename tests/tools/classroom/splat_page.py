"""A bare page around the page's renderer, for tests and benchmarks: files by routes, no server."""

import base64
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Picture

from tests.chromium import headless_chromium

PAGE = Path(__file__).resolve().parents[3] / "falconwing_kit" / "tools" / "classroom" / "page"
FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # a machine without a GPU
ADDRESS = "http://classroom.test/"  # answered by the routes below; nothing leaves the machine
HTML = """<!doctype html><title>splats</title><body style="margin:0">
<canvas style="display:block;width:{width}px;height:{height}px"></canvas>
<script type="module">
import * as splats from "./splats.js";
import * as camera from "./camera.js";
import * as aircraft from "./aircraft.js";
Object.assign(window, {{ splats, camera, aircraft, said: [] }});
window.open_view = async (name, options) => {{
  window.view?.dispose();
  const old = document.querySelector("canvas");
  const canvas = old.cloneNode();
  old.replaceWith(canvas);
  window.view = new splats.SplatView(canvas,
    {{ keep: true, onstatus: (text) => window.said.push(text), ...options }});
  await window.view.load(name);
  return window.view.count;
}};
window.picture = async (camera, options) => {{
  await window.view.drawSorted(camera, options);
  return window.view.canvas.toDataURL();
}};
window.started = true;
</script>"""


class SplatPage:
    """The page in a browser: loads scenes by name and returns pictures as arrays."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def open_view(self, name: str, **options: Any) -> int:
        """A new view of a scene; the number of Gaussians."""
        return int(self.page.evaluate("([n, o]) => open_view(n, o)", [name, options]))

    def picture(self, T_world_camera: Any, fov_deg: float) -> np.ndarray:
        """(H, W, 3) 0..1 of the canvas, sorted for this very camera."""
        pose = np.asarray(T_world_camera, np.float64).ravel().tolist()
        return self.read(self.page.evaluate("([T, f]) => picture(T, {fovDeg: f})", [pose, fov_deg]))

    @staticmethod
    def read(url: str) -> np.ndarray:
        """(H, W, 3) 0..1 of a PNG as a data address."""
        image = Picture.open(io.BytesIO(base64.b64decode(url.split(",")[1])))
        return np.asarray(image.convert("RGB"), np.float64) / 255.0


@contextmanager
def splat_page(
    scenes: Mapping[str, bytes], width: int, height: int, **page_options: Any
) -> Iterator[SplatPage]:
    """The page with these files as scenes; an error of its scripts fails the test."""
    with headless_chromium(FLAGS) as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700}, **page_options)
        page.set_default_timeout(120_000)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)

        def answer(route: Any) -> None:
            name = route.request.url.removeprefix(ADDRESS)
            if name in scenes:
                route.fulfill(body=scenes[name], content_type="application/octet-stream")
            elif name == "":
                route.fulfill(
                    body=HTML.format(width=width, height=height), content_type="text/html"
                )
            elif (PAGE / name).is_file():
                route.fulfill(
                    body=(PAGE / name).read_bytes(), content_type="text/javascript; charset=utf-8"
                )
            else:
                route.fulfill(status=404)

        page.route("**/*", answer)
        page.goto(ADDRESS)
        page.wait_for_function("window.started")
        yield SplatPage(page)
        assert [line for line in errors if "Failed to load resource" not in line] == []
