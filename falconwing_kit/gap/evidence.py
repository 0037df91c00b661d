"""Evidence: a fit and the residual changes an effect would make -> how much chi2 the effect would
explain.

All derivatives exist already where a fit ended. An effect adds a few columns; eliminating start
states and aircraft parameters, which stay free under their prior, leaves a problem as small as the
effect (score test, Rao 1948).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.fit import FitResult, Prior, prior_rows
from falconwing_kit.sysid.shooting import Windows, finite_differences

BATCH_SIZE = 8  # effects in one model: more would each fly the others' terms at zero
# share of what an effect does that parameters and start states cannot: below it there is no
# evidence
MIN_EIGENVALUE = 1e-4


@dataclass(frozen=True)
class EffectVariant:
    """An effect at one place, angle or delay: what a scan tries."""

    effect: Effect
    values: dict[str, float]  # its parameters there


@dataclass(frozen=True)
class Sensitivities:
    """What a variant would do to the residuals, per unit of each amplitude."""

    variant: EffectVariant
    derivative: Array  # (W, R, A)


@dataclass(frozen=True)
class ScoreTest:
    """Linear evidence for a variant."""

    variant: EffectVariant
    delta_chi2: float  # chi2 it would explain
    values: dict[str, float]  # amplitudes it would take


def effect_variants(catalogue: Sequence[Effect], windows: Windows) -> Iterator[EffectVariant]:
    """Every effect at every place a scan should try it.

    Args:
        catalogue: the effects.
        windows: say where the aircraft has been.

    Yields:
        The variants; effects that another one stands for are left out.
    """
    flown = windows.pose[..., :2][windows.weight[..., 0] > 0]
    low, high = np.percentile(flown, [3.0, 97.0], axis=0)
    for effect in catalogue:
        if not effect.same_as:
            yield from (EffectVariant(effect, values) for values in effect.scan(low, high))


def sensitivities(
    model: Model, windows: Windows, starts: Array, tried: Sequence[EffectVariant]
) -> list[Sensitivities]:
    """Change of the residuals by each amplitude, as a secant to the variant's own size.

    Args:
        model: the aircraft without the effects.
        windows: W windows.
        starts: (W, n_states).
        tried: the effects and their places.

    Returns:
        The columns of each.
    """
    effects = list({id(v.effect): v.effect for v in tried}.values())
    found: dict[int, Sensitivities] = {}
    for k in range(0, len(effects), BATCH_SIZE):
        part = effects[k : k + BATCH_SIZE]
        mine = [v for v in tried if any(v.effect is e for e in part)]
        found |= dict(
            zip(
                map(id, mine), _batch_sensitivities(model, windows, starts, part, mine), strict=True
            )
        )
    return [found[id(v)] for v in tried]


def _batch_sensitivities(
    model: Model,
    windows: Windows,
    starts: Array,
    effects: Sequence[Effect],
    tried: Sequence[EffectVariant],
) -> list[Sensitivities]:
    """The same for a few effects, all of whose variants fly together."""
    for effect in effects:
        model = model.with_effect(effect).with_values({p.name: 0.0 for p in effect.amplitudes})
    cases = [
        model.with_values(
            {**v.values, **{q.name: 0.0 for q in v.effect.amplitudes}, p.name: v.values[p.name]}
        ).vector
        for v in tried
        for p in v.effect.amplitudes
    ]
    differences = iter(finite_differences(model, windows, starts, np.stack(cases, axis=1)))
    return [
        Sensitivities(v, np.nan_to_num(np.stack([next(differences) / v.values[p.name] for p in v.effect.amplitudes], axis=-1),
                                 posinf=0.0, neginf=0.0))
        for v in tried
    ]  # fmt: skip


@dataclass(frozen=True)
class SchurComplement:
    """A fit with its start states eliminated."""

    Q: Array  # (W, R, n) basis of what start states can do
    K: Array  # (W, R, F) parameter derivatives outside it
    residual: Array  # (W, R) outside it
    prior: Array  # (F, F) precision of the prior
    reduced_chi2: float  # chi2 per degree of freedom

    @classmethod
    def of(cls, result: FitResult, prior: Prior | None, reduced_chi2: float) -> "SchurComplement":
        """Eliminate the start states of a fit.

        Args:
            result: the fit.
            prior: the prior it used.
            scatter: chi2 per degree of freedom that noise and model leave on a calm flight.

        Returns:
            The reduced problem.
        """
        Q, _ = np.linalg.qr(result.initial_state_jacobian)
        rows, _ = prior_rows(result.model, result.free, prior)
        return cls(
            Q,
            _project_out(Q, result.parameter_jacobian),
            _project_out(Q, result.residual[..., None])[..., 0],
            rows.T @ rows,
            reduced_chi2,
        )

    def score(self, effect: Sensitivities) -> ScoreTest:
        """Linear evidence for an effect over all windows.

        Args:
            effect: its columns at this fit.

        Returns:
            chi2 gained in units of the scatter, and the amplitudes.
        """
        return _score_test(
            self,
            effect.variant,
            _project_out(self.Q, effect.derivative),
            np.arange(len(self.Q)),
            self.prior,
            None,
        )

    def block_delta_chi2(self, effects: Sequence[Sensitivities], blocks: int = 3) -> Array:
        """Evidence that the same effects show on parts of a calm flight, where there is none.

        The parameters are known from the other parts alone, as they are from another flight; what
        is found here comes from noise and from what the base model lacks.

        Args:
            effects: columns at this fit.
            blocks: contiguous parts of the flight.

        Returns:
            (E, blocks) chi2 in units of the scatter.
        """
        projected = [_project_out(self.Q, e.derivative) for e in effects]
        part = np.array_split(np.arange(len(self.Q)), blocks)
        delta_chi2_blocks = np.empty((len(effects), blocks))
        for b, inside in enumerate(part):
            others = np.setdiff1d(np.arange(len(self.Q)), inside)
            known = (
                np.einsum("wif,wig->fg", self.K[others], self.K[others], optimize=True) + self.prior
            )
            known += 1e-9 * np.diag(np.diag(known))
            shift = -np.linalg.solve(
                known, np.einsum("wif,wi->f", self.K[others], self.residual[others], optimize=True)
            )
            for e, (effect, E) in enumerate(zip(effects, projected, strict=True)):
                delta_chi2_blocks[e, b] = _score_test(
                    self, effect.variant, E, inside, known, shift
                ).delta_chi2
        return delta_chi2_blocks


def _score_test(
    fit: SchurComplement,
    variant: EffectVariant,
    projected: Array,
    inside: np.ndarray,
    precision: Array,
    shift: Array | None,
) -> ScoreTest:
    """Score test over some windows with the parameters known to a precision around a shifted mean."""
    E, K, r = projected[inside], fit.K[inside], fit.residual[inside]
    if shift is not None:
        r = r + K @ shift
    A = np.einsum("wif,wig->fg", K, K, optimize=True) + precision
    B = np.einsum("wif,wik->fk", K, E, optimize=True)
    D = np.einsum("wik,wil->kl", E, E, optimize=True)
    g_K = np.einsum("wif,wi->f", K, r, optimize=True) if shift is not None else np.zeros(K.shape[2])
    g_E = np.einsum("wik,wi->k", E, r, optimize=True)
    across = np.linalg.solve(A + 1e-9 * np.diag(np.diag(A)), np.column_stack([B, g_K]))
    S, pull = D - B.T @ across[:, :-1], g_E - B.T @ across[:, -1]
    size = np.sqrt(np.maximum(np.diag(D), 1e-30))
    seen, along = np.linalg.eigh(S / np.outer(size, size))
    along = (
        along[:, seen > MIN_EIGENVALUE] / size[:, None]
    )  # the others are what parameters do already
    step = -along @ ((along.T @ pull) / seen[seen > MIN_EIGENVALUE])
    names = [p.name for p in variant.effect.amplitudes]
    delta_chi2 = float(max(-pull @ step, 0.0)) / fit.reduced_chi2
    return ScoreTest(
        variant, delta_chi2, {**variant.values, **dict(zip(names, step.tolist(), strict=True))}
    )


def _project_out(Q: Array, J: Array) -> Array:
    return np.asarray(J - Q @ (Q.transpose(0, 2, 1) @ J))
