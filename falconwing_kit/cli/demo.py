"""falconwing demo: the kit's main job on recorded flights, as one page with its figures."""

from dataclasses import dataclass
from pathlib import Path

from falconwing_kit.cli.show import next_line, print_json, print_table


@dataclass(frozen=True)
class Demo:
    """Model two aircraft from recorded flights, one of them real, and find and name what the models lack.

    Needs no network, GPU or aircraft and takes about a minute and a half.
    """

    out: Path = Path("falconwing_demo")
    """folder for page, figures and models"""
    headless: bool = False
    """do not open the page in the browser"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Study both flights and write the page.

        Returns:
            0: the page is written.

        Raises:
            OSError: the folder cannot be made or written.
        """
        from tqdm import tqdm

        from falconwing_kit.demo.recorded import study_recorded_flights, write_recorded_flights

        self.out.mkdir(parents=True, exist_ok=True)
        with tqdm(bar_format="{desc} {elapsed}", leave=False, disable=None) as bar:
            found = study_recorded_flights(bar.set_description_str)
            bar.set_description_str("page and figures")
            record = write_recorded_flights(found, self.out)
        page = (self.out / "index.html").resolve()
        if self.json:
            print_json({**record, "page": str(page)})
        else:
            _print_record(record)
            print(f"\npage: {page}")
            next_line("falconwing identify YOUR_FLIGHT.csv --out model.toml --figures figures")
        if not self.headless:
            import webbrowser

            webbrowser.open(page.as_uri())
        return 0


def _print_record(record: dict) -> None:
    small, real = record["simulated_flight"], record["real_flight"]
    rows = [("multiple shooting", small["held_out_chi2_per_dof"])]
    rows += [(f"one step, {name} (the paper's loss)", chi2) for name, chi2 in small["one_step_chi2_per_dof"].items()]
    title = "150 g aircraft, SIMULATED by an independent simulator: two seconds ahead, held-out time"
    print_table(("fit", "chi2 per dof (1 = only noise left)"), rows, title=title)
    gap = small["gap"]
    names = " or ".join(gap["effects"]).replace("_", " ") or "nothing"
    print(f"another flight of it: {gap['verdict']}, {names} (truth: {', '.join(gap['truth']['effects'])})")
    print(
        "chi2 per dof of its held-out time: " + ", ".join(f"{value:.2f} {when}" for when, value in gap["gap"].items())
    )
    print()
    forecasts = real["one_second_ahead_before_failure"].items()
    title = "2 m aircraft, REAL flight (ALFA): one second ahead, held-out time before the engine fails"
    errors = [(name, f["position_m"], f["attitude_deg"]) for name, f in forecasts]
    print_table(("forecast", "position [m]", "attitude [deg]"), errors, title=title)
    parts, failure = real["parts_from_measurement_s"], real["failure_time_s"]
    if parts is None:
        print("after the failure the healthy model's forecasts stay ordinary")
    else:
        print(
            f"engine off at {failure:.1f} s; the healthy model's forecasts part from the measurement at {parts:.1f} s"
        )
    gap, since = real["gap"], real["gap"]["since"]
    names = " or ".join(sorted(gap["effects"])).replace("_", " ") or "nothing"
    print(f"told nothing of the engine: {gap['verdict']}, {names}")
    print(
        f"thrust loss since {since['value']:.1f} s, with 95 % between {since['low95']:.1f} and {since['high95']:.1f} s"
    )
