"""Set-up: megabytes that pip fetches for demo, labs and tests, and the wheel's long verbs outside a
checkout.

    python -m pytest -m benchmark -s tests/benchmarks/bench_install.py

The first needs a network or a local index: pip resolves into an empty environment and installs
nothing. The second takes minutes.
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from pathlib import Path

import pytest

from falconwing_kit.data import data_path
from tests.stories.test_wheel import built_wheel, installed_programs, outside

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]
ROOT = Path(__file__).resolve().parents[2]
LIMIT_MB = 600.0  # for demo and labs


def start_module():
    """start.py as a module."""
    spec = importlib.util.spec_from_file_location("start_measured", ROOT / "start.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def size_of(address: str) -> int:
    """Bytes of a file at an address; the kit's own folder counts nothing."""
    if address.startswith("file:"):
        path = Path(urllib.request.url2pathname(urllib.parse.urlsplit(address).path))
        return path.stat().st_size if path.is_file() else 0
    with urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=60) as page:
        return int(page.headers["Content-Length"])


def test_megabytes_to_fetch(tmp_path):
    """Against what start.py says: within a tenth, and never more than the limit for the labs."""
    start = start_module()
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    python = str(tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python")
    subprocess.run([python, "-m", "pip", "install", "-q", start.NEW_PIP], check=True)
    print("\n| target | packages | MB | largest |\n|---|---|---|---|")
    for target, (said_mb, said_packages, _) in start.COSTS.items():
        report = tmp_path / "report.json"
        pip = [python, "-m", "pip", "install", "-q", "--dry-run", "--report", str(report)]
        extra = [] if target == start.KIT else start.cpu_torch()
        subprocess.run([*pip, *extra, "-c", "constraints.txt", target], cwd=ROOT, check=True)
        found = json.loads(report.read_text())["install"]
        sizes = {p["metadata"]["name"]: size_of(p["download_info"]["url"]) for p in found}
        megabytes = sum(sizes.values()) / 1e6
        largest = sorted(sizes, key=lambda name: -sizes[name])[:3]
        print(f"| {target} | {len(sizes)} | {megabytes:.0f} | {', '.join(largest)} |")
        assert abs(megabytes - said_mb) < 0.1 * said_mb
        assert abs(len(sizes) - said_packages) < 0.1 * said_packages
        assert target == start.EVERYTHING or megabytes <= LIMIT_MB


def test_wheel_runs_the_long_verbs(tmp_path):
    """Demo, gap and the firmware's tests in an empty folder, as typed: exit code 0 each."""
    programs = installed_programs(built_wheel(tmp_path), tmp_path / "venv")
    calm, flight = (str(data_path(f"case08_{name}.csv")) for name in ("calm", "flight"))
    verbs = [
        ["demo", "--headless", "--out", "demo"],
        ["gap", "--calm", calm, "--flight", flight, "--out", "gap"],
        ["firmware", "test"],
        ["labs", "release", "handed_out"],
    ]
    folder = tmp_path / "empty"
    folder.mkdir()
    environment = outside() | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    print("\n| verb | seconds |\n|---|---|")
    for words in verbs:
        begin = time.perf_counter()
        done = subprocess.run([str(programs / "falconwing"), *words], cwd=folder, env=environment)
        print(f"| {words[0]} | {time.perf_counter() - begin:.0f} |", flush=True)
        assert done.returncode == 0
    assert (folder / "demo" / "index.html").is_file() and (folder / "gap" / "report.html").is_file()
