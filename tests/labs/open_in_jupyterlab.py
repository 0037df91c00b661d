"""Open a student's notebook in JupyterLab in headless Chromium, run it and take a screenshot.

    python -m tests.labs.open_in_jupyterlab lab01 --out pictures [--solution]

The lab is released into a folder of its own first, as students get it. Needs Debian's `chromium`
and Playwright.
"""

import argparse
import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from falconwing_kit.tools.grading.find import lab_folder, notebook_path
from falconwing_kit.tools.grading.release import release

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 180.0  # for a server, a page or a notebook on a busy machine


@contextmanager
def jupyterlab(folder: Path) -> Iterator[str]:
    """A JupyterLab server in a folder.

    Gives its address without path, such as http://127.0.0.1:8890, and its token.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = secrets.token_hex(16)
    home = folder.parent / "jupyter_home"
    quiet = (
        home
        / "settings"
        / "@jupyterlab"
        / "apputils-extension"
        / "notification.jupyterlab-settings"
    )
    quiet.parent.mkdir(parents=True)
    quiet.write_text('{"fetchNews": "false", "checkForUpdates": false}')
    words = ["--no-browser", "--ip=127.0.0.1", f"--port={port}", "--ServerApp.port_retries=0"]
    words += ["--allow-root"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    own = {
        "JUPYTER_TOKEN": token,
        "JUPYTER_CONFIG_DIR": str(home),
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    }
    own["JUPYTERLAB_SETTINGS_DIR"] = str(home / "settings")
    server = subprocess.Popen(
        [sys.executable, "-m", "jupyterlab", *words],
        cwd=folder, env=os.environ | own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    address = f"http://127.0.0.1:{port}"
    try:
        wait_until(lambda: answers(f"{address}/api?token={token}"), "JupyterLab's server")
        yield f"{address}?token={token}"
    finally:
        server.terminate()
        server.wait(30)


def answers(url: str) -> bool:
    """Whether a server answers there."""
    try:
        with urllib.request.urlopen(url, timeout=5) as reply:
            return reply.status == 200
    except OSError:
        return False


def wait_until(happened, what: str) -> None:
    """Look again every half second; TimeoutError after WAIT_S."""
    end = time.monotonic() + WAIT_S
    while not happened():
        if time.monotonic() > end:
            raise TimeoutError(f"{what}: waited {WAIT_S:.0f} s")
        time.sleep(0.5)


def open_and_run(address: str, notebook: str, picture: Path) -> dict[str, object]:
    """Open a notebook in the browser, run all its cells, save it, take a picture of all of it.

    Args:
        address: of the server, with its token.
        notebook: path below the server's folder.
        picture: the PNG file to write.

    Returns:
        `cells` with a count, `errors` by name, `pictures` drawn, and what the page `complained` of.
    """
    from playwright.sync_api import sync_playwright

    host, token = address.split("?")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    flags = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1e3 * WAIT_S)
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(f"{host}/lab/tree/{notebook}?{token}")
        page.wait_for_selector(".jp-Notebook .jp-CodeCell")
        page.wait_for_selector("text=| Idle")
        page.click("text=Run >> nth=0")
        page.click("text=Run All Cells")
        saved = f"{host}/api/contents/{notebook}?{token}"
        wait_until(lambda: run_to_the_end(page, saved), "the notebook's last cell")
        height = page.evaluate("document.querySelector('.jp-WindowedPanel-outer').scrollHeight")
        page.set_viewport_size({"width": 1280, "height": min(int(height) + 200, 16000)})
        page.evaluate("document.querySelector('.jp-WindowedPanel-outer').scrollTop = 0")
        page.wait_for_timeout(3000)
        page.screenshot(path=str(picture))
        browser.close()
    with urllib.request.urlopen(saved, timeout=30) as reply:
        cells = json.load(reply)["content"]["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    return {
        "cells": len(cells),
        "errors": sorted(output["ename"] for output in outputs if output["output_type"] == "error"),
        "pictures": sum("image/png" in output.get("data", {}) for output in outputs),
        "complained": complaints,
    }


def run_to_the_end(page, saved: str) -> bool:
    """Whether the kernel has nothing left to do; the notebook is saved then."""
    busy = page.evaluate(
        "[...document.querySelectorAll('.jp-InputPrompt')].some(prompt => "
        "prompt.innerText.includes('[*]'))"
    )
    idle = page.query_selector("text=| Idle") is not None
    if busy or not idle:
        return False
    page.keyboard.press("Control+s")
    page.wait_for_timeout(1000)
    return answers(saved)


def main() -> int:
    """Release, open, run, take the picture.

    0 where only NotImplementedError was raised and nobody complained.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lab")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--solution", action="store_true")
    asked = parser.parse_args()
    folder = lab_folder(asked.lab, ROOT / "labs")
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        handed_out = Path(place) / "labs"
        release([folder], handed_out)
        notebook = notebook_path(handed_out / folder.name, solution=asked.solution)
        if asked.solution:
            notebook.parent.mkdir()
            shutil.copyfile(notebook_path(folder, solution=True), notebook)
        name = f"{notebook.stem}{'_solution' if asked.solution else ''}"
        with jupyterlab(handed_out) as address:
            seen = open_and_run(
                address, notebook.relative_to(handed_out).as_posix(), asked.out / f"{name}.png"
            )
    print(json.dumps(seen, indent=2))
    allowed = set() if asked.solution else {"NotImplementedError"}
    return int(not set(seen["errors"]) <= allowed or bool(seen["complained"]))


if __name__ == "__main__":
    sys.exit(main())
