"""Wrong solutions of lab 11: what is wrong, the replaced text, the replacement."""

MUTANTS = {
    "success_interval": (
        (
            "the formula of first courses: no correction",
            "scale = 1.0 + z**2 / trials",
            "scale = 1.0",
        ),
        ("z is not squared in the root", "+ z**2 / (4.0 * trials**2))", "+ z / (4.0 * trials**2))"),
        ("n is not squared in the root", "(4.0 * trials**2)", "(4.0 * trials)"),
        ("always 95 %", "z_value(confidence)", "z_value(0.95)"),
        ("the centre is the share", "share + z**2 / (2.0 * trials)", "share"),
        (
            "the standard deviation of one trial",
            "share * (1.0 - share) / trials +",
            "share * (1.0 - share) +",
        ),
    ),
    "ald_summary": (
        ("failures are 0 cm in the mean", "np.mean(landings)", "np.sum(landings) / len(success)"),
        ("marks beside the pad are landings", "ald_cm[success]", "ald_cm[~np.isnan(ald_cm)]"),
        (
            "close among the landings only",
            "np.sum(close) / len(success)",
            "np.sum(close) / max(len(landings), 1)",
        ),
        ("exactly on the limit is not close", "landings <= COHORT", "landings < COHORT"),
        ("the limit of another course", 'COHORT["close_cm"]', "100.0"),
        ("median of all numbers", "np.median(landings)", "np.nanmedian(ald_cm)"),
        ("mean and median are taken for the same", "np.median(landings)", "np.mean(landings)"),
    ),
    "compare_sim_real": (
        ("sim minus real", "differences = (real_cm - sim_cm)", "differences = (sim_cm - real_cm)"),
        (
            "one direction only",
            "np.abs(means) >= np.abs(measured) - 1e-9",
            "means >= measured - 1e-9",
        ),
        ("equal ones are not counted", "np.abs(measured) - 1e-9", "np.abs(measured) + 1e-9"),
        (
            "missing runs are 0 cm",
            "(real_cm - sim_cm)[~np.isnan(real_cm - sim_cm)]",
            "np.nan_to_num(real_cm) - np.nan_to_num(sim_cm)",
        ),
        ("the share of smaller means", "np.abs(means) >=", "np.abs(means) <"),
        ("the sum instead of the mean", "np.mean(differences)", "np.sum(differences)"),
        ("the middle difference", "np.mean(differences)", "np.median(differences)"),
    ),
    "landings_to_show": (
        (
            "the observed share in the root",
            "np.sqrt(rate * (1.0 - rate) / trials)",
            "np.sqrt((trials - failures) * failures / trials**3)",
        ),
        ("one trial too many", "return trials", "return trials + 1"),
        ("failures do not count", "(trials - failures) / trials", "1.0"),
        ("one-sided", "z_value(confidence)", "z_value(2.0 * confidence - 1.0)"),
        (
            "variance instead of standard deviation",
            "z * np.sqrt(rate * (1.0 - rate) / trials)",
            "z * rate * (1.0 - rate) / trials",
        ),
        ("counts successes, not trials", "return trials", "return trials - failures"),
    ),
}
