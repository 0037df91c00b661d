"""Figures and table of trials: their records -> PNG files of paths and results, a CSV and a
summary. All simulated.
"""

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
LONG = ("path_m", "leader_path_m", "art_ms")  # of a record: many numbers, no place in a table
Records = Sequence[Mapping[str, Any]]


def write_results(
    records: Records, summary: Mapping[str, Any], folder: Path, what: str
) -> dict[str, Path]:
    """Write everything that a study of trials leaves behind.

    Args:
        records: of `trials.fly_trials`.
        summary: of `trials.summary`.
        folder: where to; it must exist.
        what: task and pilot, for the titles.

    Returns:
        paths.png, results.png, trials.csv and summary.json by what they are.
    """
    files = {
        "paths": "paths.png",
        "results": "results.png",
        "table": "trials.csv",
        "summary": "summary.json",
    }
    found = {name: folder / file for name, file in files.items()}
    draw_paths(records, found["paths"], what)
    draw_results(records, found["results"], what)
    write_table(records, found["table"])
    with atomic_write(found["summary"], text=True) as file:
        json.dump(replace_nonfinite(summary), file, indent=2)
    return found


def draw_paths(records: Records, path: Path, what: str) -> None:
    """All paths from above and from the side.

    Args:
        records: with path_m, of follow tasks with leader_path_m too.
        path: the PNG to write.
        what: task and pilot, for the title.
    """
    hall, pad, landing = (
        Hall(),
        LandingPad(),
        not any("leader_path_m" in record for record in records),
    )
    with figure(path, 2, 1, (8.0, 6.0)) as ((above,), (side,)):
        if landing:
            low = pad.y_centre - 0.5 * pad.width
            above.fill_between(
                [pad.x_start, pad.x_start + pad.length],
                low,
                low + pad.width,
                color=PAD,
                label="pad",
            )
            side.fill_between([pad.x_start, pad.x_start + pad.length], 0.0, pad.height, color=PAD)
        leaders = [record["leader_path_m"] for record in records if "leader_path_m" in record]
        kinds = [("leader", MEASURED, "-", leaders)]
        for label, colour, line, success in (
            ("success", PREDICTED, "-", True),
            ("failure", ACCENT, "--", False),
        ):
            kinds.append(
                (
                    label,
                    colour,
                    line,
                    [r.get("path_m", []) for r in records if r["success"] is success],
                )
            )
        for label, colour, line, flown in kinds:
            for k, p_world in enumerate(np.array(points).reshape(-1, 3) for points in flown):
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
    """Histograms of where the wheels touched, or of the tracking errors.

    Args:
        records: of one task.
        path: the PNG to write.
        what: task and pilot, for the title.
    """
    landing = not any("leader_path_m" in record for record in records)
    pad = LandingPad()
    panels = {  # label, range that is always shown, width of a bin
        "lateral_offset_m": (
            "left of the pad's centre line at touchdown [m]",
            (-0.5 * pad.width, 0.5 * pad.width),
            0.05,
        ),
        "past_threshold_m": ("past the pad's threshold at touchdown [m]", (0.0, pad.length), 0.5),
    }
    if not landing:
        panels = {
            "ate_m": ("ATE until the lock was lost [m]", (0.0, 1.0), 0.05),
            "ate_d_m": ("ATE_d, of the distance alone [m]", (0.0, 1.0), 0.05),
        }
    with figure(path, 2, 1, (8.0, 5.0)) as axes:
        for (ax,), (key, (label, shown, width)) in zip(axes, panels.items(), strict=True):
            split = [
                [r[key] for r in records if r["success"] is good and r.get(key) is not None]
                for good in (True, False)
            ]
            low, high = min([shown[0], *split[0], *split[1]]), max([shown[1], *split[0], *split[1]])
            bins = np.arange(math.floor(low / width), math.ceil(high / width) + 1) * width
            ax.hist(
                split,
                bins=bins,
                stacked=True,
                color=[PREDICTED, ACCENT],
                label=["success", "failure"],
            )
            ax.set(xlabel=label, ylabel="trials")
        axes[0, 0].set_title(f"SIMULATED: {_caption(what, records)}")
        axes[0, 0].legend()


def write_table(records: Records, path: Path) -> None:
    """One row per trial, everything but the paths and the run time of every step.

    Args:
        records: of one task.
        path: the CSV to write.
    """
    keys = dict.fromkeys(key for record in records for key in record if key not in LONG)
    with atomic_write(path, text=True) as file:
        writer = csv.DictWriter(file, list(keys), extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)


def replace_nonfinite(value: Any) -> Any:
    """A record with None for every number that is not finite, as JSON wants it.

    Args:
        value: numbers, texts, lists and mappings.

    Returns:
        The same with None in place of nan and infinity.
    """
    if isinstance(value, Mapping):
        return {key: replace_nonfinite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _caption(what: str, records: Records) -> str:
    return f"{what.replace('_', ' ')}, {len(records)} flown"
