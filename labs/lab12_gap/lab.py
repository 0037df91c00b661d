# %% [markdown]
# # Lab 12: what is missing in the model?
#
# ![A real flight: its velocities as two rings, of which one is moved by the hidden wind, and two laps from above](goal.webp)
#
# *What you will have at the end (open course).*
#
# You get two flights of the same aircraft. On the first, the *baseline* flight (file `calm.csv`, arguments `calm_...`),
# the model is right. On the second, on another day, **something may have been different**: a wind, a broken aileron, a
# slow radio, or nothing at all. Every student has another answer. Detect it, name it, estimate its size, add it to the
# model, and show that the gap between model and flight closes. *None* is a valid answer and is worth as much.
#
# **You will be able to**
# - show *where* a model is wrong, against the level of a flight where it is right,
# - write an effect as a term that plugs into the model,
# - compare candidates, while the aircraft's own parameters stay uncertain,
# - decide by a rule that you fixed before you looked, and give a size with an interval,
# - hide a known effect in a *real* flight without a simulator, and find it again.
#
# **Time:** about 4.5 hours. **Before:** lab 5 (residuals, windows, Gauss-Newton). The flights of sections 1 to 7 are
# *simulated* by the kit, with the noise of marker poses (3 cm, 0.6 degrees), some bad frames and some missing ones.
#
# **Your own flights:** put the `calm.csv` and `flight.csv` that you were given into `data/mine/`. Without them the
# notebook works on a practice case in `data/`.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from given import (
    CANDIDATES,
    CAUTION,
    CUSHION_M,
    LEAST_GAIN,
    LOADS,
    draw_evidence,
    draw_gap,
    draw_map,
    lap_numbers,
    rows_of,
    velocities,
)

from falconwing_kit import sysid
from falconwing_kit.aircraft import CATALOGUE, Parameter, Term
from falconwing_kit.core import read_flight_table
from falconwing_kit.data import load_flight
from falconwing_kit.sysid import fit, residuals, score, uncertainty
from falconwing_kit.tools.grading import check

folder = Path("data/mine") if Path("data/mine/flight.csv").exists() else Path("data")
calm_table, table = (read_flight_table(folder / name) for name in ("calm.csv", "flight.csv"))
print(f"{folder}: baseline {calm_table.duration:.0f} s, flight under test {table.duration:.0f} s")

# %%
from given import moving_flights

from falconwing_kit.tools.grading import borrow, keep_going

keep_going()  # a missing function stops only the cells that need it
moving_flights(folder)

# %% [markdown]
# *In words: left, two aircraft circle in the hall on tracks of their own, one dashed (baseline), one solid (under test); right,
# their heights, with a spike where a frame was bad. Whether anything is different cannot be seen by eye.*

# %% [markdown]
# ## 1. The nominal model
# The kit identifies the baseline flight as you did in lab 5, in three dimensions with 29 parameters. Then the flight
# under test is cut into windows of two seconds and fitted **with the nominal model's parameters as prior**: an aircraft
# is not quite the same on another day, so each parameter may drift by 1 % on top of its uncertainty.
#
# Without a prior the 29 parameters would *absorb* most effects: more drag here, less aileron there, nothing missing.

# %%
found = sysid.identify([calm_table])
calm_model = found.model
confidence = uncertainty(found.result, found.fitted_windows)
starts_at = {p.name: p.start for p in calm_model.parameters}
drift = np.array(
    [0.01 * max(abs(calm_model.values[n]), abs(starts_at[n]), 0.1) for n in confidence.names]
)
drift[[confidence.names.index("delay"), confidence.names.index("lag")]] = 0.002  # s
covariance = confidence.covariance + np.diag(drift**2)
precision, sigma = np.linalg.inv(covariance), np.sqrt(np.diag(covariance))
spread = dict(zip(confidence.names, sigma.tolist(), strict=True))
prior = sysid.Prior(dict(calm_model.values), spread, covariance / np.outer(sigma, sigma))

prepared = sysid.prepare(table, found.sigma)
windows = sysid.cut_windows(prepared.flights, calm_model, 2.0)
initial_states, _ = sysid.fit_initial_states(
    calm_model, windows, windows.initial_guess[:, : calm_model.n_states]
)
before = fit(calm_model, windows, initial_states, prior=prior)
scatter = max(1.0, found.train.chi2)
print(f"chi2 per degree of freedom in the nominal model: baseline {found.train.chi2:.2f}, "
      f"flight under test {score(calm_model, windows).chi2:.2f}")  # fmt: skip


# %% [markdown]
# ## 2. Where does it disagree?
# Replay both flights in the nominal model. Residuals are in units of the noise, so their mean square is 1 where only noise
# is left. For each of the six channels (px, py, pz, roll, pitch, yaw) and each bin of some variable, take the mean
# square of the flight **minus that of the baseline flight in the same bin**: an excess, in squared sigmas. A bin with
# fewer than `fewest` measured values, on either flight, is nan.


# %% exercise="residual_map"
def residual_map(residual, variable, calm_residual, calm_variable, edges, fewest):
    """Excess of a flight's mean square residual over the baseline's, by channel and bin.

    Args:
        residual: (N, C) in sigmas, nan where not measured.
        variable: (N,) what the rows are sorted by, such as the height.
        calm_residual: (M, C) the same of the baseline flight.
        calm_variable: (M,).
        edges: (B + 1,) of the bins, increasing. A value on an inner edge belongs to the bin above
            it; one on the last edge to the last bin; values outside belong to none.
        fewest: measured values that a bin needs, in each channel on both flights.

    Returns:
        (C, B) excess, nan where there are too few.
    """

    # BEGIN SOLUTION
    def mean_square(values, at):
        channels = []
        for x in values.T:
            seen = np.isfinite(x)
            count, _ = np.histogram(at[seen], edges)
            total, _ = np.histogram(at[seen], edges, weights=x[seen] ** 2)
            channels.append(np.where(count >= fewest, total / np.maximum(count, 1), np.nan))
        return np.array(channels)

    return mean_square(residual, variable) - mean_square(calm_residual, calm_variable)
    # END SOLUTION


# %% check="residual_map"
check(residual_map)


# %% figure="map"
residual, variables = rows_of(score(calm_model, windows, before.initial_states).residual, windows)
calm_residual, calm_variables = rows_of(score(calm_model, found.windows).residual, found.windows)
maps = {}
for label, values in variables.items():
    even = np.quantile(values[values != 0.0], np.linspace(0.0, 1.0, 7))  # as many rows in each bin
    edges = np.linspace(-180.0, 180.0, 7) if "deg" in label else even
    excess = residual_map(residual, values, calm_residual, calm_variables[label], edges, 30)
    maps[label] = edges, excess
figure, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
image = draw_map(axes, maps)
figure.suptitle("Residual map: mean square over that of the baseline (simulated)")
figure.colorbar(image, ax=list(axes), label="excess [sigma²]")
plt.show()

# %% [markdown]
# *In words:* four tables side by side, one for each variable; rows are the channels, columns the bins, dark cells with
# white numbers are where the flight disagrees most.
#
# **Question on the figure.** Which cells stand out, if any? Write down your guess *now*, before any statistics.

# %% [markdown] answer="map_reading"
# On the practice case the two lowest bins of the height stand out, in px and py and less in pitch and yaw; above 1.4 m
# hardly more than 0.2 is left in px and py. The lowest throttle stands out too. My guess: something near the floor.

# %% [markdown]
# ## 3. An effect is a term
# The model is a sum of terms. An effect is one more. Five of the candidates are loads, a force (X, Y, Z) and a moment
# (L, M, N) per unit mass and inertia in body axes (x nose, y right, z belly). With the size $s$, the direction of the
# path $\hat v = (\cos\alpha\cos\beta, \sin\beta, \sin\alpha\cos\beta)$ and that of the lift
# $\hat l = (\sin\alpha, 0, -\cos\alpha)$:
#
# | effect | adds |
# |---|---|
# | `extra_drag` | force $-s V^2\,\hat v$ |
# | `thrust_loss` | force $-s \cdot$ thrust along x |
# | `ground_effect` | with $n = s\,e^{-h/h_0}$: lift $n V^2 c\,\hat l$, less induced drag $n V^2 c_{Di} c^2\,\hat v$ |
# | `aileron_loss` | rolling moment $-s V^2 L_a\,\text{aileron}$ |
# | `adverse_yaw` | yawing moment $-s V^2\,\text{aileron}$ |
#
# $h_0$ is `CUSHION_M` of given.py: near the floor the air under the wing cannot get away.


# %% exercise="augment_model"
def augment_model(loads, flow, K, effect, size):
    """The loads of the model with one effect added.

    Args:
        loads: (6, N) X, Y, Z [m/s^2] and L, M, N [rad/s^2] without the effect.
        flow: by name, each (N,): V [m/s], alpha, beta [rad], height [m], c lift over V^2 [1/m],
            thrust [m/s^2], aileron [-].
        K: the aircraft's parameters: cD_induced [m], L_da [1/m^2].
        effect: one of LOADS, or "none".
        size: of the effect, in the unit given in CANDIDATES of given.py.

    Returns:
        (6, N) the loads with the effect; what came in is left as it was.
    """
    # BEGIN SOLUTION
    V, alpha, beta, c = flow["V"], flow["alpha"], flow["beta"], flow["c"]
    path = np.array([np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)])
    lift = np.array([np.sin(alpha), 0.0 * alpha, -np.cos(alpha)])
    added = np.zeros_like(loads)
    if effect == "extra_drag":
        added[:3] = -size * V**2 * path
    elif effect == "thrust_loss":
        added[0] = -size * flow["thrust"]
    elif effect == "ground_effect":
        near = size * np.exp(-flow["height"] / CUSHION_M)
        added[:3] = near * V**2 * (c * lift + K["cD_induced"] * c**2 * path)
    elif effect == "aileron_loss":
        added[3] = -size * V**2 * K["L_da"] * flow["aileron"]
    elif effect == "adverse_yaw":
        added[5] = -size * V**2 * flow["aileron"]
    return loads + added
    # END SOLUTION


# %% check="augment_model"
check(augment_model)

# %% [markdown]
# Your function goes into the kit's model as a `Term`. Effects on wind or control inputs come from the kit's catalogue.


# %% tags=["plug"]
def own_term(effect):
    """Your `augment_model` as a term of the kit's model."""

    def evaluate(air, K):
        c = K.cL_0 + K.cL_alpha * air.alpha + K.cL_de * air.elevator
        thrust = (K.kT - K.kTV * air.airspeed) * air.throttle
        flow = {"V": air.airspeed, "alpha": air.alpha, "beta": air.beta, "c": c, "thrust": thrust,
                "height": np.maximum(air.height, 0.0), "aileron": air.aileron}  # fmt: skip
        shape = np.broadcast_shapes(*(np.shape(part) for part in flow.values()), np.shape(K.size))
        flow = {name: np.broadcast_to(part, shape) for name, part in flow.items()}
        return tuple(augment_model(np.zeros((6, *shape)), flow, K._asdict(), effect, K.size))

    return Term(
        effect, (Parameter("size", 0.0, -1.0, 5.0, "-", CANDIDATES[effect].meaning),), evaluate
    )


def with_candidate(model, name):
    """The model with a candidate at size zero; where the kit's has more parameters, they stay zero."""
    amplitudes = CANDIDATES[name].amplitudes
    if name in LOADS:
        return model.with_terms(own_term(name))
    effects = (e for e in CATALOGUE if e.name == name)
    effect = next(e for e in effects if amplitudes[0] in {p.name for p in e.parameters})
    model = model.with_effect(effect).with_values({p.name: 0.0 for p in effect.parameters})
    return model.with_fixed([p.name for p in effect.parameters if p.name not in amplitudes])


def columns_of(name, fitted, windows):
    """(W, R, A) sensitivity of the residuals to the size, initial states projected out."""
    model, step = with_candidate(fitted.model, name), CANDIDATES[name].step
    moved = [model.with_values({amplitude: step}) for amplitude in CANDIDATES[name].amplitudes]
    moved = np.stack([residuals(one, windows, fitted.initial_states) for one in moved], axis=-1)
    change, (Q, _) = (
        (moved - fitted.residual[..., None]) / step,
        np.linalg.qr(fitted.initial_state_jacobian),
    )
    return change - Q @ (Q.transpose(0, 2, 1) @ change)


# %% [markdown]
# ## 4. How much would each candidate explain?
# Near the fit everything is linear: residuals $r + J\,\Delta K + E\,s$ with the candidate's sensitivities $E$. The 29
# parameters stay free under their prior: with $a$ = present $K$ minus the prior's, and $P$ the inverse of the prior's covariance
# (the baseline flight determines some combinations of parameters much better than each alone), minimise
#
# $$\chi^2 = \lVert r + J\,\Delta K + E\,s\rVert^2 + (a + \Delta K)^T P\,(a + \Delta K)$$
#
# once without the candidate ($s = 0$, only $\Delta K$ free) and once with it. The **gain** is the difference, in units
# of `scatter` (the baseline's $\chi^2$ per degree of freedom), **less a complexity penalty** of $\ln M$ for each number in
# $s$, with $M$ the number of residuals: more parameters explain more by chance (BIC, Schwarz 1978). It approximates twice
# the log Bayes factor of the candidate.


# %% exercise="score_candidates"
def score_candidates(r, J, away, precision, candidates, scatter):
    """Evidence for each candidate, and the size that it would have.

    Args:
        r: (M,) weighted residuals at the fit without candidates.
        J: (M, F) their derivatives to the aircraft's parameters.
        away: (F,) the parameters at the fit minus those of the prior.
        precision: (F, F) P, the inverse of the prior's covariance.
        candidates: by name, (M, A) derivatives to the A numbers of the candidate's size.
        scatter: chi2 per degree of freedom of the baseline flight.

    Returns:
        by name, (1 + A,): the gain, then the size.
    """
    # BEGIN SOLUTION
    F = J.shape[1]

    def gained(columns):
        normal, gradient = columns.T @ columns, columns.T @ r
        normal[:F, :F] += precision
        gradient[:F] += precision @ away
        step = -np.linalg.solve(normal, gradient)
        return -gradient @ step, step[F:]

    without, _ = gained(J)
    answer = {}
    for name, E in candidates.items():
        chi2, size = gained(np.hstack([J, E]))
        gain = (chi2 - without) / scatter - E.shape[1] * np.log(len(r))
        answer[name] = np.concatenate([[gain], size])
    return answer
    # END SOLUTION


# %% check="score_candidates"
check(score_candidates)

# %% [markdown]
# The same on three thirds of the baseline flight, where nothing is hidden: this is what *chance* finds.


# %% tags=["scan"]
def scan(fitted, windows, rows, away):
    """Evidence of every candidate over some windows."""
    J, r = fitted.reduced_jacobian[rows], fitted.residual[rows].ravel()
    columns = {name: columns_of(name, fitted, windows)[rows] for name in CANDIDATES}
    flat = {name: part.reshape(len(r), -1) for name, part in columns.items()}
    return score_candidates(r, J.reshape(len(r), -1), away, precision, flat, scatter)


away = np.array([before.model.values[name] - prior.mean[name] for name in confidence.names])
scores = scan(before, windows, np.arange(len(windows)), away)
gains = {name: float(found_here[0]) for name, found_here in scores.items()}
thirds = np.array_split(np.arange(len(found.fitted_windows)), 3)
by_chance = [
    scan(found.result, found.fitted_windows, third, np.zeros(len(away))) for third in thirds
]
calm_gains = np.array([max(one[0] for one in third.values()) for third in by_chance])
for name, (gain, *size) in sorted(scores.items(), key=lambda pair: -pair[1][0]):
    print(f"{name:14} gain {gain:8.1f}   size {np.round(size, 4)} {CANDIDATES[name].size}")
print("best by chance on thirds of the baseline flight:", np.round(calm_gains, 1))

# %% [markdown]
# ## 5. Decide
# The rule, fixed beforehand: the threshold is `CAUTION` times the largest gain that chance found, and at least
# `LEAST_GAIN`. If no candidate is above it, the answer is **none**. If the best is above it, everything within less
# than `LEAST_GAIN` of the best is as good: one name is **named**, several are **ambiguous** and need another flight.


# %% exercise="verdict"
def verdict(gains, calm_gains):
    """What may be said.

    Args:
        gains: evidence by candidate.
        calm_gains: (B,) the best evidence on each part of the baseline flight; may be negative.

    Returns:
        threshold; "none", "named" or "ambiguous"; a tuple of the names, best first, or empty.
        CAUTION and LEAST_GAIN are those of given.py.
    """
    # BEGIN SOLUTION
    threshold = max(LEAST_GAIN, CAUTION * float(np.max(calm_gains)))
    ranked = sorted(gains, key=lambda name: -gains[name])
    best = gains[ranked[0]]
    if best <= threshold:
        return threshold, "none", ()
    names = tuple(name for name in ranked if gains[name] > best - LEAST_GAIN)
    return threshold, "named" if len(names) == 1 else "ambiguous", names
    # END SOLUTION


# %% check="verdict"
check(verdict)

# %% [markdown]
# ## 6. Add it, fit it, and look at the gap
# The scan was linear. Now the best candidate goes into the model and everything is fitted again, to two thirds of the
# flight. The gap is measured on the last third, in blocks that were held out, before and after.

# %% tags=["fit"]
fitted, kept = sysid.split_blocks(windows)
part, apart = sysid.select_windows(windows, fitted), sysid.select_windows(windows, kept)


def left_over(model):
    """chi2 per degree of freedom on the time held out, after a fit to the rest."""
    return score(fit(model, part, before.initial_states[fitted], prior=prior).model, apart).chi2


def measure(name):
    """The model with a candidate as the scan saw it, and the finding from all of the flight."""
    amplitudes = CANDIDATES[name].amplitudes
    model = with_candidate(calm_model, name)
    model = model.with_values(dict(zip(amplitudes, scores[name][1:], strict=True)))
    after = fit(model, windows, before.initial_states, prior=prior)
    confidence = uncertainty(after, windows, prior)
    sizes = np.array([after.model.values[a] for a in amplitudes])
    size = float(sizes[0] if len(sizes) == 1 else np.linalg.norm(sizes))  # of a wind: its speed
    along, rows = sizes / size, [confidence.names.index(a) for a in amplitudes]
    half = 1.96 * float(np.sqrt(along @ confidence.covariance[np.ix_(rows, rows)] @ along))
    return model, {"effect": name, "size": size, "low": size - half, "high": size + half}


# %% figure="gap"
threshold, word, names = verdict(gains, calm_gains)
level = {"nominal model": score(calm_model, apart).chi2, "another day": left_over(calm_model)}
finding = {"effect": "none", "size": 0.0, "low": 0.0, "high": 0.0}
if names:
    model, finding = measure(names[0])
    level["with the effect"] = left_over(model)
level["baseline flight"] = found.train.chi2
rounded = {key: value if key == "effect" else round(value, 4) for key, value in finding.items()}
print(f"threshold {threshold:.1f}: {word} {' or '.join(names)}; {rounded}")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
draw_evidence(left, gains, threshold)
draw_gap(right, level)
plt.show()

# %% [markdown]
# *In words:* left, a bar of evidence for every candidate and the threshold as a dashed line. Right, bars of the
# misfit: on held-out time with the nominal model as it is, with its parameters adapted to another day, and with the effect
# (if one was named); last, the baseline flight on the time that it was fitted to. Where the effect's bar is as low, the gap is closed.
#
# **Question on the figure.** What has passed the threshold, and is the gap closed? Or why is it *none*? Why does the
# second bar, with 29 adapted parameters and *no* effect, not settle it?

# %% [markdown] answer="gap_reading"
# Only ground effect has passed: some 1100 against 10, all others at or below zero; with it the misfit is as low as in
# the baseline flight. (For *none*: no candidate has passed, so all bars may be chance.) The 29 parameters can be adapted
# until the gap nearly closes without any effect. The bar does not show how improbable this is under the prior; the
# evidence does.

# %% [markdown]
# ## 7. Your finding
# Do map, evidence and gap agree? Does the size make sense? Then write down what you found. The size is that of
# `CANDIDATES` in given.py (of a wind its speed, of a trim bias with its sign), low and high are a 95 % interval. For
# *none* all three are zero. A size counts within 25 % of the truth; an interval counts if its half-width is at
# most 40 % of the true size and the truth is at most 1.6 half-widths from its middle.


# %% exercise="my_finding"
def my_finding():
    """What was different on the flight under test.

    Returns:
        dict with "effect" (one of CANDIDATES, or "none"), "size", "low" and "high".
    """
    # BEGIN SOLUTION
    return {"effect": "ground_effect", "size": 0.455, "low": 0.427, "high": 0.483}
    # END SOLUTION


# %% check="my_finding"
check(my_finding)

# %% [markdown]
# ## 8. A real flight, and an effect that you hide yourself
# So far a simulator hid the effect. Now **measured** data: a foam aircraft of 65 g, 198 s in a motion capture hall
# (HobbyZone Sport Cub S 2; CogniPilot, repository [cubs2](https://github.com/CogniPilot/cubs2), Apache-2.0; it ships
# with the kit). The air in the hall was at rest. In air that moves steadily with $w$ the aircraft, given the same
# commands, flies the same path *through the air* (Galilei). Over the floor it is carried along:
#
# $$p'(t) = p(t) + w\,t, \qquad v' = v + w, \qquad \text{attitudes and commands as measured}$$
#
# That is exact: no model is in it. Truth is known, and the flight is real.
#
# **The base model** could not be simpler: through the air the aircraft always has the same velocity in its own
# horizontal axes, $a$ along the nose and $b$ to the right. In world axes (y to the *left*, yaw $\psi$ positive nose
# *right*) the nose points to $(\cos\psi, -\sin\psi)$ and the right wing to $(-\sin\psi, -\cos\psi)$, so over the floor
#
# $$\begin{pmatrix} v_x \\ v_y \end{pmatrix} = a \begin{pmatrix} \cos\psi \\ -\sin\psi \end{pmatrix}
#   + b \begin{pmatrix} -\sin\psi \\ -\cos\psi \end{pmatrix} + \begin{pmatrix} w_x \\ w_y \end{pmatrix}$$
#
# Flown on all headings, the velocities make a circle in the $(v_x, v_y)$ plane, and the wind is its centre. Find all
# four numbers by linear least squares: two equations for each row.


# %% exercise="estimate_wind"
def estimate_wind(v, yaw):
    """Velocity through the air and wind, by least squares from velocities over the floor.

    Args:
        v: (N, 2) vx, vy over the floor [m/s], world: y to the left; nan where missing.
        yaw: (N,) [rad], positive nose right.

    Returns:
        (4,) a along the nose, b to the right wing, wind along x, wind along y [m/s]. Rows in which a
        component is missing do not count.
    """
    # BEGIN SOLUTION
    known = np.isfinite(v).all(axis=1)
    c, s = np.cos(yaw[known]), np.sin(yaw[known])
    one, zero = np.ones(len(c)), np.zeros(len(c))
    of_vx = np.stack([c, -s, one, zero], axis=1)
    of_vy = np.stack([-s, -c, zero, one], axis=1)
    rows = np.concatenate([of_vx, of_vy])
    return np.linalg.lstsq(rows, v[known].T.ravel(), rcond=None)[0]
    # END SOLUTION


# %% check="estimate_wind"
check(estimate_wind)

# %% [markdown]
# The flight is cut into whole laps, so that every lap has all headings alike. The second, fourth, ... lap is the
# *baseline*, as it was measured. In the others you hide a wind. Choose your own; both parts share battery and pilot.

# %% tags=["hide"]
hidden_wind = np.array([0.4, -0.3])  # m/s, along x and y of the hall
real = load_flight("sport_cub")
seen = real.has_pose & (real.t > 5.0)  # after the first seconds at full throttle
t, p, yaw = real.t[seen], real.p_world[seen, :2], real.attitude[seen, 2]
moved = p + t[:, None] * hidden_wind  # the whole transform
laps = lap_numbers(yaw)
whole = np.arange(1, laps.max())  # the first and the last one are not complete
measured_v, moved_v = velocities(t, p), velocities(t, moved)
print(f"{len(whole)} whole laps of {np.mean([np.ptp(t[laps == k]) for k in whole]):.0f} s")

# %% figure="real"
by_lap = np.array([
    estimate_wind((moved_v if k % 2 else measured_v)[laps == k], yaw[laps == k]) for k in whole
])  # fmt: skip
baseline, test = by_lap[whole % 2 == 0], by_lap[whole % 2 == 1]
wind = test[:, 2:].mean(axis=0) - baseline[:, 2:].mean(axis=0)
variances = [part[:, 2:].var(axis=0, ddof=1) / len(part) for part in (baseline, test)]
half = 2.3 * np.sqrt(variances[0] + variances[1])  # Student's t for nine degrees of freedom, 95 %
for axis, name in enumerate("xy"):
    print(
        f"wind along {name}: {wind[axis]:+.3f} +- {half[axis]:.3f} m/s, hidden {hidden_wind[axis]:+.3f}"
    )
print("'wind' of the baseline laps:", baseline[:, 2:].mean(axis=0).round(3), "m/s")
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
turn = np.linspace(0.0, 2.0 * np.pi, 200)
pairs = (("baseline laps, measured", measured_v, p, 0, "--", ".", "#777777"),
         ("laps with the hidden wind", moved_v, moved, 1, "-", "x", "#0072B2"))  # fmt: skip
for label, velocity, path, odd, line, mark, colour in pairs:
    mine = np.isin(laps, whole) & (laps % 2 == odd)
    a, b, *centre = estimate_wind(velocity[mine], yaw[mine])
    left.plot(*velocity[mine][::6].T, mark, ms=3, color=colour, alpha=0.5)
    ring = np.hypot(a, b) * np.stack([np.cos(turn), np.sin(turn)]) + np.array(centre)[:, None]
    left.plot(*ring, line, color=colour, label=label)
    left.plot(*centre, "P", ms=9, color=colour, mec="k")
    right.plot(*path[laps == 2 + odd].T, line, color=colour, label=f"lap {2 + odd}")
left.set(xlabel="vx over the floor [m/s]", ylabel="vy over the floor [m/s]", aspect="equal")
left.set(title="A circle's centre is the wind (flight measured)", ylim=(-6.5, 8))
right.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Two neighbouring laps from above")
left.legend(fontsize=8, loc="upper left")
right.legend(fontsize=8)
plt.show()

# %% [markdown]
# *In words:* left, velocities over the floor make two rings of the same size; plus signs mark their centres: that of
# the grey, dashed ring at zero, that of the blue, solid ring at the hidden wind. Right, two laps seen from above, a long loop each; the
# second lies metres away, where the wind has carried the aircraft since the start, and does not close.
#
# **Question on the figure.** Does the interval contain what you hid? Why is the baseline's "wind" not exactly zero, and
# why subtract it? What would be left of the estimate if the aircraft had flown one heading only? And which of
# `CANDIDATES` can be hidden in a recording by an exact transform, which cannot?

# %% [markdown] answer="real_reading"
# Hidden were +0.4 and -0.3 m/s; found +0.42 +- 0.06 and -0.30 +- 0.04: yes. The base model's a and b are not quite
# constant: speed and sideslip change within a lap, so some 0.2 m/s per row is left over, and the centre of each lap
# scatters by a few centimetres per second. What is alike in all laps, such as a slow climb always at the same place,
# looks like a wind too; it is in both parts and cancels in the difference. On one heading the columns of a, b and of
# the wind are the same two directions: only their sum is determined, and speed cannot be distinguished from wind.
# Exact are those that move the path or restate the log: wind, a delay (shift the commands in time), a thrust or
# aileron that lost a share, a trim bias. Drag, mass or a cushion near the floor would have made the aircraft fly
# another path, which no one has recorded.

# %% [markdown]
# ## Questions
# **Question 1.** Which other candidate would have made a map like yours, and what distinguishes the two?

# %% [markdown] answer="q1"
# More lift near the floor pulls a banked aircraft into its turn, so it is the place in the hall that is off, more than
# the height. The lowest throttle stands out too, because low passes are flown with little throttle: a drag or a loss
# of thrust would make a map like that. But they act at every height, and the height panel is pale above.

# %% [markdown]
# **Question 2.** A friend leaves out the prior: all 29 parameters are free. Which candidates would he miss, and why? And
# another friend takes the candidate with the largest gain without a threshold: what happens on a baseline flight?

# %% [markdown] answer="q2"
# He misses what a number of the aircraft can imitate: a lost aileron is a smaller L_da and nothing else, extra drag is
# a larger cD_0, a loss of thrust a smaller kT, a trim bias a rolling moment at zero, a delay the delay that the model
# has anyway. Wind and ground effect stay: no number makes them. The other friend always names something: one of ten
# gains is always the largest. On every baseline flight he reports an effect that is not there.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
# You can distinguish a wrong model from chance, name what is missing, or conclude that nothing is. Compare with the kit,
# which has 20 effects in its catalogue, tries two at a time, and reports when it is none of them:
#
#     falconwing gap --calm data/calm.csv --flight data/flight.csv --out gap
#
# <details><summary>What was hidden in the practice case (not in yours)</summary>
# A ground effect with 0.45 of the lift added at the floor, and as much of the induced drag lost.</details>
#
# **With hardware:** fly two logs of a minute, a baseline, and one with a change that a partner makes in secret: tape on an
# aileron, a strip of card (drag), a fan, 10 g at the centre of gravity. The partner checks balance and throws before
# every flight; propeller and battery stay as they are.
