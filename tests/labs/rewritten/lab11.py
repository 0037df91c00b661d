"""Lab 11, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "success_interval": (
        (
            "the simple interval about the share, cut at 0 and 1",
            "form",
            """
    share = successes / trials
    width = z_value(confidence) * np.sqrt(share * (1 - share) / trials)
    return max(share - width, 0.0), min(share + width, 1.0)
""",
        ),
        (
            "two more successes and two more failures, whatever the confidence",
            "form",
            """
    n = trials + 4
    share = (successes + 2) / n
    width = z_value(confidence) * (share * (1 - share) / n) ** 0.5
    return share - width, share + width
""",
        ),
    ),
    "ald_summary": (
        (
            "shares of those that landed, and a mean of all",
            "form",
            """
    good = ald_cm[success == 1]
    return {
        "landed": int(success.sum()),
        "mean_cm": float(good.mean()),
        "mean_with_zeros_cm": float(np.where(success, ald_cm, 0).mean()),
        "median_cm": float(np.median(good)),
        "close_share": float(np.mean(good <= COHORT["close_cm"])),
    }
""",
        ),
        (
            "failed flights count as zero in the median too",
            "form",
            """
    with_zeros = np.where(success, ald_cm, 0.0)
    return {
        "landed": int(np.sum(success)),
        "mean_cm": float(np.mean(ald_cm[success])),
        "mean_with_zeros_cm": float(np.mean(with_zeros)),
        "median_cm": float(np.median(with_zeros)),
        "close_share": float(np.sum(ald_cm[success] <= COHORT["close_cm"]) / len(success)),
    }
""",
        ),
    ),
    "compare_sim_real": (
        (
            "one-sided: only differences as large in the same direction",
            "form",
            """
    both = ~np.isnan(real_cm) & ~np.isnan(sim_cm)
    d = real_cm[both] - sim_cm[both]
    count, found = 0, d.mean()
    for signs in product([-1, 1], repeat=len(d)):
        count += np.mean(np.array(signs) * d) >= found - 1e-9
    return len(d), found, count / 2 ** len(d)
""",
        ),
        (
            "the pairs are broken up: means of two groups",
            "form",
            """
    found = np.nanmean(real_cm) - np.nanmean(sim_cm)
    d = (real_cm - sim_cm)[np.isfinite(real_cm)]
    means = np.array([np.dot(s, d) / len(d) for s in product([1, -1], repeat=len(d))])
    return len(d), found, (np.abs(means) >= abs(found) - 1e-9).mean()
""",
        ),
    ),
    "landings_to_show": (
        (
            "the spread of the measured share, not that of the rate to beat",
            "form",
            """
    n = failures
    while True:
        n += 1
        share = 1 - failures / n
        if share - rate >= z_value(confidence) * (share * (1 - share) / n) ** 0.5:
            return n
""",
        ),
        (
            "the share must only be above the rate",
            "form",
            """
    n = failures + 1
    while 1 - failures / n < rate:
        n += 1
    return n
""",
        ),
    ),
}
