"""Run a lab in a browser's own Python: the site of `labs web`, in headless Chromium.

    python -m tests.labs.open_in_jupyterlite lab01 --pyodide FOLDER --out pictures [--solution]

FOLDER is an unpacked Pyodide distribution, which the kit does not ship. Needs Debian's `chromium`,
Playwright and the extra `web`. Prints what the cells printed, and every error; exit code 0 where
only NotImplementedError was raised, and with --solution nothing.
"""

import argparse
import functools
import http.server
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from falconwing_kit.tools.grading.find import lab_folder, notebook_path
from falconwing_kit.tools.grading.web import web_site
from tests.labs.open_in_jupyterlab import ROOT, wait_until

BUSY = (
    "[...document.querySelectorAll('.jp-InputPrompt')]"
    ".some(prompt => prompt.innerText.includes('[*]'))"
)
OUTPUTS = "[...document.querySelectorAll('.jp-OutputArea-output')].map(each => each.innerText)"
PICTURES = "document.querySelectorAll('.jp-OutputArea-output img').length"


@contextmanager
def served(site: Path) -> Iterator[str]:
    """Address of a server of files on this machine."""
    handler = functools.partial(_Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *words: object) -> None:
        """Nothing."""


def write_solution(lab: Path, notebook: Path) -> None:
    """Put the solution's functions into the site's notebook."""
    solved = json.loads(notebook_path(lab, solution=True).read_text(encoding="utf-8"))
    written = {c["metadata"].get("exercise"): c["source"] for c in solved["cells"]}
    text = json.loads(notebook.read_text(encoding="utf-8"))
    for cell in text["cells"]:
        if "exercise" in cell["metadata"]:
            cell["source"] = written[cell["metadata"]["exercise"]]
    notebook.write_text(json.dumps(text), encoding="utf-8")


def run_in_browser(address: str, path: str, picture: Path) -> dict[str, object]:
    """Open a notebook of the site and run all its cells, also those after a failed one.

    Returns:
        `started_s` until the kernel was idle, `ran_s` for all cells, `outputs` as text, `pictures`
        drawn, `errors` among the outputs, and what the page `complained` of.
    """
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    flags = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 1280, "height": 16000})
        page.set_default_timeout(300e3)
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        start = time.monotonic()
        page.goto(f"{address}/lab/index.html?path={path}")
        page.wait_for_selector(".jp-Notebook .jp-CodeCell")
        page.wait_for_selector("text=| Idle")
        idle = time.monotonic()
        cells = page.locator(".jp-Notebook .jp-Cell")
        for number in range(cells.count()):  # one after the other: one that fails stops no other
            cell = cells.nth(number)
            if "jp-CodeCell" in (cell.get_attribute("class") or ""):
                cell.locator(".cm-content").first.click()
                page.keyboard.press("Control+Enter")
                page.wait_for_timeout(200)
                wait_until(lambda: not page.evaluate(BUSY), f"cell {number}")
        ran = time.monotonic()
        page.wait_for_timeout(1000)
        outputs = page.evaluate(OUTPUTS)
        pictures = page.evaluate(PICTURES)
        page.screenshot(path=str(picture))
        browser.close()
    return {
        "started_s": round(idle - start, 1),
        "ran_s": round(ran - idle, 1),
        "outputs": [text for text in outputs if text.strip()],
        "pictures": pictures,
        "errors": [text.strip().splitlines()[-1] for text in outputs if "Traceback" in text],
        "complained": complaints,
    }


def main() -> int:
    """Build the site, serve it, open it, run it, take the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lab")
    parser.add_argument("--pyodide", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--solution", action="store_true")
    asked = parser.parse_args()
    folder = lab_folder(asked.lab, ROOT / "labs")
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        site = Path(place) / "site"
        web_site([folder], site, asked.pyodide)
        notebook = notebook_path(site / "files" / folder.name)
        if asked.solution:
            write_solution(folder, notebook)
        picture = asked.out / f"{notebook.stem}_browser.png"
        with served(site) as address:
            path = notebook.relative_to(site / "files").as_posix()
            seen = run_in_browser(address, path, picture)
    print(json.dumps(seen, indent=2, ensure_ascii=False))
    allowed = () if asked.solution else ("NotImplementedError",)
    bad = [each for each in seen["errors"] if not each.startswith(allowed or ("\0",))]
    return int(bool(bad or seen["complained"]))


if __name__ == "__main__":
    sys.exit(main())
