"""Wrong solutions of lab 5: for each exercise what is wrong, the right text and the wrong one."""

MUTANTS = {
    "local_slope": (
        ("one row too few to the right", "min(k + half + 1, len(t))", "min(k + half, len(t))"),
        ("only rows before", "min(k + half + 1, len(t))", "k + 1"),
        (
            "wraps around at the ends",
            "np.arange(max(k - half, 0), min(k + half + 1, len(t)))",
            "np.arange(k - half, k + half + 1) % len(t)",
        ),
        (
            "row numbers for times",
            "tau = t[rows] - t[rows].mean()",
            "tau = 0.05 * (rows - rows.mean())",
        ),
        (
            "times from the middle row, not their mean",
            "tau = t[rows] - t[rows].mean()",
            "tau = t[rows] - t[k]",
        ),
        ("missing values as zero", "rows = rows[np.isfinite(x[rows])]", "x = np.nan_to_num(x)"),
        ("noise is a variance", "1.0 / np.sqrt(tau @ tau)", "1.0 / (tau @ tau)"),
        (
            "a row alone has the slope zero",
            "np.full(len(t), np.nan), np.full(len(t), np.nan)",
            "np.zeros(len(t)), np.zeros(len(t))",
        ),
    ),
    "residuals": (
        (
            "measured minus predicted",
            "(predicted - measured) / sigma",
            "(measured - predicted) / sigma",
        ),
        ("not in sigmas", "e = (predicted - measured) / sigma", "e = predicted - measured"),
        (
            "each channel its own factor, as in the kit",
            "np.where(known, factor.min(axis=-1, keepdims=True), 0.0)",
            "np.where(known, factor, 0.0)",
        ),
        (
            "no square root",
            "np.sqrt(FAR / np.maximum(np.abs(e), FAR))",
            "FAR / np.maximum(np.abs(e), FAR)",
        ),
        (
            "far frames thrown away",
            "np.sqrt(FAR / np.maximum(np.abs(e), FAR))",
            "1.0 * (np.abs(e) <= FAR)",
        ),
        (
            "the kit's limit of 3 squared",
            "np.sqrt(FAR / np.maximum(np.abs(e), FAR))",
            "np.sqrt(9.0 / np.maximum(np.abs(e), 9.0))",
        ),
        (
            "a missing value spoils its channel only",
            "np.isfinite(e).all(axis=-1, keepdims=True)",
            "np.isfinite(e)",
        ),
        (
            "weight without the factor",
            "return factor * e, factor / sigma",
            "return factor * e, np.ones_like(e) / sigma",
        ),
        ("factor twice", "return factor * e, factor", "return factor**2 * e, factor"),
    ),
    "gauss_newton_step": (
        ("step uphill", "dK = -np.linalg.solve", "dK = np.linalg.solve"),
        (
            "start states not taken out",
            "J_left = r[:, :, None] - Q @ inside, J_K - Q @ across",
            "J_left = r[:, :, None], J_K",
        ),
        ("prior without its square", "np.diag(1.0 / sigma_prior**2)", "np.diag(1.0 / sigma_prior)"),
        ("prior has no pull", "+ away / sigma_prior**2", ""),
        ("pull of the prior the other way", "+ away / sigma_prior**2", "- away / sigma_prior**2"),
        ("starts do not follow K", "inside + (across @ dK)[:, :, None]", "inside"),
        ("starts follow K the other way", "inside + (across @ dK)", "inside - (across @ dK)"),
        ("starts uphill", "dstart = -np.linalg.solve", "dstart = np.linalg.solve"),
    ),
    "intervals": (
        ("start states cost nothing", " - len(K) - start_count", " - len(K)"),
        ("numbers of K cost nothing", " - len(K) - start_count", " - start_count"),
        ("counts rows, missing or not", "freedom = measured_count", "freedom = len(r)"),
        ("noise taken as one", "np.sum(r**2) / freedom", "1.0"),
        (
            "variance for standard deviation",
            "sigma = np.sqrt(s2 * np.diag(np.linalg.inv(J.T @ J)))",
            "sigma = s2 * np.diag(np.linalg.inv(J.T @ J))",
        ),
        ("each number alone", "np.diag(np.linalg.inv(J.T @ J))", "1.0 / np.diag(J.T @ J)"),
        ("one sigma", "[K - Z * sigma, K + Z * sigma]", "[K - sigma, K + sigma]"),
        ("high end first", "[K - Z * sigma, K + Z * sigma]", "[K + Z * sigma, K - Z * sigma]"),
    ),
    "holdout_score": (
        ("scores the passes that were fitted", "mine = np.isin", "mine = ~np.isin"),
        ("scores all passes", "(predicted - measured)[mine]", "(predicted - measured)"),
        (
            "per axis instead of distance",
            "np.mean(e[:, 0] ** 2 + e[:, 1] ** 2)",
            "np.mean(e[:, :2] ** 2)",
        ),
        (
            "mean distance",
            "np.sqrt(np.mean(e[:, 0] ** 2 + e[:, 1] ** 2))",
            "np.mean(np.hypot(e[:, 0], e[:, 1]))",
        ),
        ("pitch in rad", "np.degrees(pitch)", "pitch"),
        ("degrees of the square", "np.sqrt(np.mean(e[:, 2] ** 2))", "np.mean(e[:, 2] ** 2)"),
        (
            "missing values count as hits",
            "e[np.isfinite(e).all(axis=-1)]",
            "np.nan_to_num(e).reshape(-1, 3)",
        ),
        (
            "passes taken for windows",
            "np.isin(of_pass, held_passes)",
            "np.isin(np.arange(len(of_pass)), held_passes)",
        ),
    ),
    "forecast_turn": (
        (
            "turns to the left",
            "np.arctan2(v[:, 1], v[:, 0]) - 0.5",
            "np.arctan2(v[:, 1], v[:, 0]) + 0.5",
        ),
        ("along the tangent", "- 0.5 * turned", ""),
        ("to where it flies at the end", "- 0.5 * turned", "- turned"),
        ("arc for chord", " * np.sinc(turned / (2.0 * np.pi))", ""),
        ("sinc without pi", "np.sinc(turned / (2.0 * np.pi))", "np.sinc(0.5 * turned)"),
        (
            "divides by zero when level",
            "np.sinc(turned / (2.0 * np.pi))",
            "np.sin(0.5 * turned) / (0.5 * turned)",
        ),
        ("small roll", "np.tan(roll)", "roll"),
        ("sine of the roll", "np.tan(roll)", "np.sin(roll)"),
        ("speed with the climb", "np.hypot(v[:, 0], v[:, 1])", "np.linalg.norm(v, axis=1)"),
        ("no climb", "v[:, 2] * horizon]", "0.0 * horizon]"),
        ("from the origin", "return p + np.stack", "return np.stack"),
        ("yaw positive to the left", "axis=1), turned", "axis=1), -turned"),
        ("yaw wrapped", "axis=1), turned", "axis=1), (turned + np.pi) % (2.0 * np.pi) - np.pi"),
    ),
}
