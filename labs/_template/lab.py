# %% [markdown]
# # Lab 0: Gliding
# **How far does an aircraft fly without its engine?**
#
# One paragraph on what this lab is about and why it matters.
#
# **You will be able to**
# - compute the distance that a glider covers in still air and in a headwind.
#
# **Time** about 1 hour. **Before** velocities and ratios (school), NumPy arrays. **Paper** none.
#
# Every exercise is one function. Read its docstring, write what is missing, run the cell, then run the check below it.
# Some constants differ from course to course. They are in the dictionary `COHORT`: write its entry in your functions, not the number.

# %%
import given
import matplotlib.pyplot as plt
import numpy as np
from given import COHORT

from falconwing_kit.tools.grading import check, keep_going

keep_going()  # a missing function stops only the cells that need it
print("your course:", COHORT)

# %% [markdown]
# ## 1 Glide range
# In a steady glide an aircraft with the glide ratio $E$ sinks at the speed $V / E$, with its airspeed $V$ [m/s]. From
# the height $h$ [m] it stays aloft for $t = h E / V$. A headwind $w$ [m/s] lowers the ground speed to $V - w$, so the
# range is
#
# $$R = (V - w) \, \frac{h E}{V}$$
#
# Write `glide_range`.


# %% exercise="glide_range"
def glide_range(height, airspeed, headwind):
    """Distance over the ground of a steady glide.

    Use COHORT["glide_ratio"] [-].

    Args:
        height: a number or an array (...) of start heights [m].
        airspeed: speed through the air [m/s], a number, larger than the headwind.
        headwind: wind from the front [m/s], a number; a tailwind is negative.

    Returns:
        The range (...) [m], one for each height.
    """
    # BEGIN SOLUTION
    time = np.asarray(height) * COHORT["glide_ratio"] / airspeed
    return (airspeed - headwind) * time
    # END SOLUTION


# %% check="glide_range"
check(glide_range)

# %% [markdown]
# ## 2 The figure
# Range from 2 m over the headwind, for two airspeeds.

# %% figure="range"
wind = np.linspace(-2.0, 4.0, 50)
fig, ax = plt.subplots(figsize=(8, 5))
for airspeed, colour in ((6.0, given.BLUE), (9.0, given.ORANGE)):
    ranges = [glide_range(2.0, airspeed, w) for w in wind]
    ax.plot(wind, ranges, color=colour, label=f"airspeed {airspeed:.0f} m/s")
ax.set(xlabel="headwind [m/s]", ylabel="glide range [m]")
ax.set_title("A headwind costs a slow aircraft more range")
ax.legend()
plt.show()

# %% [markdown]
# *In words: both lines fall linearly with the headwind and cross in still air; the line of 6 m/s falls faster.*
#
# **Question on the figure.** At which wind is the range independent of the airspeed, and why?

# %% [markdown] answer="range_reading"
# In still air, $w = 0$: there $R = h E$, because a faster aircraft also sinks faster by the same factor.

# %% [markdown]
# ## Questions
# **Question 1.** Should a pilot fly faster or slower than the speed of the best glide ratio against a headwind?

# %% [markdown] answer="q1"
# Faster: the range contains $(V - w) / V$, which grows with $V$, and near the best glide ratio $E$ changes little.

# %% [markdown]
# ## What you can do now
# One or two sentences: which part of the kit does the same, and where to read on.
