"""Figures and table of simulated trials: records -> PNG of paths and results, CSV and summary."""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, figure

PAD = "#9fc5e8"
LONG = ("path_m", "leader_path_m", "art_ms")  # keys of a record that hold many numbers
Records = Sequence[Mapping[str, Any]]


def write_results(
    records: Records, summary: Mapping[str, Any], folder: Path, what: str
) -> dict[str, Path]:
    """Write the results of a study into an existing folder.

    Args:
        records: of `trials.fly_trials`.
        summary: of `trials.summarise_trials`.
        folder: for paths.png, results.png, trials.csv and summary.json.
        what: task and pilot, for the titles.

    Returns:
        The files as paths, results, table and summary.
    """
    files = {
        "paths": folder / "paths.png",
        "results": folder / "results.png",
        "table": folder / "trials.csv",
        "summary": folder / "summary.json",
    }
    draw_paths(records, files["paths"], what)
    draw_results(records, files["results"], what)
    write_table(records, files["table"])
    with atomic_write(files["summary"], text=True) as file:
        json.dump(replace_nonfinite(summary), file, indent=2)
    return files


def draw_paths(records: Records, path: Path, what: str) -> None:
    """Draw all paths from above and from the side into a PNG."""
    hall, pad = Hall(), LandingPad()
    leaders = [record["leader_path_m"] for record in records if "leader_path_m" in record]
    landing = not leaders
    succeeded = [record.get("path_m", []) for record in records if record["success"]]
    failed = [record.get("path_m", []) for record in records if not record["success"]]
    kinds = (
        ("leader", MEASURED, "-", leaders),
        ("success", PREDICTED, "-", succeeded),
        ("failure", ACCENT, "--", failed),
    )
    with figure(path, 2, 1, (8.0, 6.0)) as ((above,), (side,)):
        if landing:
            x, low = [pad.x_start, pad.x_start + pad.length], pad.y_centre - 0.5 * pad.width
            above.fill_between(x, low, low + pad.width, color=PAD, label="pad")
            side.fill_between(x, 0.0, pad.height, color=PAD)
        for label, colour, line, paths in kinds:
            for k, p_world in enumerate(np.array(points).reshape(-1, 3) for points in paths):
                look: Any = {"color": colour, "linestyle": line, "linewidth": 0.9, "alpha": 0.7}
                above.plot(p_world[:, 0], p_world[:, 1], label=label if k == 0 else None, **look)
                side.plot(p_world[:, 0], p_world[:, 2], **look)
        above.set(
            title=f"SIMULATED: {_caption(what, records)}",
            xlabel="from above: x [m]",
            ylabel="y [m]",
        )
        side.set(xlabel="from the side, height stretched: x [m]", ylabel="height [m]")
        above.set(xlim=hall.x, ylim=hall.y, aspect="equal")
        side.set(xlim=hall.x, ylim=(0.0, 2.5 if landing else hall.height))
        above.legend(loc="upper right", ncols=3)


def draw_results(records: Records, path: Path, what: str) -> None:
    """Draw histograms of the touchdown points or of the tracking errors into a PNG."""
    pad, follow = LandingPad(), any("leader_path_m" in record for record in records)
    if follow:
        panels = {  # label, range that is always shown, bin width
            "ate_m": ("ATE until the lock was lost [m]", (0.0, 1.0), 0.05),
            "ate_d_m": ("ATE_d, of the distance alone [m]", (0.0, 1.0), 0.05),
        }
    else:
        half = 0.5 * pad.width
        panels = {
            "lateral_offset_m": (
                "left of the pad's centre line at touchdown [m]", (-half, half), 0.05
            ),
            "past_threshold_m": (
                "past the pad's threshold at touchdown [m]", (0.0, pad.length), 0.5
            ),
        }  # fmt: skip
    with figure(path, 2, 1, (8.0, 5.0)) as axes:
        for (ax,), (key, (label, shown, width)) in zip(axes, panels.items(), strict=True):
            split = [
                [r[key] for r in records if r["success"] is success and r.get(key) is not None]
                for success in (True, False)
            ]
            low, high = min([shown[0], *split[0], *split[1]]), max([shown[1], *split[0], *split[1]])
            bins = np.arange(math.floor(low / width), math.ceil(high / width) + 1) * width
            colours, labels = [PREDICTED, ACCENT], ["success", "failure"]
            ax.hist(split, bins=bins, stacked=True, color=colours, label=labels)
            ax.set(xlabel=label, ylabel="trials")
        axes[0, 0].set_title(f"SIMULATED: {_caption(what, records)}")
        axes[0, 0].legend()


def write_table(records: Records, path: Path) -> None:
    """Write a CSV with one row per trial, without paths and the run times of single steps."""
    keys = dict.fromkeys(key for record in records for key in record if key not in LONG)
    with atomic_write(path, text=True) as file:
        writer = csv.DictWriter(file, list(keys), extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)


def replace_nonfinite(value: Any) -> Any:
    """A nested record with None in place of nan and infinity, which JSON does not have."""
    if isinstance(value, Mapping):
        return {key: replace_nonfinite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _caption(what: str, records: Records) -> str:
    return f"{what.replace('_', ' ')}, {len(records)} flown"
