"""Frame monitor: speed, and how well either rule tells noise from motion, as curves over the
signal-to-noise ratio.

    python -m pytest -m benchmark tests/benchmarks/bench_monitor.py -s
    python -m tests.benchmarks.bench_monitor --out DIR
    python -m tests.benchmarks.bench_monitor --out DIR --tuning
    python -m tests.benchmarks.bench_monitor --out DIR --recorded FLIGHT ...

The first prints the speed. The second draws the curves on the flights that judge, with `--tuning`
on those for choosing settings, with `--recorded` also on folders of recorded pictures.

Flights and noise are simulated. Times are of this process.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import require_file
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.tools.devices.cameras import FakeCamera
from falconwing_kit.vision import FrameMonitor, load_monitor_settings, ssim
from falconwing_kit.vision.monitor import RULES
from tests.benchmarks.bench_rollouts import machine
from tests.vision.flights import PERIOD, TASKS, flown

SNRS_DB = (10.0, 13.0, 16.0, 17.0, 18.0, 19.0, 20.0, 21.0, 23.0, 26.0, 32.0)
NOISY = 71  # pictures of each flight that are sent over the link: ten times 300 ms
SOON = 7  # verdicts in the 300 ms after an onset, both ends counted
USABLE_DB = (26.0, 32.0)  # what an alert should let pass, beside clean video
STRETCH = 60  # pictures: alerts on clean video are counted in stretches of three seconds
COUNTS = {"motion": (5, 8), "paper": (5, 5)}  # so many bad ones among so many


@pytest.mark.benchmark
def test_monitor_takes_at_most_20_ms(capsys):
    """640 x 480, one core: the kit's rule, the paper's, SSIM here and in scikit-image, and the
    analog link.
    """
    import cv2
    from skimage.metrics import structural_similarity

    cv2.setNumThreads(1)
    pictures = [FakeCamera(size=(640, 480)).picture(k) for k in range(30)]
    grey = [picture[..., 1].copy() for picture in pictures]
    monitors = {rule: FrameMonitor(rule) for rule in RULES}
    link = AnalogVideo(20.0)
    jobs = {rule: lambda k, m=m: m.update(pictures[k], PERIOD * k) for rule, m in monitors.items()}
    jobs["ssim"] = lambda k: ssim(grey[k - 1], grey[k])
    jobs["scikit-image"] = lambda k: structural_similarity(
        grey[k - 1],
        grey[k],
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=255,
    )
    jobs["analog link"] = lambda k: link.apply(pictures[k], k)
    took = {name: milliseconds(job, len(pictures)) for name, job in jobs.items()}
    with capsys.disabled():
        print(f"\n\n{machine()}\n\n| 640 x 480 | ms of CPU, median | 95 % |\n|---|---|---|")
        print(
            "\n".join(
                f"| {name} | {median:.1f} | {high:.1f} |" for name, (median, high) in took.items()
            )
        )
        print(f"\nscikit-image / ssim: {took['scikit-image'][0] / took['ssim'][0]:.1f}")
    assert max(took["motion"][1], took["paper"][0]) <= 20.0


def milliseconds(job, repeats: int) -> tuple[float, float]:
    """Median and 95th percentile of a job's CPU time [ms]; the first two calls warm up."""
    took = []
    for k in range(repeats):
        begin = time.process_time()
        job(k)
        took.append(1e3 * (time.process_time() - begin))
    median, high = np.percentile(took[2:], (50.0, 95.0))
    return float(median), float(high)


@dataclass(frozen=True)
class Levels:
    """How bad each piece of video is for a rule, in shares of its shipped threshold: it alerts
    above one.
    """

    clean: dict[str, np.ndarray]  # rule -> (stretches,)
    noisy: dict[
        str, dict[float, np.ndarray]
    ]  # rule -> SNR [dB] -> (onsets,): of an alert within 300 ms
    flights: dict[
        str, dict[float, np.ndarray]
    ]  # rule -> SNR [dB] -> (flights,): of an alert at any time

    def detected(self, rule: str, snr_db: float, limit: float = 1.0) -> float:
        """Share of onsets that alert within 300 ms."""
        return float((self.noisy[rule][snr_db] > limit).mean())

    def false_alarms(self, rule: str, limit: float = 1.0, usable: bool = False) -> float:
        """Share of clean stretches of about three seconds with an alert; also of those over a
        usable link, if asked.
        """
        levels = [
            self.clean[rule],
            *(self.flights[rule][snr] for snr in (USABLE_DB if usable else ())),
        ]
        return float((np.concatenate(levels) > limit).mean())


def level(scores: np.ndarray, rule: str) -> float:
    """How bad a piece is: highest over a rule's windows of the fifth highest score in them."""
    frames, window = COUNTS[rule]
    windows = np.lib.stride_tricks.sliding_window_view(scores, min(window, len(scores)))
    return float(np.sort(windows, axis=1)[:, -frames].max())


def scores(pictures: list[np.ndarray], rule: str) -> np.ndarray:
    """(N - 1,) each picture's lack of likeness or its noise, whichever is the larger share of its
    threshold.
    """
    monitor, settings = FrameMonitor(rule), load_monitor_settings()
    verdicts = [monitor.update(picture, PERIOD * k) for k, picture in enumerate(pictures)][1:]
    lack = (1.0 - np.array([verdict.ssim for verdict in verdicts])) / (1.0 - thresholds()[rule])
    return np.fmax(lack, np.array([verdict.noise for verdict in verdicts]) / settings.noise_levels)


def pieces(values: np.ndarray, length: int) -> list[np.ndarray]:
    """Stretches of a length; what is left over is left out."""
    starts = range(0, max(len(values) - length + 1, 1), length)
    return [values[start : start + length] for start in starts]


def measure(judging: bool, size: tuple[int, int]) -> Levels:
    """Fly, send the pictures over links of all qualities, and find the levels of both rules."""
    flights = [flown(number, judging, size) for number in range(len(TASKS))]
    clean = {
        rule: [level(s, rule) for f in flights for s in pieces(scores(f, rule), STRETCH)]
        for rule in RULES
    }
    noisy: dict[str, dict[float, list[float]]] = {
        rule: {snr: [] for snr in SNRS_DB} for rule in RULES
    }
    whole: dict[str, dict[float, list[float]]] = {
        rule: {snr: [] for snr in SNRS_DB} for rule in RULES
    }
    for snr_db in SNRS_DB:
        for number, flight in enumerate(flights):
            link = AnalogVideo(snr_db, seed=number)
            pictures = [link.apply(picture, k) for k, picture in enumerate(flight[:NOISY])]
            for rule in RULES:
                values = scores(pictures, rule)
                noisy[rule][snr_db] += [
                    float(np.sort(s)[-COUNTS[rule][0]]) for s in pieces(values, SOON)
                ]
                whole[rule][snr_db].append(level(values, rule))
    arrays = [
        {rule: {snr: np.array(v) for snr, v in of.items()} for rule, of in part.items()}
        for part in (noisy, whole)
    ]
    return Levels({rule: np.array(values) for rule, values in clean.items()}, *arrays)


def table(levels: Levels) -> str:
    """Markdown: at each quality how many onsets alert within 300 ms, by either rule as it ships."""
    lines = [
        "| SNR [dB] | rule | alert within 300 ms | flights with an alert | worst flight "
        "| mildest onset |",
        "|---" * 6 + "|",
    ]
    for rule in RULES:
        alarms, worst = levels.false_alarms(rule), levels.clean[rule].max()
        lines.append(
            f"| clean | {rule} | | {100 * alarms:.0f} % of 3 s stretches | {worst:.2f} | |"
        )
        for snr_db in SNRS_DB:
            share, flights = 100 * levels.detected(rule, snr_db), levels.flights[rule][snr_db]
            columns = f"{share:.0f} % | {100 * (flights > 1.0).mean():.0f} % | {flights.max():.2f}"
            lines.append(
                f"| {snr_db:g} | {rule} | {columns} | {levels.noisy[rule][snr_db].min():.2f} |"
            )
    return "\n".join(
        [*lines, "", "Worst and mildest in shares of the threshold: a rule alerts above one."]
    )


def thresholds() -> dict[str, float]:
    """What ships."""
    settings = load_monitor_settings()
    return {"motion": settings.threshold, "paper": settings.paper.threshold}


def draw(levels: Levels, path: Path) -> None:
    """Detection over SNR with the shipped thresholds; and detection against false alarms over all
    thresholds.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (rule, threshold), colour in zip(
        thresholds().items(), ("tab:blue", "tab:red"), strict=True
    ):
        share = [100 * levels.detected(rule, snr) for snr in SNRS_DB]
        alarms = 100 * levels.false_alarms(rule)
        left.plot(SNRS_DB, share, "o-", color=colour, label=f"{rule}: SSIM < {threshold:g}")
        left.axhline(
            alarms,
            color=colour,
            linestyle=":",
            label=f"{rule}: false alarms on clean video, {alarms:.0f} %",
        )
    left.set(xlabel="signal-to-noise ratio [dB]", ylabel="alert within 300 ms [% of onsets]")
    steps = np.linspace(0.0, 6.0, 1201)
    for snr_db, shade in zip((16.0, 18.0, 20.0, 23.0), (1.0, 0.75, 0.5, 0.3), strict=True):
        for rule, colour in zip(RULES, ("tab:blue", "tab:red"), strict=True):
            alarms = [100 * levels.false_alarms(rule, step, usable=True) for step in steps]
            found = [100 * levels.detected(rule, snr_db, step) for step in steps]
            right.plot(alarms, found, color=colour, alpha=shade, label=f"{rule}, {snr_db:g} dB")
    right.set(
        xlabel="good stretches of 3 s with an alert (clean, 26 and 32 dB) [%]",
        ylabel="alert within 300 ms [% of onsets]",
    )
    for axes in (left, right):
        axes.legend(fontsize=8, loc="center left" if axes is left else "lower right")
        axes.grid(alpha=0.3)
    figure.suptitle(
        "Frame monitor on simulated flights and a simulated analog link: "
        "all thresholds on the right"
    )
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=120)


def recorded(folder: Path) -> str:
    """A line for each rule: how much of a recorded flight (JPEGs at 20 Hz) is under alert."""
    import cv2

    pictures = [
        cv2.cvtColor(cv2.imread(str(p)), cv2.COLOR_BGR2RGB) for p in sorted(folder.glob("*.jpg"))
    ]
    require_file(folder / "00000.jpg")
    lines = []
    for rule, threshold in thresholds().items():
        monitor = FrameMonitor(rule)
        verdicts = [monitor.update(picture, PERIOD * k) for k, picture in enumerate(pictures)]
        alerts = [verdict.alert for verdict in verdicts]
        begun = sum(
            now and not before for before, now in zip([False, *alerts], alerts, strict=False)
        )
        low = sum(verdict.ssim < threshold for verdict in verdicts)
        lines.append(
            f"{short_name(folder)}, {rule}: {100 * np.mean(alerts):.0f} % of {len(alerts)} "
            f"pictures under alert, {begun} alerts, {low} pictures below {threshold:g}"
        )
    return "\n".join(lines)


def main() -> None:
    """Fly, print the table, draw the curves."""
    parser = argparse.ArgumentParser(description="Frame monitor: detection against false alarms")
    parser.add_argument("--out", type=Path, required=True, help="folder for monitor.png")
    parser.add_argument(
        "--tuning", action="store_true", help="flights for choosing settings, not those that judge"
    )
    parser.add_argument("--size", default="320x240", help="of the pictures [px]")
    parser.add_argument(
        "--recorded", type=Path, nargs="*", default=[], help="folders of recorded pictures"
    )
    asked = parser.parse_args()
    width, height = map(int, asked.size.split("x"))
    asked.out.mkdir(parents=True, exist_ok=True)
    levels = measure(not asked.tuning, (width, height))
    print(table(levels))
    draw(levels, asked.out / "monitor.png")
    print(
        "\n".join(
            ["", *map(recorded, asked.recorded), f"figure: {short_name(asked.out / 'monitor.png')}"]
        )
    )


if __name__ == "__main__":
    main()
