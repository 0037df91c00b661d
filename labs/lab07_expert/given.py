"""Lab 7, given: the aircraft's and your course's numbers, the innermost loop, the figures."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
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

WALLS = (-22.5, 17.5, -12.0, 8.0)  # of the hall: x from, to, y from, to [m]
KINDS = ("straight in", "downwind left", "downwind right")  # starts of a landing
LANDING_S = 16.0  # a landing is over after this time [s]
HARDER_BY, ASIDE = 0.4, 0.8  # more sink than touch_sink [m/s], and metres off the line, that count

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


def draw_start(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Where a landing begins: x, y, z (3,) [m], and the yaw [rad].

    Args:
        kind: one of KINDS.
        rng: draws it.
    """
    if kind == "straight in":
        aside = rng.uniform(-2.0, 2.0)
        p = rng.uniform(PAD_START - 20.0, PAD_START - 17.0), PAD_Y + aside, rng.uniform(1.4, 1.9)
        return np.array(p), 0.0
    side = 1.0 if kind == "downwind left" else -1.0
    p = rng.uniform(-4.0, 6.0), PAD_Y + side * rng.uniform(6.5, 7.5), rng.uniform(1.9, 2.1)
    return np.array(p), math.pi


_flying: dict[str, Any] = {}  # your class, and the object of it that lands


def ask_expert(expert: type, what: str, *arguments: Any) -> Any:
    """Calls your class; checks and grader call it through this.

    Args:
        expert: your class. One object of it lives from call to call.
        what: "reset"; "act", with a measured state; or "land", with kinds of starts and seeds.
        arguments: of "act": p_world (3,), v_world (3,), roll, pitch; of "land": kinds and seeds of
            landings, one after the other, in a small world of its own.

    Returns:
        0 for "reset"; (bank, climb rate, throttle) for "act"; what came out for "land".
    """
    if _flying.get("class") is not expert:
        _flying.update({"object": expert(), "class": expert})
    pilot = _flying["object"]
    if what == "reset":
        pilot.reset()
        return 0.0
    if what == "land":
        return [land_simply(pilot, kind, seed) for kind, seed in arguments]
    p, v, roll, pitch = arguments
    return pilot.act(SimpleNamespace(p_world=p, v_world=v, roll=roll, pitch=pitch))


def land_simply(pilot: Any, kind: str, seed: int) -> dict[str, Any]:
    """SIMULATED landing of a point that banks, sinks and slows with a lag; for the public checks.

    Args:
        pilot: with `reset` and `act`.
        kind: of the start, one of KINDS.
        seed: of the start and of the measurement noise.

    Returns:
        "touched": "pad", "floor", "wall" or "nothing"; "x", "aside" [m], "sink" [m/s], "throttle"
        at the end; "answers": number of answers that are three finite numbers in their limits, and
        "steps".
    """
    rng = np.random.default_rng(seed)
    p, yaw = draw_start(kind, rng)
    course, speed, bank, climb = yaw + math.radians(rng.uniform(-4.0, 4.0)), SPEED, 0.0, 0.0
    throttle, answers, steps, touched = 0.0, 0, 0, "nothing"
    pilot.reset()
    while touched == "nothing" and steps < LANDING_S / STEP:
        level = math.sqrt(max(speed**2 - climb**2, 1.0))
        v = np.array([level * math.cos(course), -level * math.sin(course), climb])
        noise = rng.normal(0.0, 1.0, 8) * ([0.01] * 3 + [0.05] * 3 + [0.012] * 2)
        roll, pitch = bank + noise[6], climb / speed + 0.06 + noise[7]
        state = SimpleNamespace(
            p_world=p + noise[:3], v_world=v + noise[3:6], roll=roll, pitch=pitch
        )
        answer = pilot.act(state)
        steps += 1
        answers += is_answer(answer)
        if not is_answer(answer):
            break
        wanted_bank, wanted_climb, throttle = (float(each) for each in answer)
        bank += (wanted_bank - bank) * STEP / 0.25
        climb += (wanted_climb - climb) * STEP / 0.3
        course += GRAVITY * math.tan(bank) / speed * STEP
        speed += (6.0 * (throttle - LEVEL_THROTTLE) - 1.3 * climb - 0.3 * (speed - SPEED)) * STEP
        speed = max(speed, 4.0)
        p = p + v * STEP
        on_pad = PAD_START < p[0] < PAD_START + PAD_LENGTH and abs(p[1] - PAD_Y) < 1.0
        if p[2] - WHEELS_BELOW < (PAD_HEIGHT if on_pad else 0.0):
            touched = "pad" if on_pad else "floor"
        elif not (WALLS[0] < p[0] < WALLS[1] and WALLS[2] < p[1] < WALLS[3]):
            touched = "wall"
    return {
        "touched": touched,
        "x": float(p[0]),
        "aside": abs(float(p[1]) - PAD_Y),
        "sink": -climb,
        "throttle": throttle,
        "answers": answers,
        "steps": steps,
    }


def is_answer(answer: Any) -> bool:
    """Whether it is a bank, a vertical speed and a throttle within their limits."""
    if not isinstance(answer, tuple | list | np.ndarray) or len(answer) != 3:
        return False
    kinds = int | float | np.number
    if not all(isinstance(each, kinds) and math.isfinite(each) for each in answer):
        return False
    bank, climb, throttle = (float(each) for each in answer)
    return abs(bank) <= math.radians(60.001) and abs(climb) <= 3.0 and 0.0 <= throttle <= 1.0


def fly_expert(pilot: Any, kind: str, seed: int) -> dict[str, Any]:
    """SIMULATED: a landing in the kit's world, with its aircraft, noise and delay.

    Args:
        pilot: your expert.
        kind: of the start, one of KINDS.
        seed: of the start and the noise.

    Returns:
        "kind"; "track" (n, 3) [m]; "touchdown", the kit's, or None; "said", in words.
    """
    from falconwing_kit.aircraft import LandingPad, load_airframe, rates_model
    from falconwing_kit.core import Command
    from falconwing_kit.flight import SimulatedWorld, Spread

    model, (p, yaw) = rates_model(), draw_start(kind, np.random.default_rng(seed))
    start = Spread(position=0.1, angle=math.radians(3.0), speed=0.3).start(model, p, seed, yaw)
    world = SimulatedWorld(model, load_airframe(), start, seed=seed, pad=LandingPad())
    inner, track = Autopilot(), []
    pilot.reset()
    while world.contact is None and world.t < LANDING_S:
        state = world.measured()
        bank, climb, throttle = pilot.act(state)
        speed = float(np.linalg.norm(state.v_world))
        turn = GRAVITY * math.tan(bank) / speed
        rates = turn * np.array(
            [
                -math.sin(state.pitch),
                math.sin(bank) * math.cos(state.pitch),
                math.cos(bank) * math.cos(state.pitch),
            ]
        )
        world.send(world.t, Command.clip(throttle, *inner.sticks(state, bank, climb, rates)))
        world.advance(world.t + STEP)
        track.append(world.state.p_world)
    touch = world.contact.touchdown if world.contact else None
    if touch is None:
        said = f"touched {world.contact.obstacle if world.contact else 'nothing'}"
    else:
        said = (
            f"{touch.surface}, {touch.past_threshold:.1f} m past the threshold, "
            f"{100.0 * touch.absolute_lateral_deviation:.0f} cm off the line, "
            f"sinking {touch.sink_rate:.2f} m/s"
        )
    return {"kind": kind, "track": np.array(track), "touchdown": touch, "said": said}


def scatter_of(pilot: Any, count: int = 24) -> float:
    """Root mean square distance of straight-in touchdowns from their mean [m]; inf if one fails."""
    return _scatter([fly_expert(pilot, "straight in", seed)["touchdown"] for seed in range(count)])


def scatter_of_the_kit(count: int = 24) -> float:
    """The same starts, flown by the kit's own expert."""
    from falconwing_kit.aircraft import LandingPad, load_airframe, rates_model
    from falconwing_kit.control import LandingExpert
    from falconwing_kit.core import Observation
    from falconwing_kit.flight import SimulatedWorld, Spread

    model, airframe, touches = rates_model(), load_airframe(), []
    for seed in range(count):
        p, yaw = draw_start("straight in", np.random.default_rng(seed))
        start = Spread(position=0.1, angle=math.radians(3.0), speed=0.3).start(model, p, seed, yaw)
        world = SimulatedWorld(model, airframe, start, seed=seed, pad=LandingPad())
        expert, past = LandingExpert(model, airframe, LandingPad()), np.zeros((30, 4))
        while world.contact is None and world.t < LANDING_S:
            command = expert.act(Observation(world.t, None, past, world.measured()))
            past = np.vstack([past[1:], command.vector])
            world.send(world.t, command)
            world.advance(world.t + STEP)
        touches.append(world.contact.touchdown if world.contact else None)
    return _scatter(touches)


def _scatter(touches: Sequence[Any]) -> float:
    if any(touch is None for touch in touches):
        return math.inf
    points = np.array([touch.p_world[:2] for touch in touches])
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def draw_approaches(flights: Sequence[Mapping[str, Any]]) -> None:
    """Tracks of landings from above.

    Args:
        flights: as `fly_expert` returns them.
    """
    import matplotlib.pyplot as plt

    _, ax = plt.subplots(figsize=(9, 5), layout="constrained")
    x_low, x_high, y_low, y_high = WALLS
    ax.plot(
        [x_low, x_high, x_high, x_low, x_low], [y_low, y_low, y_high, y_high, y_low], color="black"
    )
    pad = [PAD_START, PAD_START + PAD_LENGTH]
    ax.fill_between(pad, PAD_Y - 1.0, PAD_Y + 1.0, color="#9fc5e8", label="pad")
    named = set()
    for flight in flights:
        kind, track = flight["kind"], np.reshape(flight["track"], (-1, 3))
        colour, line = dict(zip(KINDS, ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-.")), strict=True))[
            kind
        ]
        label = None if kind in named else kind
        named.add(kind)
        ax.plot(track[:, 0], track[:, 1], line, color=colour, label=label)
        ax.plot(track[-1:, 0], track[-1:, 1], "o", color=colour)
    ax.set(title="SIMULATED landings, from above", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set(ylim=(y_low - 3.5, y_high + 1.0))  # room for the legend below the wall
    ax.legend(fontsize="small", loc="lower center", ncols=4)


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
    above.set(ylim=(-13.5, 12.5))
    bank.plot(flight["t"], np.degrees(flight["bank"]), "--", color=ORANGE, label="commanded")
    bank.plot(flight["t"], np.degrees(flight["roll"]), color=BLUE, label="flown")
    bank.set(xlabel="time [s]", ylabel="bank [deg], right wing down positive", ylim=(-60, 40))
    margin.plot(flight["t"], flight["margin"], color=BLUE, label="speed over stall speed")
    margin.axhline(1.0, color="black", linestyle=":", label="stall")
    margin.set(xlabel="time [s]", ylabel="stall margin [-]", ylim=(0.9, 1.7))
    for column, (name, line, colour) in enumerate(
        (
            ("throttle", "-", GREEN),
            ("aileron", "--", ORANGE),
            ("elevator", "-.", BLUE),
            ("rudder", ":", "black"),
        )
    ):
        sticks.plot(flight["t"], flight["sticks"][:, column], line, color=colour, label=name)
    sticks.set(xlabel="time [s]", ylabel="commands, share of full range", ylim=(-1.05, 1.35))
    for ax in (above, bank, margin, sticks):
        ax.legend(fontsize="small", loc="upper center", ncols=4)  # above all curves


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
