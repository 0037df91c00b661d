"""Wrong solutions of lab 3, such as students write: what is wrong, the text that is replaced, and
by what.
"""

MUTANTS = {
    "cov3d_from_scale_quat": (
        ("logarithms taken for lengths", "np.exp(log_scales)", "log_scales"),
        ("standard deviations for variances", "np.exp(log_scales)", "np.exp(0.5 * log_scales)"),
        ("w first", "x, y, z, w =", "w, x, y, z ="),
        ("not brought to length 1", "(quaternions_xyzw / lengths)", "quaternions_xyzw"),
        ("one length for all", "axis=1, keepdims=True", ""),
        ("turned the other way", ".transpose(2, 0, 1)", ".transpose(2, 1, 0)"),
        ("stretched along the world's axes", "[:, None, :]", "[:, :, None]"),
        ("a sign in the rotation", "2 * (y * z - w * x)]", "2 * (y * z + w * x)]"),
    ),
    "project_gaussians": (
        (
            "forgets that ahead is negative",
            'lens["cx"] - lens["fx"] * x / z',
            'lens["cx"] + lens["fx"] * x / z',
        ),
        ("v counted upwards", 'lens["cy"] + lens["fy"]', 'lens["cy"] - lens["fy"]'),
        (
            "derivative of v with the sign of u",
            'J[:, 1, 1] = lens["fy"]',
            'J[:, 1, 1] = -lens["fy"]',
        ),
        ("derivative by z, sign", 'J[:, 0, 2] = lens["fx"]', 'J[:, 0, 2] = -lens["fx"]'),
        ("derivative by z, not squared", 'lens["fy"] * y / z**2', 'lens["fy"] * y / z'),
        ("derivative by z left out", 'J[:, 1, 2] = -lens["fy"] * y / z**2', "J[:, 1, 2] = 0.0"),
        ("no blur", " + blur_px2 * np.eye(2)", ""),
        ("blur in every entry", "blur_px2 * np.eye(2)", "blur_px2"),
        ("blur taken for a standard deviation", "blur_px2 * np.eye(2)", "blur_px2**2 * np.eye(2)"),
        ("one focal length", 'J[:, 1, 1] = lens["fy"]', 'J[:, 1, 1] = lens["fx"]'),
        (
            "the kit's camera axes",
            "x, y, z = means_camera.T",
            "x, y, z = means_camera.T * np.array([[1], [-1], [-1]])",
        ),
    ),
    "splat_alphas": (
        ("no half in the exponent", "np.exp(-0.5 * squares)", "np.exp(-squares)"),
        ("covariance not inverted", "np.linalg.inv(covs_px)", "covs_px"),
        ("only the diagonal", "np.linalg.inv(covs_px)", "np.linalg.inv(covs_px * np.eye(2))"),
        ("cut not squared", 'COHORT["cut_sigma"] ** 2', 'COHORT["cut_sigma"]'),
        ("cut at three standard deviations", 'COHORT["cut_sigma"]', "3.0"),
        (
            "never cut",
            'return np.where(squares <= COHORT["cut_sigma"] ** 2, alphas, 0.0)',
            "return alphas",
        ),
        (
            "covers all of a pixel",
            "np.minimum(0.999, opacities * np.exp(-0.5 * squares))",
            "opacities * np.exp(-0.5 * squares)",
        ),
        ("every splat solid", "opacities * np.exp", "np.exp"),
        ("distance for its square", "np.exp(-0.5 * squares)", "np.exp(-0.5 * np.sqrt(squares))"),
        (
            "largest alpha before the opacity",
            "np.minimum(0.999, opacities * np.exp(-0.5 * squares))",
            "opacities * np.minimum(0.999, np.exp(-0.5 * squares))",
        ),
    ),
    "alpha_composite": (
        ("farthest first", "np.argsort(depths)", "np.argsort(-depths)"),
        ("in the order of the file", "np.argsort(depths)", "np.arange(len(depths))"),
        ("colours left behind in the sorting", "colours[order]", "colours"),
        ("depths left behind in the sorting", ", depths[order]\n", ", depths\n"),
        ("no background", " + left[:, -1:] * background", ""),
        ("background in full", "left[:, -1:] * background", "background"),
        ("light behind the splat instead of before it", "(alphas * arriving)", "(alphas * left)"),
        ("plain sum", "(alphas * arriving)", "alphas"),
        ("surface one splat late", "reached = 1.0 - left >=", "reached = 1.0 - arriving >="),
        (
            "surface where a single splat covers enough",
            "reached = 1.0 - left >=",
            "reached = alphas >=",
        ),
        (
            "light that is left for light that is taken",
            "reached = 1.0 - left >=",
            "reached = left >=",
        ),
        ("zero for never", "np.nan", "0.0"),
        ("a share of its own", 'COHORT["surface_share"]', "0.8"),
    ),
}
