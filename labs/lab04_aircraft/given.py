"""Lab 4, given: the aircraft's parameters, body rates, a pilot, small plants, and figures."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)
GRAVITY = 9.8  # m/s^2, as in the paper's appendix
DOWN_THRUST = np.radians(
    COHORT["down_thrust_deg"]
)  # rad, how far the propeller's axis points down in front

# A 150 g aircraft with 0.076 m^2 of wing. Forces are per unit mass: rho S CLa / 2m = 1.3 * 0.076 *
# 4.3 / 0.3 = 1.4.
K: dict[str, float] = {
    "cL_0": 0.078, "cL_alpha": 1.40,  # lift: 1/m, 1/(m rad)
    "cD_0": 0.0155, "cD_induced": 0.2,  # drag: 1/m, m
    "cY_beta": -0.25,  # side force of sideslip: 1/(m rad)
    "kT": 9.0, "kTV": 0.5,  # thrust: m/s^2, 1/s
    "L_da": 0.37, "L_beta": -0.15,  # roll rate of aileron and sideslip: 1/m, 1/(m rad)
    # pitch rate at alpha 0, of elevator, of alpha: 1/m, 1/m, 1/(m rad)
    "M_0": 0.106, "M_de": 0.35, "M_alpha": -1.2,
    "N_dr": 0.25, "N_beta": 0.8,  # yaw rate of rudder and sideslip: 1/m, 1/(m rad)
}  # fmt: skip

HALL = (40.0, 20.0)  # m, length and width
BLUE, ORANGE, GREEN, GREY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#777777",
)  # distinguishable for colour-blind readers


def rotation_world_body(roll: float, pitch: float, yaw: float) -> Array:
    """Lab 2's rotation: body vectors (x nose, y right wing, z belly) to world vectors (z up).

    Args:
        roll: [rad], positive right wing down.
        pitch: [rad], positive nose up.
        yaw: [rad], positive nose right, zero along world x.

    Returns:
        (3, 3) diag(1, -1, -1) @ Rz(yaw) @ Ry(pitch) @ Rx(roll).
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    Rx = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    Ry = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    Rz = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.diag([1.0, -1.0, -1.0]) @ Rz @ Ry @ Rx


def body_rates(air: Array, command: Array, K: dict[str, float]) -> Array:
    """Quasi-steady body rates: p = V (L_da aileron + L_beta beta), and so on [paper, Section IV-B].

    Args:
        air: (3,) airspeed V [m/s], angle of attack alpha [rad], sideslip beta [rad].
        command: (4,) throttle 0..1, aileron, elevator, rudder -1..1.
        K: the aircraft's numbers.

    Returns:
        (3,) roll rate p, pitch rate q, yaw rate r [rad/s].
    """
    V, alpha, beta = air
    _, aileron, elevator, rudder = command
    return V * np.array([
        K["L_da"] * aileron + K["L_beta"] * beta,
        K["M_0"] + K["M_de"] * elevator + K["M_alpha"] * alpha,
        K["N_dr"] * rudder + K["N_beta"] * beta,
    ])  # fmt: skip


def vertical_flight(x: Array, u: Array) -> Array:
    """Point mass in a vertical plane [Lanchester 1908, with thrust and drag], to test integrators.

    Args:
        x: (4,) speed V [m/s], climb angle [rad], distance [m], height [m].
        u: (2,) thrust per mass [m/s^2], lift over V^2 per mass [1/m].

    Returns:
        (4,) dx/dt.
    """
    V, climb = x[0], x[1]
    return np.array([
        u[0] - 0.03 * V**2 - GRAVITY * np.sin(climb),
        u[1] * V - GRAVITY * np.cos(climb) / V,
        V * np.cos(climb),
        V * np.sin(climb),
    ])  # fmt: skip


def step_linear(
    rk4_step: Callable[..., Array],
    A: Array,
    B: Array,
    x: Array,
    u_now: Array,
    u_next: Array,
    dt: float,
) -> tuple[Array, Array]:
    """Your `rk4_step` applied to dx/dt = A x + B u; checks and grader call it through this.

    Args:
        rk4_step: your function.
        A: (n, n) [1/s].
        B: (n, m).
        x: (n,) state at the beginning.
        u_now: (m,) input at the beginning.
        u_next: (m,) input at the end.
        dt: length of the step [s].

    Returns:
        The state at the end (n,), and the one at the beginning as your function left it.
    """
    return rk4_step(lambda x, u: A @ x + B @ u, x, u_now, u_next, dt), x


def pilot(state: Array, bank: float, level: Array) -> Array:
    """A simple pilot who holds a bank angle and the height of 2 m.

    Args:
        state: (9,) px, py, pz, pitch, yaw, roll, vx, vy, vz.
        bank: commanded roll angle [rad].
        level: (3,) angle of attack, throttle and elevator of straight level flight.

    Returns:
        (4,) throttle, aileron, elevator, rudder.
    """
    roll, sink = state[5], -state[8]
    pull = 1.0 / np.cos(roll)  # in a turn the wing carries this many times the weight
    elevator = level[2] + 1.55 * (pull - 1.0) + 0.35 * sink + 0.10 * (2.0 - state[2])
    throttle = level[1] + 0.10 * (pull**2 - 1.0) + 0.3 * (7.0 - np.linalg.norm(state[6:]))
    return np.clip(
        [throttle, 2.5 * (bank - roll), elevator, 0.77 * roll], [0.0, -1.0, -1.0, -1.0], 1.0
    )


def hall_axes(ax: Any, title: str) -> None:
    """Draw the hall's walls from above and name the axes."""
    x, y = HALL[0] / 2.0, HALL[1] / 2.0
    ax.plot([-x, x, x, -x, -x], [-y, -y, y, y, -y], color=GREY, lw=1)
    ax.set(
        xlabel="x, along the runway [m]", ylabel="y, to the left [m]", title=title, aspect="equal"
    )


def moving_wind(wind: float = 1.5) -> Any:
    """A film from above: a circle through air that moves; dots drift with the air.

    Args:
        wind: velocity of the air along y, to the left [m/s].
    """
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure, plan_view

    V, R, seconds = 7.0, 7.0 / 0.9, 7.0  # speed through the air, radius in it: 0.9 rad/s
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    ax: Any = figure.subplots()
    hall_axes(ax, "")
    ax.set(xlim=(-21, 21), ylim=(-12, 17))
    rng = np.random.default_rng(4)
    dots = rng.uniform((-20.0, -10.0), (20.0, 10.0), (90, 2))
    air = ax.plot([], [], ".", color=GREY, markersize=3, label="the air")[0]
    ring = ax.plot([], [], ":", color=GREEN, lw=2, label="the circle through the air")[0]
    track = ax.plot([], [], color=BLUE, label="track over the ground")[0]
    outline = ax.fill([0], [0], color=ORANGE)[0]
    ax.legend(loc="upper right", fontsize=8)
    around = np.linspace(0.0, 2.0 * np.pi, 100)

    def place(t: Array) -> Array:
        turned = V / R * np.asarray(t)
        return np.array([R * np.sin(turned), R * np.cos(turned) - 3.0 + wind * np.asarray(t)])

    def draw(number: int) -> None:
        t = 0.2 * number
        drift = (dots[:, 1] + 10.0 + wind * t) % 20.0 - 10.0
        air.set_data(dots[:, 0], drift)
        ring.set_data(R * np.cos(around), R * np.sin(around) - 3.0 + wind * t)
        track.set_data(*place(np.linspace(0.0, t, 80)))
        outline.set_xy(plan_view(*place(np.array(t)), V / R * t, span=2.0).T)
        ax.set_title(f"A turn in a wind of {wind:g} m/s, {t:.1f} s (simulated)")

    words = "From above: dots drift towards +y, a dotted circle drifts with them, and the aircraft"
    return moving_figure(
        figure, draw, int(5 * seconds), 0.2, words + " stays on the circle; its track is a spiral."
    )
