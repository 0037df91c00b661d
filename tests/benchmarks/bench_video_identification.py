"""Identification from video alone: does a model fitted to one flight's video foretell another's better than its start?

    python -m pytest -m benchmark -s tests/benchmarks/bench_video_identification.py

What it types are the kit's own verbs, `poses` on both path-traced flights of the shared data, then `identify --judge`
either way. Takes about five minutes of one core; where the flights are missing it says so.
"""

import contextlib
import io
import json
from pathlib import Path

import pytest

from falconwing_kit.cli.main import main

FLIGHTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "hall" / "flights"
pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]


@pytest.mark.skipif(not FLIGHTS.is_dir(), reason="wants the path-traced flights calm_1 and calm_2 of the shared data")
def test_a_model_from_one_video_foretells_the_other_better_than_its_start(tmp_path: Path) -> None:
    """Both ways, place and attitude; prints the figures that README and manual tell."""
    names = ("calm_1", "calm_2")
    for name in names:
        words = ["poses", str(FLIGHTS / name), "--scene", "hall", "--network", "hall"]
        assert main([*words, "--out", str(tmp_path / f"{name}.csv")]) == 0
    for fitted, other in (names, names[::-1]):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            main(["identify", str(tmp_path / f"{fitted}.csv"), "--judge", str(tmp_path / f"{other}.csv"), "--json"])
        ahead = json.loads(printed.getvalue())["one_second_ahead"]
        print(f"\nfitted to {fitted}, one second ahead on {other}, {ahead['forecasts']} forecasts")
        for who in ("fitted", "start", "constant_turn", "constant_velocity"):
            print(f"  {who}: {ahead[who]['position_m']:.2f} m, {ahead[who]['attitude_deg']:.1f} deg")
        for key in ("position_m", "attitude_deg"):
            assert ahead["fitted"][key] < ahead["start"][key]
