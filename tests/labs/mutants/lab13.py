"""Wrong solutions of lab 13: what is wrong, the replaced text, the replacement."""

MUTANTS = {
    "merge_gaussians": (
        ("spread of the means forgotten", "covs + off[:, :, None] * off[:, None, :]", "covs"),
        ("weights forgotten", "weights * column, count", "column, count"),
        ("sum instead of mean", "(np.array(sums) / total)", "np.array(sums)"),
        ("mean of the covariances of all", "merged[groups]", "merged[0]"),
        ("spread subtracted", "covs + off", "covs - off"),
    ),
    "sticks_from_slots": (
        ("throttle -1..1", '0.5 * (by_letter["T"] + 1.0)', 'by_letter["T"]'),
        ("order of the channels ignored", "zip(order,", 'zip("TAER",'),
        (
            "not limited",
            "np.clip((np.asarray(slots_us) - centre_us) / reach_us, -1.0, 1.0)",
            "(np.asarray(slots_us) - centre_us) / reach_us",
        ),
        ("centre of another radio", "- centre_us)", "- 1500.0)"),
        ("limited by the throttle", "-1.0, 1.0)\n", "0.0, 1.0)\n"),
    ),
    "fly": (
        ("lost commands are zero", "servos if arrived is None", "np.zeros(4) if arrived is None"),
        ("a picture in every step", "k % IMAGE_EVERY == 0", "True"),
        ("first picture one step late", "k % IMAGE_EVERY == 0", "k % IMAGE_EVERY == 1 or k == 0"),
        (
            "servos do not move within the step",
            "step(state, before, servos)",
            "step(state, servos, servos)",
        ),
        ("ends below, not at, and one step late", "state[2] <= floor", "states[-2][2] <= floor"),
        (
            "start is no state",
            "states, commands, frames = [start], [], []",
            "states, commands, frames = [], [], []",
        ),
    ),
    "landing_score": (
        (
            "the last row is the touchdown",
            "touch = before + share * (after - before)",
            "touch = after",
        ),
        ("share counted from the end", "before[2] - FLOOR_Z)", "FLOOR_Z - after[2])"),
        ("pad without its end", "PAD[0] <= x <= PAD[1] and", ""),
        ("sink rate with its sign", "-touch[8]", "touch[8]"),
        (
            "softer than soft is worth more",
            "1.0 if sink <= SOFT_SINK else SOFT_SINK / sink",
            "SOFT_SINK / sink",
        ),
        ("offset not squared", "(offset / WORTH_M) ** 2", "(offset / WORTH_M)"),
    ),
}
