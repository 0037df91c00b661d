# %% [markdown]
# # Lab 7: The expert
# **How does an aircraft follow a line, turn without slipping, and touch down softly?**
#
# ![A circuit in the hall from above with its bank, stall margin and commands over time](goal.webp)
#
# *What you will have at the end (open course).*
#
# The paper's vision pilots learn by imitation of an *expert*, a controller with access to the state. In this lab you
# write one. It flies the kit's simulated aircraft, with noisy measurements, 20 commands a second
# and a delay, as in the hall.
#
# **You will be able to**
# - say which bank a turn needs, and how far it is from the stall,
# - make an aircraft converge to a line, whatever its heading,
# - limit a controller without spoiling it (anti-windup),
# - flare,
# - build an expert that lands from anywhere, with modes of its own.
#
# **Time** about 4 hours. **Before** Lab 2 (signs of roll, pitch, yaw), Lab 4 (the aircraft); the idea of a PI
# controller. **Paper** *Case Study: Leader-Follower Visual Tracking* (the expert), *Indoor Flying Arena Setup for
# Autonomous Landing*, Appendix.

# %%
import math  # noqa: I001

import matplotlib.pyplot as plt
import numpy as np
from given import (
    AIM, APPROACH, BANK_LIMIT, COHORT, FLARE_TIME, GLIDE, GLIDE_THROTTLE, GRAVITY, HEIGHT, KI,
    KINDS, KP, LEVEL_THROTTLE, LIFT_0, LIFT_SLOPE, PAD_HEIGHT, PAD_START, PULL, SLOPE_GAIN, SPEED,
    STALL_ALPHA, STEEPEST, STEP, TURN_GAIN, WHEELS_BELOW, Autopilot, draw_approaches, draw_circuit,
    draw_landing, fly_expert, is_at_end, leg, scatter_of, scatter_of_the_kit,
)  # fmt: skip

from falconwing_kit.aircraft import LandingPad, load_airframe, rates_model
from falconwing_kit.core import rotation_world_body
from falconwing_kit.core import Command
from falconwing_kit.flight import SimulatedWorld
from falconwing_kit.flight import Spread
from falconwing_kit.tools.grading import check

print("your course:", COHORT)

# %%
from given import moving_landing

from falconwing_kit.tools.grading import borrow, keep_going

keep_going()  # a missing function stops only the cells that need it
moving_landing()

# %% [markdown]
# *In words: the kit's expert, from the side and from above. It begins 2 m to the left of the pad's centre line, turns onto
# it, comes down on a straight slope, and bends it just above the pad.*

# %% [markdown]
# **World axes**: x along the runway, y left, z up. **Signs**: roll (bank) positive with the right wing down, pitch
# positive nose up, yaw and course positive to the *right*. So a course of 0 flies along +x, and 90° flies along -y.
#
# ## 1 A turn and its margin
# An aircraft flies with the speed $V$ along a path that climbs by the angle $\gamma$ and turns. Seen from above, the
# path has the radius $R$. Only the lift $L$ can bend it. It is perpendicular to the path, banked by $\phi$:
#
# $$L \cos\phi = m g \cos\gamma \qquad\text{(carries)}, \qquad
# L \sin\phi = m \frac{(V \cos\gamma)^2}{R} \qquad\text{(pulls round)}$$
#
# The load factor is $n = L / (m g)$. The wing gives at most
# $L_\mathrm{max} = m V^2 (c_0 + c_\alpha\, \alpha_\mathrm{stall})$, so there is a slowest speed $V_\mathrm{stall}$ for
# each $n$. The **stall margin** is $V / V_\mathrm{stall}$. At 1 the flow leaves the wing.
#
# Write `turn`. A radius is positive for a turn to the right, negative to the left.


# %% exercise="turn"
def turn(speed, climb, radius):
    """Bank of a steady turn, and how far it is from the stall.

    Use GRAVITY [m/s^2], LIFT_0 = c_0 [1/m], LIFT_SLOPE = c_alpha [1/(m rad)] and STALL_ALPHA [rad].

    Args:
        speed: V along the path [m/s].
        climb: gamma, slope of the path [rad], upward positive.
        radius: R of the path seen from above [m], positive to the right, negative to the left.

    Returns:
        (bank, margin): the bank [rad], right wing down positive, and V over the stall speed of
        this turn [-].
    """
    # BEGIN SOLUTION
    bank = np.arctan(speed**2 * np.cos(climb) / (GRAVITY * radius))
    n = np.cos(climb) / np.cos(bank)
    stall_speed = np.sqrt(n * GRAVITY / (LIFT_0 + LIFT_SLOPE * STALL_ALPHA))
    return bank, speed / stall_speed
    # END SOLUTION


# %% check="turn"
check(turn)

# %%
for radius in (20.0, 10.0, 7.0, 5.0, 3.5):
    bank, margin = turn(SPEED, 0.0, radius)
    print(f"radius {radius:4.1f} m: bank {np.degrees(bank):4.1f} deg, stall margin {margin:.2f}")

# %% [markdown]
# ## 2 A turn without slipping
# In a steady turn the nose must go round with the path: the aircraft turns about the world's *vertical* with
# $\dot\psi = g \tan\phi / V$. Body axes are x nose, y right wing, z belly. Written in them, this one turn needs all
# three rates:
#
# $$p = -\dot\psi \sin\theta, \qquad q = \dot\psi \sin\phi \cos\theta, \qquad r = \dot\psi \cos\phi \cos\theta$$
#
# with the pitch $\theta$. So a banked aircraft needs *up* elevator to turn ($q > 0$ on both sides), and rudder into the
# turn. `Autopilot` moves these surfaces by your rates.
#
# Write `turn_rates`.


# %% exercise="turn_rates"
def turn_rates(bank, pitch, speed):
    """Body rates of a steady turn. Use GRAVITY [m/s^2].

    Args:
        bank: [rad], right wing down positive.
        pitch: [rad], nose up positive.
        speed: [m/s].

    Returns:
        (p, q, r): about the nose, the right wing and the belly [rad/s].
    """
    # BEGIN SOLUTION
    yaw_rate = GRAVITY * np.tan(bank) / speed
    p = -yaw_rate * np.sin(pitch)
    q = yaw_rate * np.sin(bank) * np.cos(pitch)
    r = yaw_rate * np.cos(bank) * np.cos(pitch)
    return p, q, r
    # END SOLUTION


# %% check="turn_rates"
check(turn_rates)

# %% [markdown]
# ## 3 Follow a line
# The line leads from `start` to `end`. Let $e$ be how far the aircraft is to the **right** of it [m], $\chi_q$ the
# line's course. A *vector field* [Beard and McLain, ch. 10] defines the commanded course everywhere:
#
# $$\chi_\mathrm{commanded} = \chi_q - \chi_\infty \frac{2}{\pi} \arctan(k\, e)$$
#
# Far to the right of the line this course leads back to it, by the angle $\chi_\infty$ (`APPROACH`) to the left of the
# line's own; near the line it is almost along it. $k$ is `PULL`.
#
# ```text
#   start ================ line ================> end      seen from above
#                            _ . - '  near: almost along the line
#                        .'
#                      /
#   e > 0 down here   /  far to the right: towards it by APPROACH
# ```
#
# Then turn towards that course. The turn rate shall be `TURN_GAIN` times the course error, and
# $\dot\chi = g \tan\phi / V$ gives the bank. Two traps: a course error belongs between -180° and 180° (from 170° to
# -170° it is +20°, not -340°), and the bank must stay within its limit.
#
# Write `guidance`.


# %% exercise="guidance"
def guidance(p, v, start, end, bank_limit):
    """Bank that leads to a line and along it.

    Use APPROACH [rad], PULL [1/m], TURN_GAIN [1/s] and GRAVITY [m/s^2].

    Args:
        p: (2,) where the aircraft is, x and y [m]; y is to the left of x.
        v: (2,) its velocity over ground, x and y [m/s]; its direction is the course, its length
            the speed.
        start: (2,) where the line begins [m].
        end: (2,) where it ends [m].
        bank_limit: largest bank [rad].

    Returns:
        The commanded bank [rad], right wing down positive, between -bank_limit and bank_limit.
    """
    # BEGIN SOLUTION
    along = (end - start) / np.linalg.norm(end - start)
    e = (p - start) @ np.array([along[1], -along[0]])
    commanded = math.atan2(-along[1], along[0]) - APPROACH * 2.0 / math.pi * math.atan(PULL * e)
    error = commanded - math.atan2(-v[1], v[0])
    error = (error + math.pi) % (2.0 * math.pi) - math.pi
    bank = math.atan(np.linalg.norm(v) * TURN_GAIN * error / GRAVITY)
    return min(max(bank, -bank_limit), bank_limit)
    # END SOLUTION


# %% check="guidance"
check(guidance)

# %% [markdown]
# ## 4 Hold the speed
# A PI controller moves the throttle: `KP` times the speed error, and `KI` times its integral, which finds the throttle
# of steady flight. But a throttle ends at 0 and at 1. If the aircraft is slow for long, the throttle stays at 1 and the
# integral keeps growing (integrator windup). When the speed is right at last, the integral keeps the throttle open for
# many seconds more.
#
# The remedy (anti-windup): **stop the integral while the throttle is at a limit and the error pushes further into it**.
# Continue it when the error leads back.
#
# Write `hold_speed`. One call is one step of `STEP` = 0.05 s:
# 1. the new sum: `integral + error * STEP`,
# 2. the throttle with it: `base + KP * error + KI * new sum`,
# 3. if that is above 1 and the error positive, or below 0 and the error negative: take the old sum instead, and compute
#    the throttle again,
# 4. limit the throttle to 0..1.


# %% exercise="hold_speed"
def hold_speed(error, integral, base):
    """Throttle by a PI controller that does not wind up. Use KP [s/m], KI [1/m] and STEP [s].

    Args:
        error: commanded speed minus speed [m/s].
        integral: sum of errors over time so far [m].
        base: throttle that the flight needs by itself, 0..1.

    Returns:
        (throttle, integral): throttle 0..1, and the sum for the next step [m].
    """
    # BEGIN SOLUTION
    new = integral + error * STEP
    throttle = base + KP * error + KI * new
    if (throttle > 1.0 and error > 0.0) or (throttle < 0.0 and error < 0.0):
        new = integral
        throttle = base + KP * error + KI * new
    return min(max(throttle, 0.0), 1.0), new
    # END SOLUTION


# %% check="hold_speed"
check(hold_speed)

# %% [markdown]
# ## 5 Fly the circuit
# Four legs around the hall, 2 m above the floor. A pilot is a function from the measured state to a command; `fly` is
# the loop around it, 20 times a second. The world is **simulated**: the kit's model, measured poses with 1 cm and 0.7°
# of noise, and 50 ms from command to aircraft.

# %%
model, airframe = rates_model(), load_airframe()


def fly(pilot, start, seed, seconds, pad=None):
    """Fly a pilot from x, y, z [m] until it touches something; what happened, by name."""
    place = Spread(position=0.4, angle=math.radians(4.0), speed=0.4).start(model, start, seed)
    world = SimulatedWorld(model, airframe, place, seed=seed, pad=pad)
    rows = []
    while world.t < seconds and world.contact is None:
        bank, command = pilot(world.measured())
        world.send(world.t, command)
        x = world.state
        u, _, w = rotation_world_body(x.roll, x.pitch, x.yaw).T @ x.v_world  # nose, wing, belly
        lift, most = (LIFT_0 + LIFT_SLOPE * alpha for alpha in (math.atan2(w, u), STALL_ALPHA))
        margin = math.sqrt(most / max(lift, 1e-3))
        rows.append((world.t, x.p_world, x.roll, bank, margin, command.vector, -x.v_world[2]))
        world.advance(world.t + STEP)
    names = ("t", "p_world", "roll", "bank", "margin", "sticks", "sink")
    return {"contact": world.contact} | {
        name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }


class CircuitPilot:
    """Round the waypoints at one height and speed, with your functions."""

    def __init__(self):
        self.leg, self.integral, self.autopilot = 0, 0.0, Autopilot()

    def __call__(self, state):
        """The commanded bank [rad], and the command."""
        p, speed = state.p_world, float(np.linalg.norm(state.v_world))
        if is_at_end(p[:2], *leg(self.leg)):
            self.leg += 1
        bank = guidance(p[:2], state.v_world[:2], *leg(self.leg), BANK_LIMIT)
        throttle, self.integral = hold_speed(SPEED - speed, self.integral, LEVEL_THROTTLE)
        rates = turn_rates(bank, state.pitch, speed)
        sticks = self.autopilot.sticks(state, bank, HEIGHT - p[2], rates)  # 1 m low: climb at 1 m/s
        return bank, Command.clip(throttle, *sticks)


# %% figure="circuit"
flight = fly(CircuitPilot(), (-12.0, -8.0, HEIGHT), seed=1, seconds=25.0)
draw_circuit(flight)
plt.show()
touched = flight["contact"].obstacle if flight["contact"] else "nothing"
print(f"flown {flight['t'][-1]:.1f} s, touched {touched}")
print(f"smallest stall margin {flight['margin'].min():.2f}")

# %% [markdown]
# *In words, for the open course: above left, an oval track around a rectangle of legs, about 3 m inside the long walls.
# The commanded bank swings between its limit of 40° to the left and some 15° to the right; the flown one comes a little
# later and overshoots by some 6°. The stall margin is about 1.36 in straight flight and falls below 1.1 where a turn
# begins, with ripples from the measurement noise. The commands stay within their range, except for the aileron where a
# turn begins.*
#
# **Question on the figure.** Where is the stall margin smallest, and why? What are the short right banks for?

# %% [markdown] answer="circuit_reading"
# It is smallest, about 1.07, some 0.4 s after a turn begins. The elevator pulls immediately for the commanded 40°,
# while the bank is only at 20°: for a moment the load factor is larger than in the steady turn, whose margin is 1.36
# times the root of cos 40°, 1.19. The right banks end an overshoot: the bank dies out too late, the course swings past
# the leg's, and the aircraft turns back.

# %% [markdown]
# ## 6 Flare
# An approach on a straight slope of 6° at 7 m/s sinks by 0.7 m/s. Landing like that is hard on a light airframe. So
# shortly before the ground the pilot *flares*: the sink rate falls with the height. Let $h$ be the height of the wheels
# above the pad [m], $d$ the way to the aim point [m]:
#
# - **approach**: sink by $V \sin\gamma_g$ (`GLIDE`), less if the aircraft is below the slope, whose height here is
#   $d \tan\gamma_g$: subtract `SLOPE_GAIN` times $(d \tan\gamma_g - h)$. Never climb (sink $\ge 0$), and never sink by
#   more than $V \sin$ `STEEPEST`.
# - **flare**: sink by $s_0 + h / \tau$, with $s_0$ = `COHORT["touch_sink"]` and $\tau$ = `FLARE_TIME`. Below the pad's
#   level ($h < 0$, noise) take $h = 0$. Without $s_0$ it would never arrive: $\dot h = -h/\tau$ is an exponential.
# - Fly whichever sinks **less**. Where that is the flare, the motor shall be idle.
#
# Write `flare`.


# %% exercise="flare"
def flare(height, distance, speed):
    """Vertical speed for approach and flare.

    Use GLIDE [rad], STEEPEST [rad], SLOPE_GAIN [1/s], FLARE_TIME [s], COHORT["touch_sink"] [m/s].

    Args:
        height: h, of the wheels above the pad [m].
        distance: d, along the runway to the aim point [m]; negative beyond it.
        speed: V [m/s].

    Returns:
        (climb_rate, idle): commanded vertical speed [m/s], upward positive, so mostly negative; and
        True in the flare.
    """
    # BEGIN SOLUTION
    too_low = distance * math.tan(GLIDE) - height
    approach = speed * math.sin(GLIDE) - SLOPE_GAIN * too_low
    approach = min(max(approach, 0.0), speed * math.sin(STEEPEST))
    soft = COHORT["touch_sink"] + max(height, 0.0) / FLARE_TIME
    if soft < approach:
        return -soft, True
    return -approach, False
    # END SOLUTION


# %% check="flare"
check(flare)


# %%
def approach_only(height, distance, speed):
    """A pilot who does not flare."""
    too_low = distance * math.tan(GLIDE) - height
    return -max(speed * math.sin(GLIDE) - SLOPE_GAIN * too_low, 0.0), False


class LandingPilot:
    """Down to the pad along its centre line; once in the flare the motor stays idle."""

    def __init__(self, vertical):
        self.vertical, self.idle, self.integral, self.autopilot = vertical, False, 0.0, Autopilot()

    def __call__(self, state):
        """The commanded bank [rad], and the command."""
        p, speed = state.p_world, float(np.linalg.norm(state.v_world))
        bank = guidance(p[:2], state.v_world[:2], AIM - (40.0, 0.0), AIM, 0.5 * BANK_LIMIT)
        climb_rate, flaring = self.vertical(p[2] - PAD_HEIGHT - WHEELS_BELOW, AIM[0] - p[0], speed)
        throttle, self.integral = hold_speed(SPEED - speed, self.integral, GLIDE_THROTTLE)
        self.idle = self.idle or flaring
        rates = turn_rates(bank, state.pitch, speed)
        sticks = self.autopilot.sticks(state, bank, climb_rate, rates)
        return bank, Command.clip(0.0 if self.idle else throttle, *sticks)


# %% figure="landing"
pilots = {"with your flare": flare, "without": approach_only}
start = (PAD_START - 20.0, AIM[1], 1.5)
flights = {
    name: fly(LandingPilot(vertical), start, seed=3, seconds=20.0, pad=LandingPad())
    for name, vertical in pilots.items()
}
draw_landing(flights)
plt.show()
for name, flight in flights.items():
    contact = flight["contact"]
    if contact is None or contact.touchdown is None:
        print(f"{name}: no touchdown, touched {contact.obstacle if contact else 'nothing'}")
    else:
        touch = contact.touchdown
        print(f"{name}: {touch.surface}, {touch.past_threshold:.1f} m past the threshold,", end=" ")
        print(f"sinking {touch.sink_rate:.2f} m/s")

# %% [markdown]
# *In words, for the open course: both landings follow the same slope. Without flare the wheels meet the pad at about
# 0.7 m/s. With flare the path bends over the last 30 cm, and they meet it about 2 m further on, at 0.3 m/s.*
#
# **Question on the figure.** What does the flare cost? Why is the pad met a little faster than `touch_sink`? And what
# happens if the height is measured 10 cm too high? (Try it: add 0.1 in `LandingPilot`.)

# %% [markdown] answer="landing_reading"
# About two metres of the pad. The aircraft responds 0.25 s late: at the pad it still sinks as commanded a little higher
# up. With the height 10 cm too high all of it comes too late: ten landings meet the pad about two metres earlier than
# before, half of them at 0.35 to 0.40 m/s.

# %% [markdown]
# ## 7 Ten landings
# One landing proves little (lab 11). Ten starts, scattered around the paper's: 20 m before the pad, 1.5 m up.

# %%
for seed in range(10):
    contact = fly(LandingPilot(flare), start, seed, 20.0, LandingPad())["contact"]
    touch = contact.touchdown if contact else None
    if touch is None:
        print(f"start {seed}: no touchdown")
    else:
        aside_cm = 100.0 * touch.absolute_lateral_deviation
        print(f"start {seed}: {touch.surface}, {aside_cm:.0f} cm off the centre line,", end=" ")
        print(f"{touch.past_threshold:.1f} m past the threshold, sinking {touch.sink_rate:.2f} m/s")

# %% [markdown]
# ## 8 Build it: an expert that lands from anywhere
# `LandingPilot` began in line with the pad. Now build an expert that lands from two kinds of start, and does not know
# which one comes:
#
# - **straight in**: 17 to 20 m before the threshold, within 2 m of the centre line, heading along +x, 1.3 to 2 m high;
# - **downwind**: beside a long wall, 6.5 to 7.5 m to the left or to the right of the centre line, x from -4 to 6 m, 2 m high,
#   heading along **-x**, away from the pad. It must fly on, turn round (towards the centre line: there is a wall on the other
#   side), line up, and land.
#
# The hall's walls are at x = -22.5 and 17.5 m, y = -12 and 8 m. A landing counts if the wheels first meet the **pad**, not
# its edge, at most 0.8 m off the centre line, sinking at most 0.4 m/s faster than
# `touch_sink`, and with a throttle of 0 in the last command; nothing else may be touched, and after 16 s it is over. One object lands many times,
# with a `reset` before each.
#
# How you build it is up to you: 30 to 80 lines, with modes, helpers, your five functions, and numbers of your own. Only
# the interface is fixed; the class's text states it. `fly_expert` flies it in the kit's world (the given `Autopilot` and
# `turn_rates` of a right answer move the surfaces), `draw_approaches` shows where it went.


# %% exercise="LandingExpert"
class LandingExpert:
    """From a noisy state to what shall be flown, until the wheels meet the pad.

    LandingExpert()       an expert that has not flown yet

    .reset()              a landing begins: whatever was before is forgotten
    .act(state)           20 times a second: (bank, climb_rate, throttle)
        state: measured: p_world (3,) [m], v_world (3,) [m/s], roll, pitch [rad]
        bank: commanded [rad], right wing down positive, at most 60 degrees
        climb_rate: commanded [m/s], upward positive, at most 3 m/s
        throttle: 0..1
    """

    def __init__(self):
        # BEGIN SOLUTION
        self.reset()

    def reset(self):
        """A landing begins."""
        self.mode, self.integral, self.idle = "begin", 0.0, False
        self.turn, self.away_y = 0.0, 0.0  # +1 for a turn to the right; y of the way out [m]

    def act(self, state):
        """Bank [rad], vertical speed [m/s], throttle."""
        p, v = state.p_world, state.v_world
        speed = float(np.linalg.norm(v))
        self.change_mode(p, v)
        climb_rate, base = self.climb_rate(p, speed)
        throttle, self.integral = hold_speed(SPEED - speed, self.integral, base)
        return self.bank(p, v), climb_rate, 0.0 if self.idle else throttle

    def change_mode(self, p, v):
        """begin -> away -> turn -> final, or begin -> final."""
        if self.mode == "begin":
            self.mode = "away" if v[0] < 0.0 else "final"
            self.turn = 1.0 if p[1] < AIM[1] else -1.0  # y is to the left: a turn towards the pad
            self.away_y = AIM[1] - self.turn * 8.3  # nearly at the wall: room for the half circle
        if self.mode == "away" and p[0] < -13.0:
            self.mode = "turn"
        if self.mode == "turn" and v[1] * self.turn > 0.4 * abs(v[0]):
            self.mode = "final"  # the short way round is now the right one

    def bank(self, p, v):
        """Bank of this mode [rad]."""
        steep = math.radians(46.0)
        if self.mode == "away":
            start, end = np.array([20.0, self.away_y]), np.array([-20.0, self.away_y])
            return guidance(p[:2], v[:2], start, end, 0.6 * BANK_LIMIT)
        if self.mode == "turn":
            return self.turn * steep
        near_the_pad = p[2] < 0.7
        limit = 0.25 if near_the_pad else steep
        return guidance(p[:2], v[:2], AIM - (40.0, 0.0), AIM, limit)

    def climb_rate(self, p, speed):
        """Vertical speed of this mode [m/s], and the throttle that it needs."""
        if self.mode != "final":
            return min(max(HEIGHT - p[2], -0.5), 0.5), LEVEL_THROTTLE
        distance = AIM[0] + 2.0 - p[0]  # the turn leaves it below the slope: aim farther
        climb_rate, flaring = flare(p[2] - PAD_HEIGHT - WHEELS_BELOW, distance, speed)
        self.idle = self.idle or flaring
        return climb_rate, GLIDE_THROTTLE
        # END SOLUTION


# %% check="LandingExpert"
check(LandingExpert)

# %%
approaches = [fly_expert(LandingExpert(), kind, seed) for kind in KINDS for seed in (1, 2)]
for flown in approaches:
    print(f"{flown['kind']}: {flown['said']}")
draw_approaches(approaches)
plt.show()

# %% [markdown]
# *In words, for the open course: seen from above, six simulated tracks that all end on the blue pad. Two come straight in;
# two go out along the lower wall and turn to the right, two along the upper wall and turn to the left, each with a half circle
# that ends before the left wall.*
#
# **For those who want more (no points).** How close together do you land? The same 24 straight starts,
# flown by your expert and by the kit's own, which has an observer and optimal gains. Each is measured from the mean of its own
# touchdowns. So few landings leave an uncertainty of some 15 %: below 0.8 you beat it.

# %%
yours, kits = scatter_of(LandingExpert()), scatter_of_the_kit()
print(f"your touchdowns scatter by {yours:.2f} m, the kit's by {kits:.2f} m: {yours / kits:.2f}")

# %% [markdown]
# ## Questions
# **Question 1.** Follow one command: why does the autopilot need *up* elevator in a level turn to the left as in one to
# the right, while aileron and rudder change their sign? Use your `turn_rates`.

# %% [markdown] answer="q1"
# A left turn has $\phi < 0$ and $\dot\psi < 0$. $q = \dot\psi \sin\phi \cos\theta$ is a product of two numbers that
# both change sign: it stays positive. The nose must be pulled up relative to the wings on both sides, against pitch
# damping; and the larger lift ($n > 1$) needs more angle of attack, again up elevator. $r = \dot\psi \cos\phi
# \cos\theta$ and $p = -\dot\psi \sin\theta$ change sign with $\dot\psi$, and so do rudder and aileron.

# %% [markdown]
# **Question 2.** Commands arrive 50 ms late, and the aircraft answers after another 0.2 to 0.3 s. What would happen
# with `TURN_GAIN` = 5 instead of 1.8? And where would a delay of another 100 ms show first: in your functions, or in
# `Autopilot` below them? (Try both: `TURN_GAIN = 5.0` in a cell of its own, and `delay=0.15` in the `SimulatedWorld` of
# `fly`. Then put them back.)

# %% [markdown] answer="q2"
# The course loop may be no faster than the bank loop inside it. With a gain of 5 /s it would correct a course error
# within 0.2 s, but the bank follows only after about 0.35 s: the aircraft is still banked when the error has gone,
# turns too far, and weaves with the bank going from limit to limit. A rule of thumb: gain times delay well below 1 (1.8
# times 0.35 s = 0.6; 5 times 0.35 s = 1.75). Another 100 ms shows first in the fastest loops, those of `Autopilot`: the
# bank overshoots to 60°, the stall margin falls below 1, the circuit ends in a wall, and some touchdowns are as hard
# as without flare.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
# You have an expert: it shows a learner what to do in each state (lab 8). The kit's own expert, in
# `falconwing_kit/control/expert.py`, follows curved paths with optimal gains and an observer; try
# `falconwing fly --task landing --pilot expert --trials 10` and compare with your ten.
#
# **With hardware.** On the bench, propeller off: replay the aileron and elevator of your circuit through the trainer
# port (`falconwing bridge`, lab 10) and film the surfaces. Do they move the right way in a left turn? Hand in the film
# and the checklist: propeller off, transmitter on first, throttle cut tested.
