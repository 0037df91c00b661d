"""Aerodynamic tables: a drawn 150 g aircraft -> CL CD CY Cl Cm Cn over alpha and beta, as JSON.

Made with AeroSandbox (github.com/peterdsharpe/AeroSandbox, MIT): a vortex lattice gives the
derivatives of body rates; its component build-up with NeuralFoil sections at the true Reynolds
number gives the static tables, so that lift bends and drag rises before stall, and those of the
surfaces, which its lattice does not deflect. AeroSandbox is not a dependency: the tables are kept
in `foreign_tables.json`, and this file makes them anew:

    pip install aerosandbox && python tests/benchmarks/foreign_tables.py
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

SPEED = 6.5  # m/s
ALPHAS_DEG = np.arange(-10.0, 24.1, 2.0)
BETAS_DEG = np.arange(-20.0, 20.1, 4.0)
FILE = Path(__file__).with_name("foreign_tables.json")


def airplane(aileron_deg: float = 0.0, elevator_deg: float = 0.0, rudder_deg: float = 0.0) -> Any:
    """A high wing of 0.80 m span with 5 deg dihedral; AeroSandbox's axes: x aft, y right."""
    import aerosandbox as asb

    def surface(name: str, symmetric: bool, hinge: float, deflection: float) -> Any:
        return asb.ControlSurface(
            name=name, symmetric=symmetric, hinge_point=hinge, deflection=deflection
        )

    wing_foil, tail_foil = asb.Airfoil("clarky"), asb.Airfoil("naca0008")
    aileron = [surface("aileron", False, 0.75, aileron_deg)]
    wing = asb.Wing(
        name="wing", symmetric=True,
        xsecs=[
            asb.WingXSec([0.0, 0.0, 0.02], chord=0.135, twist=2.0, airfoil=wing_foil),
            asb.WingXSec([0.004, 0.2, 0.0375], chord=0.128, twist=2.0, airfoil=wing_foil,
                         control_surfaces=aileron),
            asb.WingXSec([0.02, 0.4, 0.055], chord=0.10, twist=1.0, airfoil=wing_foil),
        ],
    )  # fmt: skip
    tail = asb.Wing(
        name="tail", symmetric=True,
        xsecs=[
            asb.WingXSec([0.40, 0.0, 0.0], chord=0.09, twist=-1.0, airfoil=tail_foil,
                         control_surfaces=[surface("elevator", True, 0.6, elevator_deg)]),
            asb.WingXSec([0.41, 0.14, 0.0], chord=0.07, twist=-1.0, airfoil=tail_foil),
        ],
    )  # fmt: skip
    fin = asb.Wing(
        name="fin", symmetric=False,
        xsecs=[
            asb.WingXSec([0.40, 0.0, 0.0], chord=0.10, airfoil=tail_foil,
                         control_surfaces=[surface("rudder", True, 0.55, rudder_deg)]),
            asb.WingXSec([0.43, 0.0, 0.13], chord=0.06, airfoil=tail_foil),
        ],
    )  # fmt: skip
    body = asb.Fuselage(
        name="body",
        xsecs=[
            asb.FuselageXSec([x, 0.0, z], radius=r)
            for x, z, r in (
                (-0.12, 0.0, 0.005),
                (-0.08, 0.0, 0.02),
                (0.1, 0.0, 0.022),
                (0.45, 0.0, 0.006),
            )
        ],
    )
    return asb.Airplane(
        name="foreign150", xyz_ref=[0.046, 0.0, 0.0], wings=[wing, tail, fin], fuselages=[body],
        s_ref=float(wing.area()), b_ref=0.80, c_ref=float(wing.mean_aerodynamic_chord()),
    )  # fmt: skip


def coefficients(plane: Any, alpha: Any, beta: Any, method: str, **rates: float) -> np.ndarray:
    """(..., 6) CL CD CY Cl Cm Cn at angles in degrees."""
    import aerosandbox as asb

    point = asb.OperatingPoint(velocity=SPEED, alpha=alpha, beta=beta, **rates)
    if method == "lattice":
        run = asb.VortexLatticeMethod(
            plane, point, spanwise_resolution=8, chordwise_resolution=6
        ).run()
    else:
        run = asb.AeroBuildup(plane, point, model_size="medium").run()
    names = ["CL", "CD", "CY", "Cl", "Cm", "Cn"]
    return np.stack([np.resize(run[n], np.shape(alpha)) for n in names], axis=-1)


def main() -> None:
    """Write foreign_tables.json."""
    plane = airplane()
    alpha, beta = np.meshgrid(ALPHAS_DEG, BETAS_DEG, indexing="ij")
    table = coefficients(plane, alpha.ravel(), beta.ravel(), "build-up").reshape(*alpha.shape, 6)
    at = {"alpha": 4.0, "beta": 0.0}
    still = coefficients(plane, *at.values(), "lattice")
    half = {"p": plane.b_ref, "q": plane.c_ref, "r": plane.b_ref}
    derivatives = {}
    for rate, length in half.items():
        turned = coefficients(plane, *at.values(), "lattice", **{rate: 0.5})
        derivatives[rate] = ((turned - still) / (0.5 * length / (2.0 * SPEED))).tolist()
    for name in ("aileron", "elevator", "rudder"):
        ends = [
            coefficients(airplane(**{f"{name}_deg": turn}), *at.values(), "build-up")
            for turn in (-10.0, 10.0)
        ]
        derivatives[name] = ((ends[1] - ends[0]).ravel() / np.radians(20.0)).tolist()
    with FILE.open("w", encoding="utf-8") as file:
        json.dump(
            {
                "made_with": "AeroSandbox 4.2.10, this folder's foreign_tables.py",
                "wing_area": plane.s_ref, "span": plane.b_ref, "chord": plane.c_ref,
                "alpha_deg": ALPHAS_DEG.tolist(), "beta_deg": BETAS_DEG.tolist(),
                "columns": ["CL", "CD", "CY", "Cl", "Cm", "Cn"],
                "table": np.round(table, 5).tolist(), "derivatives": derivatives,
            }, file, indent=None,
        )  # fmt: skip
    print("area", plane.s_ref, "chord", plane.c_ref)
    middle = len(BETAS_DEG) // 2
    print(np.round(np.column_stack([ALPHAS_DEG, table[:, middle]]), 3))
    print(np.round(np.column_stack([BETAS_DEG, table[7]]), 3))
    for name, values in derivatives.items():
        print(name, np.round(values, 3))


if __name__ == "__main__":
    main()
