"""falconwing demo: fly an approach live, then model recorded flights, two of them real."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from falconwing_kit.scene.gaussians import GaussianScene
    from falconwing_kit.tools.classroom.flight_page import FlightPage
    from falconwing_kit.tools.demo.approach import Approach

BROWSER_S = 8.0  # a browser's time to show the page before the flight begins
STAGES = (  # begin of a stage's name, and the share of the whole before it, measured on two cores
    ("approach", 0.0),
    ("150 g aircraft, calm flight", 0.06),
    ("150 g aircraft, flight under test", 0.13),
    ("150 g aircraft, closing the gap", 0.32),
    ("150 g aircraft, one-step fit on raw", 0.37),
    ("real indoor flight, its first minute", 0.44),
    ("real flight, fold 1", 0.48),
    ("real flight, all before", 0.59),
    ("real flight, effects and onsets, cut 1", 0.68),
    ("real flight, effects and onsets, cut 2", 0.77),
    ("real flight, effects and onsets, cut 3", 0.83),
    ("real flight, effects and onsets, cut 4", 0.89),
    ("page and figures", 0.94),
)


@dataclass(frozen=True)
class Demo:
    """Fly an approach in a simulated hall, live in the browser; then identify three aircraft from
    recorded flights, two of them real, and name the effects missing in the models.

    It needs no network, GPU or aircraft and takes a minute or two.
    """

    out: Path = Path("falconwing_demo")
    """folder for page, figures and models"""
    scene: str = "hall"
    """the hall of the approach: arena, hall, hall_analog, or a scene file in the kit's world"""
    headless: bool = False
    """fly as fast as possible, without the browser"""
    port: int = 8080
    """TCP port of the live page; the next free one if it is taken"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Fly, analyse the recorded flights and write the page.

        Returns:
            0: the page is written.

        Raises:
            KeyboardInterrupt: Ctrl-C, before the page is written.
            OSError: the folder cannot be made or written.
            FileNotFoundError: there is no scene file.
            InputError: the scene or the port is invalid, or a file cannot be written.
        """
        from falconwing_kit.tools.cli.fly import hall_loader
        from falconwing_kit.tools.cli.progress import StageProgress
        from falconwing_kit.tools.demo.recorded import (
            study_recorded_flights,
            write_recorded_flights,
        )

        hall = hall_loader(self.scene)
        self.out.mkdir(parents=True, exist_ok=True)
        with (
            nullcontext() if self.headless else self._open_page() as live,
            StageProgress("demo", STAGES) as progress,
        ):
            progress("approach through the hall")
            approach = self._fly(hall, live)
            if live is not None:
                live.add_log(approach.log)
                live.say(_verdict(approach), bool(approach.result["success"]))
            if not self.json:
                end = "landed on the pad" if approach.result["success"] else approach.end
                progress.write(f"approach through the splat hall, SIMULATED: {end}\n")
            found = study_recorded_flights(progress)
            progress("page and figures")
            record = write_recorded_flights(found, self.out, approach)
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

    def _open_page(self) -> "FlightPage":
        """Serve the live page, before the steps that take long."""
        from falconwing_kit.tools.classroom.flight_page import FlightPage

        live = FlightPage(self.scene, self.port, task="landing")
        if not self.json:
            print(f"live page: {live.url}", flush=True)
        return live

    def _fly(self, hall: "Callable[[], GaussianScene]", live: "FlightPage | None") -> "Approach":
        """Fly the approach, in real time if there is a live page."""
        from falconwing_kit.flight.loop import PacedClock
        from falconwing_kit.tools.cli.scene_input import open_link
        from falconwing_kit.tools.demo.approach import fly_approach

        log, link = self.out / "approach.mcap", open_link(self.scene)
        if live is None:
            return fly_approach(hall(), log, link=link, scene_name=self.scene)
        opened = live.open()
        scene = hall()
        live.set_scene(scene)
        if opened:
            live.wait_for_viewer(BROWSER_S)
        return fly_approach(
            scene, log, (live.show,), PacedClock(), link=link, scene_name=self.scene
        )


def _verdict(approach: "Approach") -> str:
    if approach.result["success"]:
        return f"landed {100.0 * approach.result['ald_m']:.0f} cm from the centre line"
    return f"did not land: {approach.end}"


def _print_record(record: dict) -> None:
    small, real = record["simulated_flight"], record["real_flight"]
    rows = [("multiple shooting", small["held_out_chi2_per_dof"])]
    rows += [
        (f"one step, {name} (the paper's loss)", chi2)
        for name, chi2 in small["one_step_chi2_per_dof"].items()
    ]
    title = "150 g aircraft, SIMULATED by an independent simulator: 2 s predictions, held-out data"
    print_table(("fit", "chi2 per dof (1 = noise only)"), rows, title=title)
    gap = small["gap"]
    names = " or ".join(gap["effects"]).replace("_", " ") or "nothing"
    truth = ", ".join(gap["truth"]["effects"])
    print(f"another flight of it: {gap['verdict']}, {names} (truth: {truth})")
    print(
        "chi2 per dof of its held-out data: "
        + ", ".join(f"{value:.2f} {when}" for when, value in gap["gap"].items())
    )
    print()
    _print_indoor_flight(record["real_indoor_flight"])
    print()
    title = "2 m aircraft, REAL flight (ALFA): 1 s predictions, held-out data before the failure"
    _print_forecasts(real["one_second_ahead_before_failure"], title)
    parts, failure = real["parts_from_measurement_s"], real["failure_time_s"]
    if parts is None:
        print("after the failure the nominal model's predictions stay within the normal error")
    else:
        print(
            f"engine off at {failure:.1f} s; the nominal model's predictions deviate from the "
            f"measurement at {parts:.1f} s"
        )
    gap, since = real["gap"], real["gap"]["since"]
    names = " or ".join(sorted(gap["effects"])).replace("_", " ") or "nothing"
    print(f"without the throttle log: {gap['verdict']} ({names})")
    print(
        f"thrust loss since {since['value']:.1f} s, "
        f"95 % between {since['low95']:.1f} and {since['high95']:.1f} s"
    )


def _print_indoor_flight(cub: dict) -> None:
    """Forecasts of the Sport Cub, and whether its model describes the flight."""
    title = "65 g aircraft, REAL indoor flight (Sport Cub): 2 s predictions, time after the fit"
    _print_forecasts(cub["two_seconds_ahead"], title)
    verdict = "describes" if cub["describes_flight"] else "does not describe"
    begin, end = cub["fitted"]["from"], cub["fitted"]["to"]
    print(f"the model, fitted from {begin:.0f} to {end:.0f} s, {verdict} this flight")
    print(f"data: {cub['source'].removeprefix('https://')}, {cub['licence']}")


def _print_forecasts(forecasts: dict, title: str) -> None:
    errors = [(name, f["position_m"], f["attitude_deg"]) for name, f in forecasts.items()]
    print_table(("prediction", "position [m]", "attitude [deg]"), errors, title=title)
