# %% [markdown]
# # Lab 4: the aircraft model
#
# ![A turn from above that lies on its circle in still air and drifts out of the hall in wind; height, speed and bank over time](goal.webp)
#
# *What you will have at the end (open course).*
#
# In this lab you write the model that the rest of the course flies: a state of nine numbers (position, attitude and
# velocity), and the physics that advances it by one twentieth of a second.
#
# **You will be able to**
# - say why the air, not the ground, makes the forces, and compute angle of attack and sideslip in a wind,
# - write lift, drag, side force and thrust in body axes,
# - turn forces and body rates into the rate of change of the state, and integrate it by Runge-Kutta,
# - find the control inputs of a steady climb (trim), and fly a turn that fits, or does not fit, into the hall.
#
# **Time:** about 3 hours. **Before:** lab 1 (speed and turn radius), lab 2 (frames). Everything here is *simulated*:
# the coefficients are those of a 150 g aircraft, no aircraft has been measured for them.
#
# Run the cells from top to bottom. A cell `check(...)` reports what already works.

# %%
import matplotlib.pyplot as plt
import numpy as np

# %%
from given import (
    BLUE,
    DOWN_THRUST,
    GRAVITY,
    GREEN,
    GREY,
    ORANGE,
    K,
    body_rates,
    hall_axes,
    moving_wind,
    pilot,
    rotation_world_body,
    vertical_flight,
)

from falconwing_kit.tools.grading import borrow, check, keep_going

keep_going()  # a missing function stops only the cells that need it
moving_wind()

# %% [markdown]
# *In words: from above, a hall in which the air drifts towards +y, upwards in the picture; dots drift with it, and so does
# a dotted circle. The aircraft flies round this circle. Its track over the ground is no circle, and after one round it is beyond
# the wall.*

# %% [markdown]
# ## 1. What the aircraft feels: the air
#
# The paper's state (Section IV-B) is
#
# $$x = [p_x, p_y, p_z,\ \text{pitch},\ \text{yaw},\ \text{roll},\ v_x, v_y, v_z]$$
#
# Position and velocity are in the world (x along the runway, y left, **z up**), angles in rad: roll positive right
# wing down, pitch nose up, yaw nose right.
#
# The aerodynamic forces depend on the velocity *through the air*, not over the ground. In body axes (x nose, y right
# wing, z belly) it is
#
# $$(u, v, w) = R_{\text{world,body}}^T\ (v_{\text{world}} - w_{\text{world}})$$
#
# where $w_{\text{world}}$ is the wind: the velocity of the air. From it follow
#
# $$V = \sqrt{u^2+v^2+w^2}, \qquad \alpha = \operatorname{atan2}(w, u), \qquad \beta = \arcsin(v / V)$$
#
# ```text
#      side view                          from above
#            nose                            nose
#           /                                 |  /
#          /  ) alpha                         | /  beta > 0: the air comes
#         /________ path through the air      |/   from the right
# ```


# %% exercise="air_data"
def air_data(state, wind_world):
    """Airspeed and flow angles of an aircraft in a wind.

    Args:
        state: (9,) px, py, pz [m], pitch, yaw, roll [rad], vx, vy, vz [m/s], world axes.
        wind_world: (3,) velocity of the air in the world [m/s].

    Returns:
        (3,) airspeed V [m/s], angle of attack alpha [rad], sideslip beta [rad].

    `rotation_world_body(roll, pitch, yaw)` of given.py is lab 2's; note the order of the angles.
    """
    # BEGIN SOLUTION
    pitch, yaw, roll = state[3:6]
    R_world_body = rotation_world_body(roll, pitch, yaw)
    u, v, w = R_world_body.T @ (state[6:9] - wind_world)
    V = np.sqrt(u**2 + v**2 + w**2)
    return np.array([V, np.arctan2(w, u), np.arcsin(v / V)])
    # END SOLUTION


# %% check="air_data"
check(air_data)

# %% [markdown]
# ## 2. Forces
#
# All forces are **per unit mass**, so they are accelerations [m/s²]. (Poses alone cannot distinguish a heavy aircraft
# with a large wing from a light one with a small wing.) With $c = c_{L_0} + c_{L_\alpha}\,\alpha$,
# and $c_{D_i}$ for `cD_induced`:
#
# | force | size | direction in body axes |
# |---|---|---|
# | lift | $V^2 c$ | $(\sin\alpha,\ 0,\ -\cos\alpha)$: at right angles to the path, up |
# | drag | $V^2 (c_{D_0} + c_{D_i}\,c^2)$ | against the path $(\cos\alpha\cos\beta,\ \sin\beta,\ \sin\alpha\cos\beta)$ |
# | side force | $V^2 c_{Y_\beta}\,\beta$, with $c_{Y_\beta} < 0$ | along y, the right wing |
# | thrust | $(k_T - k_{TV} V)\cdot$ throttle | along the propeller's axis |
#
# One thing is special about *this* aircraft: as on many models, the propeller's axis points **down in front** by a few
# degrees (`DOWN_THRUST`, in rad, from given.py; it differs from course to course). The axis is
# $(\cos\tau,\ 0,\ \sin\tau)$, because body z points to the belly.


# %% exercise="body_force"
def body_force(air, command, K):
    """Sum of lift, drag, side force and thrust.

    Args:
        air: (3,) airspeed V [m/s], angle of attack alpha [rad], sideslip beta [rad].
        command: (4,) throttle 0..1, aileron, elevator, rudder -1..1; only the throttle makes a
            force here.
        K: the aircraft's numbers by name: cL_0, cL_alpha, cD_0, cD_induced, cY_beta, kT, kTV.

    Returns:
        (3,) force per unit mass in body axes [m/s^2]; gravity is not a part of it.
    """
    # BEGIN SOLUTION
    V, alpha, beta = air
    c = K["cL_0"] + K["cL_alpha"] * alpha
    lift = V**2 * c * np.array([np.sin(alpha), 0.0, -np.cos(alpha)])
    path = np.array([np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)])
    drag = -(V**2) * (K["cD_0"] + K["cD_induced"] * c**2) * path
    side = np.array([0.0, V**2 * K["cY_beta"] * beta, 0.0])
    axis = np.array([np.cos(DOWN_THRUST), 0.0, np.sin(DOWN_THRUST)])
    thrust = (K["kT"] - K["kTV"] * V) * command[0] * axis
    return lift + drag + side + thrust
    # END SOLUTION


# %% check="body_force"
check(body_force)

# %% [markdown]
# ## 3. From forces to the rate of change of the state
#
# - Position moves with the velocity.
# - Velocity changes by the force, **turned into the world**, and by gravity: $-g$ along world z.
# - The angles change by the body rates $p$ (roll), $q$ (pitch), $r$ (yaw), which are measured along the
#   body's own axes. A gyro in a banked aircraft that pulls up shows $q$, but the nose also moves sideways. So
#
# $$\dot\phi = p + (q\sin\phi + r\cos\phi)\tan\theta, \quad
#   \dot\theta = q\cos\phi - r\sin\phi, \quad
#   \dot\psi = \frac{q\sin\phi + r\cos\phi}{\cos\theta}$$
#
# with $\phi$ roll, $\theta$ pitch, $\psi$ yaw. (Beard & McLain, *Small Unmanned Aircraft*, ch. 3.)


# %% exercise="state_rate"
def state_rate(state, force_body, rates_body):
    """Rate of change of the nine states.

    Args:
        state: (9,) px, py, pz [m], pitch, yaw, roll [rad], vx, vy, vz [m/s], world axes.
        force_body: (3,) force per unit mass in body axes [m/s^2], without gravity.
        rates_body: (3,) p, q, r [rad/s].

    Returns:
        (9,) the time derivative of the state, in the order of the state: pitch, yaw, roll.
    """
    # BEGIN SOLUTION
    pitch, yaw, roll = state[3:6]
    p, q, r = rates_body
    across = q * np.sin(roll) + r * np.cos(roll)
    pitch_dot = q * np.cos(roll) - r * np.sin(roll)
    yaw_dot = across / np.cos(pitch)
    roll_dot = p + across * np.tan(pitch)
    gravity = np.array([0.0, 0.0, GRAVITY])
    acceleration = rotation_world_body(roll, pitch, yaw) @ force_body - gravity
    return np.concatenate([state[6:9], [pitch_dot, yaw_dot, roll_dot], acceleration])
    # END SOLUTION


# %% check="state_rate"
check(state_rate)

# %% [markdown]
# ## 4. One step ahead: $f_K$
#
# The paper's model is discrete, $x_{t+1} = f_K(x_t, u_t)$, with a step of 0.05 s. Runge-Kutta's fourth-order method
# evaluates the slope four times within the step. Here the control inputs **change linearly** from `u_now` to `u_next`
# during the step, so the slopes in its middle use their mean:
#
# $$k_1 = f(x, u_{now}),\quad k_2 = f(x + \tfrac{h}{2}k_1, \bar u),\quad k_3 = f(x + \tfrac{h}{2}k_2, \bar u),\quad
#   k_4 = f(x + h k_3, u_{next})$$
# $$x_{next} = x + \tfrac{h}{6}(k_1 + 2k_2 + 2k_3 + k_4)$$


# %% exercise="rk4_step"
def rk4_step(rate, x, u_now, u_next, dt):
    """One Runge-Kutta step with inputs that change linearly.

    Args:
        rate: function (x, u) -> dx/dt.
        x: (n,) state at the beginning.
        u_now: (m,) input at the beginning.
        u_next: (m,) input at the end.
        dt: length of the step [s].

    Returns:
        (n,) state at the end. x itself is left as it was.
    """
    # BEGIN SOLUTION
    u_mid = 0.5 * (u_now + u_next)
    k1 = rate(x, u_now)
    k2 = rate(x + 0.5 * dt * k1, u_mid)
    k3 = rate(x + 0.5 * dt * k2, u_mid)
    k4 = rate(x + dt * k3, u_next)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    # END SOLUTION


# %% check="rk4_step"
check(rk4_step)

# %% [markdown]
# How good is it? The error after one second of flight in a vertical plane falls with the fourth power of the step: half
# the step, about a sixteenth of the error. ("Exact" here means a hundred times finer steps.)


# %% tags=["rk4-order"]
def fly_one_second(dt):
    """Where the point is after one second, the lift slowly rising: distance and height [m]."""
    x, steps = np.array([7.0, 0.0, 0.0, 2.0]), round(1.0 / dt)
    lift = 0.18 + 0.05 * np.arange(steps + 1) / steps
    for k in range(steps):
        x = rk4_step(vertical_flight, x, np.array([2.0, lift[k]]), np.array([2.0, lift[k + 1]]), dt)
    return x[2:]


exact = fly_one_second(0.0005)
for dt in (0.2, 0.1, 0.05):
    error = np.linalg.norm(fly_one_second(dt) - exact)
    print(f"step {dt:4.2f} s: error {1e6 * error:8.3f} micrometres")

# %% [markdown]
# ## 5. Trim: the control inputs of a steady climb
#
# In a steady, straight, wings-level climb at angle $\gamma$ all forces balance. Along the path and at right angles to
# it (draw the picture!), with thrust $T$ per unit mass and $\tau$ the down-thrust:
#
# $$T\cos(\alpha - \tau) = D + g\sin\gamma, \qquad L + T\sin(\alpha - \tau) = g\cos\gamma$$
#
# and the pitch rate, in this model $q = V (M_0 + M_{\delta_e}\,\text{elevator} + M_\alpha\,\alpha)$ and no moment, is zero. The second equation has
# $\alpha$ in $L$, and weakly in $D$ and $T$. So guess $\alpha$, compute $T$, solve for a better $\alpha$, and repeat
# until it stays: each round makes the error about twenty times smaller.


# %% exercise="trim"
def trim(airspeed, climb_angle, K):
    """Angle of attack and control inputs of a steady straight climb, wings level, no wind.

    Args:
        airspeed: V [m/s].
        climb_angle: gamma [rad], positive upward.
        K: the aircraft's numbers: cL_0, cL_alpha, cD_0, cD_induced, kT, kTV, M_0, M_de, M_alpha.

    Returns:
        (3,) angle of attack [rad], throttle [-], elevator [-], not limited to their range.
    """
    # BEGIN SOLUTION
    V, alpha = airspeed, 0.0
    for _ in range(60):
        c = K["cL_0"] + K["cL_alpha"] * alpha
        drag = V**2 * (K["cD_0"] + K["cD_induced"] * c**2)
        thrust = (drag + GRAVITY * np.sin(climb_angle)) / np.cos(alpha - DOWN_THRUST)
        lift = GRAVITY * np.cos(climb_angle) - thrust * np.sin(alpha - DOWN_THRUST)
        alpha = (lift / V**2 - K["cL_0"]) / K["cL_alpha"]
    throttle = thrust / (K["kT"] - K["kTV"] * V)
    elevator = -(K["M_0"] + K["M_alpha"] * alpha) / K["M_de"]
    return np.array([alpha, throttle, elevator])
    # END SOLUTION


# %% check="trim"
check(trim)

# %% [markdown]
# ## 6. Fly a turn
#
# All parts together, with a simple pilot from given.py who holds 30 degrees of bank and a height of 2 m. Lab 1's
# equation says that a level turn at 7 m/s has the radius $R = V^2 / (g\tan 30°) = 8.7$ m (paper, appendix), too large
# for a hall 20 m wide with a distance to the walls. The figure compares your flight with that circle,
# and shows the same flight in a wind of 0.8 m/s from the right wall, which the pilot does not measure.


# %% figure="turn"
def aircraft_rate(state, command, wind_world):
    """dx/dt of the whole model, from your functions."""
    air = air_data(state, wind_world)
    return state_rate(state, body_force(air, command, K), body_rates(air, command, K))


def fly_turn(bank, wind_world, seconds=11.0, dt=0.05):
    """(N, 9) states of a flight that begins straight and then turns."""
    level = trim(7.0, 0.0, K)
    state = np.array([-8.0, 8.7, 2.0, level[0], 0.0, 0.0, 7.0, 0.0, 0.0])
    flown, command = [state], pilot(state, 0.0, level)
    for _ in range(round(seconds / dt)):
        after = pilot(state, bank, level)
        state = rk4_step(lambda x, u: aircraft_rate(x, u, wind_world), state, command, after, dt)
        command = after
        flown.append(state)
    return np.array(flown)


still = fly_turn(np.radians(30.0), np.zeros(3))
windy = fly_turn(np.radians(30.0), np.array([0.0, 0.8, 0.0]))
speed = np.linalg.norm(still[:, 6:], axis=1)
bank = still[100:, 5].mean()
radius = np.mean(speed[100:]) ** 2 / (GRAVITY * np.tan(bank))
centre = 0.5 * (still[100:, :2].max(axis=0) + still[100:, :2].min(axis=0))

figure, (above, side) = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=[1.5, 1])
hall_axes(above, "From above (simulated)")
around = np.linspace(0.0, 2.0 * np.pi, 200)
circle = centre[:, None] + radius * np.array([np.cos(around), np.sin(around)])
above.plot(*circle, color=GREY, ls=":", lw=3, label=f"circle of lab 1, R = {radius:.1f} m")
above.plot(still[:, 0], still[:, 1], color=BLUE, label="your model, still air")
above.plot(windy[:, 0], windy[:, 1], color=ORANGE, ls="--", label="your model, wind 0.8 m/s")
above.plot(*still[0, :2], "o", color=GREEN, label="start")
above.legend(fontsize=8, loc="lower right")
t = 0.05 * np.arange(len(still))
side.plot(t, still[:, 2], color=BLUE, label="height [m]")
side.plot(t, speed, color=ORANGE, ls="--", label="speed [m/s]")
side.plot(t, np.degrees(still[:, 5]) / 10.0, color=GREEN, ls="-.", label="bank [10 deg]")
side.set(xlabel="time [s]", ylabel="see legend", title="The flight in still air")
side.legend(fontsize=8)
figure.tight_layout()
plt.show()
print(f"bank held {np.degrees(bank):.1f} deg at {np.mean(speed[100:]):.2f} m/s")
print(f"R = V^2 / (g tan bank) = {radius:.2f} m")

# %% [markdown]
# *In words:* left, the hall from above with a dotted circle; the solid track of the flight in still air lies on it, the
# dashed one of the flight in wind leaves it towards +y, upwards in the picture, like a spring pulled out. Right, height, speed and bank over
# time: all three settle within about two seconds.
#
# **Question on the figure.** How far does the flight in the wind drift in one round, and which way? Compare with the
# wind times the time of a round. (What does the pilot's throttle in given.py hold, the speed through the air or over
# the ground?)

# %% [markdown] answer="turn_reading"
# About 4 m towards +y, with the wind, in a round of 7.5 s, and a metre or so back along the runway; the track leaves
# the hall. The wind alone would carry it 0.8 m/s times 7.5 s, 6 m. It is less, since the pilot holds the speed over
# the ground: throttle off with the wind behind, on against it. So he flies faster through the air when he flies against
# the wind, and wins some of it back.

# %% [markdown]
# ## Questions
#
# **Question 1.** Read `pilot` in given.py: why does a turn need more throttle and more elevator than straight flight at the same
# speed? Use the words *lift* and *induced drag*, and the factor $1/\cos\phi$.

# %% [markdown] answer="q1"
# In a level turn at bank $\phi$ the vertical part of the lift, $L\cos\phi$, carries the weight, so the lift must be
# $1/\cos\phi = 1.15$ times as large. At the same speed that takes a larger angle of attack, hence more elevator (the
# pitch stiffness $M_\alpha$ acts nose down, and the turn itself needs a steady pitch rate). Induced drag grows
# with the square of the lift, by a third at 30 degrees, so the same speed takes more throttle.

# %% [markdown]
# **Question 2.** In the wind the track over the ground is no circle any more. Has the turn through the *air* changed?
# How do you see that in `air_data`, and what does it mean for a pilot who may not come nearer than 2 m to a wall?

# %% [markdown] answer="q2"
# No: the forces depend only on the velocity through the air, which `air_data` forms by subtracting the wind. Flown
# with a steady speed through the air, it is the same circle for a balloon that drifts with the wind. Over the ground
# it moves with the wind, 0.8 m every second, 6 m in one round of 7.5 s (here 4 m, as the pilot holds the speed over the
# ground). The pilot must steepen the bank where the wind carries towards the wall, or aim the circle upwind; a hall
# 20 m wide has only 1 m to spare beside an 8.7 m circle anyway.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
#
# You have the nine-state model of the paper, and you know what each number in it does. In lab 5 the numbers become
# unknown, and you find them from logs.
#
# **With hardware:** film a hand launch without power (a glide test) from the side, with a metre rule in the picture.
# Read speed and glide angle off three frames. For which negative climb angle does `trim` return the throttle 0 at this speed?
# Compare it with the glide angle. Propeller off, two people, soft ground, no one in front.
