"""Lab 7, given: the aircraft's and your course's numbers, the innermost loop, the figures."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)

GRAVITY = 9.81  # g [m/s^2]
STEP = 0.05  # between two commands [s]: 20 Hz
SPEED = 7.0  # that is flown [m/s]
# Lift over mass is V^2 (LIFT_0 + LIFT_SLOPE alpha), alpha the angle of attack [rad]: the kit's 150
# g aircraft.
LIFT_0, LIFT_SLOPE = 0.078, 1.4  # [1/m], [1/(m rad)]
STALL_ALPHA = math.radians(
    COHORT["stall_alpha_deg"]
)  # where the flow leaves your course's wing [rad]; an estimate

APPROACH = math.radians(COHORT["approach_deg"])  # angle at which a far line is approached [rad]
PULL = 0.3  # k, how soon it turns along the line [1/m]
TURN_GAIN = 1.8  # of the course [1/s]
BANK_LIMIT = math.radians(40.0)

KP, KI = 0.35, 0.25  # throttle for each m/s of missing speed, and for each m/s kept up for a second
LEVEL_THROTTLE, GLIDE_THROTTLE = 0.21, 0.05  # what straight flights need

GLIDE, STEEPEST = (
    math.radians(6.0),
    math.radians(9.0),
)  # slope of the approach, and the steepest one allowed [rad]
SLOPE_GAIN = 1.0  # vertical speed for each metre off the slope [1/s]
FLARE_TIME = 1.2  # in which the height falls to 1/e in the flare [s]
WHEELS_BELOW = 0.11  # the centre of gravity [m]

WAYPOINTS = np.array(
    [[-12.0, -8.0], [9.0, -8.0], [9.0, 4.0], [-12.0, 4.0]]
)  # of the circuit, x and y [m]
HEIGHT = 2.0  # of the circuit [m]
TURN_AHEAD = 6.5  # a leg ends so far before its waypoint: about a turn's radius [m]
PAD_START, PAD_LENGTH, PAD_Y, PAD_HEIGHT = 1.0, 13.0, -2.0, 0.1  # the landing pad, along x [m]
AIM = np.array([PAD_START + 4.0, PAD_Y])  # where the approach's slope meets the pad, x and y [m]

BLUE, ORANGE, GREEN = (
    "#0072B2",
    "#D55E00",
    "#009E73",
)  # distinguishable for colour-blind readers (Okabe and Ito)


class Autopilot:
    """The innermost loop: commanded bank, vertical speed, body rates -> aileron, elevator, rudder.

    Each command is the feed-forward of the steady turn plus a feedback term. You need not change
    it.
    """

    def __init__(self) -> None:
        self._sum, self._climb, self._bend = 0.0, 0.0, 0.0

    def sticks(
        self, state: Any, bank: float, climb_rate: float, rates: Any
    ) -> tuple[float, float, float]:
        """Aileron, elevator and rudder, -1..1.

        Args:
            state: measured: v_world (3,) [m/s], roll, pitch [rad], rates_body (3,) p, q, r [rad/s].
            bank: commanded [rad], right wing down positive.
            climb_rate: commanded [m/s], upward positive.
            rates: commanded p, q, r [rad/s].
        """
        speed = max(float(np.linalg.norm(state.v_world)), 4.0)
        climb, climbing = (
            math.asin(min(max(v / speed, -0.5), 0.5)) for v in (climb_rate, state.v_world[2])
        )
        bank, missing = min(max(bank, -1.2), 1.2), climb - climbing
        self._bend += 0.4 * (
            (climb - self._climb) / STEP - self._bend
        )  # how fast the path shall bend upward [rad/s]
        self._sum, self._climb = min(max(self._sum + STEP * missing, -0.15), 0.15), climb
        n = math.cos(climb) / math.cos(bank) + speed * self._bend / GRAVITY
        alpha = (n * GRAVITY / speed**2 - LIFT_0) / LIFT_SLOPE
        pitch_missing = climb + alpha * math.cos(bank) - state.pitch
        p_missing, q_missing, r_missing = np.subtract(rates, state.rates_body)
        aileron = 1.5 * (bank - state.roll) + 0.03 * p_missing - 0.12 * math.tan(bank)
        elevator = (
            (2.0 * alpha - 0.17) / 0.6 + 0.45 * rates[1] + 1.5 * pitch_missing + missing + self._sum
        )
        rudder = 0.244 * rates[2] + 0.05 * r_missing
        return aileron, elevator + 0.03 * q_missing, rudder


def leg(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Start and end of a leg of the circuit, (2,) each [m].

    After the last comes the first again.
    """
    return WAYPOINTS[number % 4], WAYPOINTS[(number + 1) % 4]


def is_at_end(p: np.ndarray, start: np.ndarray, end: np.ndarray) -> bool:
    """Whether it is time to turn into the next leg, for an aircraft at p (2,) [m]."""
    return float((end - p) @ (end - start)) < TURN_AHEAD * float(np.linalg.norm(end - start))


def draw_circuit(flight: dict[str, np.ndarray]) -> None:
    """Track, bank, stall margin and commands of a flight round the circuit.

    Args:
        flight: by name, (n,) or (n, 3): "t" [s], "p_world" [m], "roll" [rad], "bank" command [rad],
            "margin" [-], "sticks" (n, 4).
    """
    import matplotlib.pyplot as plt

    fig: Any = plt.figure(figsize=(11, 8), layout="constrained")
    above, bank, margin, sticks = fig.subplots(2, 2, width_ratios=(1.2, 1.0)).ravel()
    above.plot(
        [-22.5, 17.5, 17.5, -22.5, -22.5],
        [-12.0, -12.0, 8.0, 8.0, -12.0],
        color="black",
        label="wall",
    )
    above.plot(*np.vstack([WAYPOINTS, WAYPOINTS[:1]]).T, "--", color=ORANGE, label="legs")
    above.plot(flight["p_world"][:, 0], flight["p_world"][:, 1], color=BLUE, label="flown")
    above.plot(*flight["p_world"][0, :2], "o", color=BLUE, label="start")
    above.set(title="SIMULATED, from above", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    bank.plot(flight["t"], np.degrees(flight["bank"]), "--", color=ORANGE, label="commanded")
    bank.plot(flight["t"], np.degrees(flight["roll"]), color=BLUE, label="flown")
    bank.set(xlabel="time [s]", ylabel="bank [deg], right wing down positive")
    margin.plot(flight["t"], flight["margin"], color=BLUE, label="speed over stall speed")
    margin.axhline(1.0, color="black", linestyle=":", label="stall")
    margin.set(xlabel="time [s]", ylabel="stall margin [-]", ylim=(0.9, 1.7))
    for column, (name, line) in enumerate(
        (("throttle", "-"), ("aileron", "--"), ("elevator", "-."), ("rudder", ":"))
    ):
        sticks.plot(flight["t"], flight["sticks"][:, column], line, label=name)
    sticks.set(xlabel="time [s]", ylabel="commands, share of full range", ylim=(-1.05, 1.05))
    for ax in (above, bank, margin, sticks):
        ax.legend(fontsize="small", loc="upper right")


def draw_landing(flights: dict[str, dict[str, np.ndarray]]) -> None:
    """Height and sink rate of landings over the way.

    Args:
        flights: by name, (n,) or (n, 3) as in `draw_circuit`: "p_world" [m] and "sink" [m/s].
    """
    import matplotlib.pyplot as plt

    fig: Any = plt.figure(figsize=(9, 6), layout="constrained")
    height, sink = fig.subplots(2, 1, sharex=True)
    pad = [PAD_START, PAD_START + PAD_LENGTH]
    height.fill_between(pad, 0.0, PAD_HEIGHT, color="#9fc5e8", label="pad")
    for (name, flight), colour, line in zip(
        flights.items(), (BLUE, ORANGE), ("-", "--"), strict=False
    ):
        x, z = flight["p_world"][:, 0], flight["p_world"][:, 2]
        height.plot(x, z - WHEELS_BELOW, line, color=colour, label=name)
        height.plot(x[-1], z[-1] - WHEELS_BELOW, "o", color=colour)
        sink.plot(x, flight["sink"], line, color=colour, label=name)
    sink.axhline(COHORT["touch_sink"], color="black", linestyle=":", label="commanded at touchdown")
    height.set(title="SIMULATED landings", ylabel="height of the wheels [m]")
    sink.set(xlabel="x along the runway [m]", ylabel="sink rate [m/s]")
    height.legend(fontsize="small")
    sink.legend(fontsize="small")


def moving_landing(seed: int = 3) -> Any:
    """A film: the kit's own expert lands (simulated), from the side and from above.

    Args:
        seed: of the start and the noise.
    """
    from matplotlib.figure import Figure

    from falconwing_kit.aircraft import LandingPad, load_airframe, rates_model
    from falconwing_kit.control import LandingExpert
    from falconwing_kit.core import Observation
    from falconwing_kit.flight import SimulatedWorld, Spread
    from falconwing_kit.tools.grading import moving_figure, plan_view, side_view

    model, airframe, pad = rates_model(), load_airframe(), LandingPad()
    begin = (PAD_START - 20.0, AIM[1] + 2.0, 1.5)
    place = Spread(position=0.4, angle=0.07, speed=0.4).start(model, begin, seed)
    world = SimulatedWorld(model, airframe, place, seed=seed, pad=pad)
    pilot, rows, past = LandingExpert(model, airframe, pad), [], np.zeros((30, 4))
    while world.t < 8.0 and world.contact is None:
        x = world.state
        rows.append((world.t, *x.p_world, x.pitch, x.yaw))
        command = pilot.act(Observation(world.t, None, past, world.measured()))
        past = np.vstack([past[1:], command.vector])
        world.send(world.t, command)
        world.advance(world.t + STEP)
    flown = np.array(rows)
    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    axes: Any = figure.subplots(2, 1, sharex=True)
    side, above = axes
    end = PAD_START + PAD_LENGTH
    side.fill_between([PAD_START, end], 0.0, PAD_HEIGHT, color="#9fc5e8", label="pad")
    above.fill_between([PAD_START, end], PAD_Y - 1.0, PAD_Y + 1.0, color="#9fc5e8")
    side.set(ylabel="height [m]", ylim=(0.0, 3.0), xlim=(begin[0] - 1.5, end + 0.5))
    above.set(xlabel="x along the runway [m]", ylabel="y [m]", ylim=(PAD_Y - 2.5, PAD_Y + 4.0))
    drawn = []
    for ax in (side, above):
        track = ax.plot([], [], color=BLUE)[0]
        drawn.append((track, ax.fill([0], [0], color=ORANGE)[0]))
    side.legend(fontsize=7)

    def draw(number: int) -> None:
        t, x, y, z, pitch, yaw = flown[min(number, len(flown) - 1)]
        part = flown[: number + 1]
        drawn[0][0].set_data(part[:, 1], part[:, 3] - WHEELS_BELOW)
        drawn[1][0].set_data(part[:, 1], part[:, 2])
        drawn[0][1].set_xy(side_view(x, z - WHEELS_BELOW + 0.05, pitch, length=1.2).T)
        drawn[1][1].set_xy(plan_view(x, y, yaw, span=1.2).T)
        side.set_title(f"The kit's expert lands, {t:.1f} s (simulated)", fontsize=9)

    words = "An aircraft comes from two metres aside, turns onto the pad's line, flares and lands."
    return moving_figure(figure, draw, len(flown) + 15, STEP, words)
