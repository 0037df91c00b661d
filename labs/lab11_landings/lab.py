# %% [markdown]
# # Lab 11: Landing trials
# **Eight of ten landed. What does that show?**
#
# ![Four success rates of landings as bars, from 8 of 10 to 100 of 100, each with its interval](goal.webp)
#
# *What you will have at the end (open course).*
#
# The paper flew ten landings with vision, trained in simulation only. The aircraft had powder on its wheels; a tape
# measured the marks. Ten is few. This lab examines what ten landings show, and what they do not.
#
# **You will be able to**
# - give a success rate with an interval that is right for few trials,
# - average only what was measured, and say what an average hides,
# - compare simulated with real flights, run by run,
# - plan how many landings a claim needs.
#
# **Time** about 1.5 hours. **Before** mean, median, the normal distribution; NumPy arrays. **Paper** *Sim2Real Landing
# Performance* and its table.

# %%
PARTS = "kit"  # "mine": what you wrote, after `falconwing labs collect-mine` in the folder above

from itertools import product

import matplotlib.pyplot as plt
import numpy as np
from given import (
    BLUE,
    COHORT,
    ORANGE,
    coverage,
    draw_landings,
    fly_landings,
    read_paper,
    read_simulated,
    simple_interval,
    z_value,
)

from falconwing_kit.tools.grading import check, load_parts, whose

parts = load_parts(PARTS) if PARTS == "mine" else None
print("your course:", COHORT)
print(whose(parts, "expert"))  # your lab 7 flies the simulated landings of part 5
table = read_paper()
for name, column in table.items():
    print(f"{name:>15}", column)

# %%
from given import moving_tens

from falconwing_kit.tools.grading import borrow, keep_going

keep_going()  # a missing function stops only the cells that need it
moving_tens()

# %% [markdown]
# *In words: above, ten marks, dots for landings and crosses for failures, drawn anew sixty times for the same pilot. Below,
# bars count how many of the ten landed: mostly 7 to 9, sometimes 5, sometimes all ten.*

# %% [markdown]
# Each row of the paper's table is one start. The expert (which uses the state) and the vision pilot flew it in
# simulation, the vision pilot in the hall as well. The number is the **absolute lateral deviation** (ALD): how far from
# the pad's centre line the wheels touched, in cm. The pad is 2 m wide, so a landing has at most 100 cm. `nan` means:
# did not land on the pad, so there is no number.
#
# ## 1 A rate and its interval
# Let $k$ of $n$ trials succeed. The observed share is $\hat p = k/n$. The true rate $p$ is what endless trials would
# give. If $p$ were true, the share of $n$ trials would scatter around it with the standard deviation
# $\sqrt{p(1-p)/n}$.
#
# **Wilson's interval** (1927) keeps every rate $p$ from which $\hat p$ is not too far:
#
# $$|\hat p - p| \le z \sqrt{p (1 - p) / n}$$
#
# $z$ is how many standard deviations the confidence allows: 1.96 for 95 % (`z_value(0.95)`). Squared, this is a
# quadratic inequality in $p$. Its two ends are
#
# $$\frac{\hat p + \dfrac{z^2}{2n} \mp z \sqrt{\dfrac{\hat p (1 - \hat p)}{n} + \dfrac{z^2}{4n^2}}}
# {1 + \dfrac{z^2}{n}}$$
#
# Write `success_interval`.


# %% exercise="success_interval"
def success_interval(successes, trials, confidence):
    """Wilson's interval of a success rate. Use z_value(confidence).

    Args:
        successes: k, how many trials succeeded.
        trials: n, at least 1.
        confidence: such as 0.95.

    Returns:
        (low, high), the two ends of the rate, between 0 and 1.
    """
    # BEGIN SOLUTION
    share, z = successes / trials, z_value(confidence)
    centre = share + z**2 / (2.0 * trials)
    half = z * np.sqrt(share * (1.0 - share) / trials + z**2 / (4.0 * trials**2))
    scale = 1.0 + z**2 / trials
    return (centre - half) / scale, (centre + half) / scale
    # END SOLUTION


# %% check="success_interval"
check(success_interval)

# %% [markdown]
# Most first courses teach $\hat p \pm z \sqrt{\hat p (1 - \hat p)/n}$ instead. Both formulas promise 95 %. How often do
# they keep it for ten trials? No chance is needed to find out: there are eleven outcomes, and the binomial law gives
# the probability of each.

# %%
for name, interval in (("first course", simple_interval), ("Wilson", success_interval)):
    low, high = interval(10, 10, 0.95)
    print(f"10 of 10, {name}: {low:.2f} to {high:.2f}")
rates = np.linspace(0.5, 0.995, 300)
fig, ax = plt.subplots(figsize=(8, 4))
ax.plot(rates, coverage(simple_interval, rates, 10, 0.95), "--", color=ORANGE, label="first course")
ax.plot(rates, coverage(success_interval, rates, 10, 0.95), "-", color=BLUE, label="Wilson")
ax.axhline(0.95, color="black", linewidth=1)
ax.set(xlabel="true success rate", ylabel="share of intervals that hold it", ylim=(0, 1.03))
ax.set_title("Ten trials, 95 % promised")
ax.legend()
plt.show()

# %% [markdown]
# *In words: the dashed curve falls from 89 % at a true rate of 0.5 to 5 % near 1, in jumps; the solid one stays
# around 95 % and never falls below 83 %.*
#
# The simple formula fails where we need it: a good pilot lands ten of ten, and the formula then claims to *know* that
# the rate is 1.
#
# ## 2 An average of what?
# The paper gives a mean ALD of 41 cm for the real flights. Two of the ten did not land. What is the deviation of a run
# that has none?
#
# There are only two honest ways. Average the landings alone, and say how many runs are missing. Or choose a measure
# that every run has, for instance: did it land *close*, within `COHORT["close_cm"]` of the centre line? A run that
# missed the pad did not.
#
# Write `ald_summary`. Note that a run that missed the pad may still have left a mark beside it: trust `success`.


# %% exercise="ald_summary"
def ald_summary(success, ald_cm):
    """Deviation of landings, in several ways of which not all are honest. Use COHORT["close_cm"].

    Args:
        success: (n,) booleans, True where the run landed on the pad.
        ald_cm: (n,) deviations [cm]; nan, or a mark beside the pad, where the run did not land.

    Returns:
        A dict with
        "landed": how many runs landed,
        "mean_cm": mean over the landings, nan if there is none,
        "mean_with_zeros_cm": mean over all runs with 0 cm for those that did not land,
        "median_cm": median over the landings, nan if there is none,
        "close_share": share of all runs that landed at most COHORT["close_cm"] off the line.
    """
    # BEGIN SOLUTION
    landings = ald_cm[success]
    close = landings <= COHORT["close_cm"]
    return {
        "landed": len(landings),
        "mean_cm": np.mean(landings),
        "mean_with_zeros_cm": np.sum(landings) / len(success),
        "median_cm": np.median(landings),
        "close_share": np.sum(close) / len(success),
    }
    # END SOLUTION


# %% check="ald_summary"
check(ald_summary)

# %%
for name in ("sim_expert_cm", "sim_vision_cm", "real_vision_cm"):
    ald_cm = table[name]
    summary = ald_summary(~np.isnan(ald_cm), ald_cm)
    print(f"{name:>15}", {key: round(float(value), 2) for key, value in summary.items()})

# %% [markdown]
# Find the paper's 41 cm. Which of the numbers is it?
#
# ## 3 Is the real aircraft worse than the simulated one?
# Every real run was replayed in simulation from the same start. So compare **run by run**: starts differ a lot, and in
# the difference `real - sim` of one run that cancels.
#
# Suppose simulation and reality did not differ (the null hypothesis). Then each difference could as well have had the
# other sign. Flip the signs
# in all $2^n$ ways. Each way gives a mean difference. The share of ways whose mean is *at least as large in size* as
# the one measured is the **p-value** [Fisher 1935]. If it is small, chance alone would rarely give such a difference.
#
# `itertools.product([1.0, -1.0], repeat=n)` gives all ways. Allow for rounding: count a mean that is smaller by no more
# than 1e-9.
#
# Write `compare_sim_real`.


# %% exercise="compare_sim_real"
def compare_sim_real(sim_cm, real_cm):
    """Compare simulated with real landings from the same starts, by flipping signs.

    Args:
        sim_cm: (n,) deviations in simulation [cm], nan where the run did not land.
        real_cm: (n,) deviations of the same starts in the hall [cm], nan likewise.

    Returns:
        (pairs, difference, p): number of runs that landed in both, their mean of real minus sim
        [cm], and the share of all 2^pairs sign patterns whose mean is at least as large in size,
        both directions counted.
    """
    # BEGIN SOLUTION
    differences = (real_cm - sim_cm)[~np.isnan(real_cm - sim_cm)]
    pairs, measured = len(differences), np.mean(differences)
    signs = np.array(list(product([1.0, -1.0], repeat=pairs)))
    means = signs @ differences / pairs
    return pairs, measured, np.mean(np.abs(means) >= np.abs(measured) - 1e-9)
    # END SOLUTION


# %% check="compare_sim_real"
check(compare_sim_real)

# %%
pairs, difference, p = compare_sim_real(table["sim_vision_cm"], table["real_vision_cm"])
print(f"vision, real against simulated: {pairs} pairs, {difference:+.1f} cm, p = {p:.2f}")
pairs, difference, p = compare_sim_real(table["sim_expert_cm"], table["sim_vision_cm"])
print(f"vision against expert, both simulated: {pairs} pairs, {difference:+.1f} cm, p = {p:.3f}")

# %% [markdown]
# A large p-value does not show that two things are equal, only that these few runs cannot distinguish them.
#
# ## 4 Plan the next experiment
# Suppose you plan to claim: "it lands in at least 90 % of trials". How many landings does that take? Turn Wilson's condition
# round. With $f$ failures among $n$ trials, the rate $p$ is shown when the observed share lies far enough above it:
#
# $$\frac{n - f}{n} - p \;\ge\; z \sqrt{\frac{p (1 - p)}{n}}$$
#
# Write `landings_to_show`: the smallest such $n$. Counting up is fine.


# %% exercise="landings_to_show"
def landings_to_show(rate, failures, confidence):
    """Trials needed to show a success rate, given the failures. Use z_value(confidence).

    Args:
        rate: p, the success rate to be shown, between 0 and 1.
        failures: f, how many of the trials fail, 0 or more.
        confidence: such as 0.95.

    Returns:
        The smallest number of trials n, an int.
    """
    # BEGIN SOLUTION
    z, trials = z_value(confidence), failures + 1
    while (trials - failures) / trials - rate < z * np.sqrt(rate * (1.0 - rate) / trials):
        trials += 1
    return trials
    # END SOLUTION


# %% check="landings_to_show"
check(landings_to_show)

# %%
for rate in (0.5, 0.8, 0.9, 0.99):
    needed = [landings_to_show(rate, failures, 0.95) for failures in (0, 1, 2)]
    print(f"to show {rate:.0%}: {needed[0]} landings without a failure,", end=" ")
    print(f"{needed[1]} with one, {needed[2]} with two")

# %% [markdown]
# Simulated landings cost nothing but computing time. The kit's expert flew a hundred, from starts drawn as in the paper
# (20 m before the pad, 1.5 m up, scattered). They are simulated, and flown by state instead of by camera: they say
# nothing about a real landing. They do show what a hundred trials do to an interval.
#
# ## 5 The figure
# Above: every run, simulated and real. Below: all success rates with their intervals.

# %% figure="landings"
simulated = fly_landings(parts) if parts else read_simulated()
counts = {
    f"{who}, {how}": (int(np.sum(~np.isnan(table[name]))), 10)
    for name, who, how in (
        ("sim_expert_cm", "simulated", "expert"),
        ("sim_vision_cm", "simulated", "vision"),
        ("real_vision_cm", "real", "vision"),
    )
}
expert = "your lab 7" if parts else "kit's expert"
counts[f"simulated, {expert}"] = (int(simulated["success"].sum()), len(simulated["success"]))
intervals = {name: (k, n, *success_interval(k, n, 0.95)) for name, (k, n) in counts.items()}
draw_landings(table, intervals)
plt.show()

# %% [markdown]
# *In words: above, ten pairs of markers between 4 and 80 cm, two of them with a cross instead of a real value, and two
# lines for the two means, 51 and 41 cm. Below, bars: 8 of 10 reaches from 0.49 to 0.94, 10 of 10 from 0.72 to 1, and
# 100 of 100 from 0.96 to 1.*
#
# **Question on the figure.** In two or three sentences: what does it show about the real landings, and what can it not
# show? Which of the two lines is the mean of the landings, and what is the other?

# %% [markdown] answer="landings_reading"
# Eight of ten real runs landed, and these eight touched down 51 cm off the centre line on average; 41 cm counts the two
# failures as 0. The true rate may be anywhere from 0.49 to 0.94. That overlaps widely with the 0.72 to 1 of ten
# simulated landings, so ten runs show neither that reality is harder nor that it is equal.

# %% [markdown]
# ## Questions
# **Question 1.** The paper gives 41 cm as the mean ALD of the real trials. What would you print, 41 or 51? Which single
# line would you print in the abstract, so that no reader is misled?

# %% [markdown] answer="q1"
# 51 cm. The eight landings sum to 408 cm; 408/8 = 51.0, while 41 = 408/10 counts each failure as a perfect landing:
# the worse the pilot, the better the mean. A fair line: "8 of 10 landed (95 %: 0.49 to 0.94); the eight touched down
# 51 cm off the centre line on average (20 to 80)". Or one measure that all runs have, such as "half of the runs landed
# within half a metre".

# %% [markdown]
# **Question 2.** "Simulation and reality agree: the difference is not significant." Judge this sentence with your
# p-value and intervals. Which runs are missing from the pairs, and in which direction does that bend the comparison?

# %% [markdown] answer="q2"
# p = 0.18 for the deviation, and 10 of 10 (0.72 to 1) overlaps 8 of 10 (0.49 to 0.94). So no difference is shown; but
# none is excluded either: +12.5 cm with eight pairs could be a real gap of 0 or of 30 cm. The two runs that failed in
# reality (3 and 10) are not among the pairs, and they are the worst ones. Leaving them out flatters reality. Agreement
# would have to be shown by an interval that is narrow and lies around zero, with far more landings.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
# You can read a table of ten trials and say what it shows. `falconwing fly --task landing --pilot expert --trials 20`
# gives you a table of your own; the kit prints exact (Clopper-Pearson) intervals, which are a little wider than
# Wilson's. `falconwing_kit/tools/trials/statistics.py` is short; compare.
#
# **With hardware.** Put chalk or flour on the wheels and land by hand, ten times, on a strip of 13 x 2 m. Decide before
# the first flight what counts as success and who measures. Hand in the table, with failures in it, your own figure, and
# a photo of a mark beside the tape. No one stands beside the strip while the motor is armed.
