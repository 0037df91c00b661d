"""Evidence: a fit and an effect's sensitivities -> the chi2 that the effect would explain.

Score test [Rao 1948]: the fit has all derivatives, an effect adds a few columns. Initial states and
aircraft parameters, free under their prior, are eliminated; one unknown per amplitude remains.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.gap.linear_response import EffectVariant, Sensitivities, linear_response
from falconwing_kit.sysid.fit import FitResult, Prior, prior_rows
from falconwing_kit.sysid.shooting import Windows

# Share of an effect's signal outside the span of parameters and initial states: below, no evidence.
MIN_EIGENVALUE = 1e-4


@dataclass(frozen=True)
class ScoreTest:
    """Linear evidence for a variant, from one Gauss-Newton step."""

    variant: EffectVariant
    delta_chi2: float  # chi2 it would explain
    values: dict[str, float]  # all parameters, the amplitudes after the step


def effect_variants(catalogue: Sequence[Effect], windows: Windows) -> Iterator[EffectVariant]:
    """Every effect at every scan point, over the area that the windows cover.

    Effects with the dynamics of another one (`same_as`) are left out.
    """
    flown = windows.pose[..., :2][windows.weight[..., 0] > 0]
    low, high = np.percentile(flown, [3.0, 97.0], axis=0)
    for effect in catalogue:
        if not effect.same_as:
            yield from (EffectVariant(effect, values) for values in effect.scan(low, high))


def sensitivities(
    model: Model, windows: Windows, starts: Array, tried: Sequence[EffectVariant]
) -> list[Sensitivities]:
    """Sensitivities of the variants by the linearised flight; a shape stays at its scan point.

    Args:
        model: the aircraft without the effects.
        windows: W windows.
        starts: (W, n_states) initial states.
        tried: the variants.
    """
    return list(linear_response(model, windows, starts).sensitivities(tried))


@dataclass(frozen=True)
class SchurComplement:
    """A fit with its initial states eliminated window by window."""

    Q: Array  # (W, R, n) orthonormal basis of the initial states' derivatives
    K: Array  # (W, R, F) parameter derivatives, projected out of that span
    residual: Array  # (W, R) likewise
    prior: Array  # (F, F) precision of the prior
    reduced_chi2: float  # chi2 per degree of freedom

    @classmethod
    def of(cls, result: FitResult, prior: Prior | None, reduced_chi2: float) -> "SchurComplement":
        """Eliminate the initial states of a fit that used this prior."""
        Q, _ = np.linalg.qr(result.initial_state_jacobian)
        rows, _ = prior_rows(result.model, result.free, prior)
        return cls(
            Q,
            _project_out(Q, result.parameter_jacobian),
            _project_out(Q, result.residual[..., None])[..., 0],
            rows.T @ rows,
            reduced_chi2,
        )

    @cached_property
    def normal(self) -> Array:
        """(F, F) K'K + P, normal matrix of the parameters over all windows, regularised."""
        return _regularise(np.einsum("wif,wig->fg", self.K, self.K, optimize=True) + self.prior)

    def score(self, effect: Sensitivities) -> ScoreTest:
        """Linear evidence for an effect over all windows."""
        E = _project_out(self.Q, effect.derivative)
        # At the fit's minimum the parameters have no gradient.
        no_pull = np.zeros(self.K.shape[2])
        return _score_test(self, effect.variant, E, self.K, self.residual, self.normal, no_pull)

    def information(self, effect: Sensitivities) -> tuple[Array, Array]:
        """Chi2 that each amplitude explains per square of its size, on average, when it acts alone.

        E'E - E'K (K'K + P)^-1 K'E, the noncentrality of the score test [Wald 1943]: E and K the
        derivatives of the effect and of the parameters outside the span of the initial states, P
        the parameters' prior.

        Returns:
            (A,) with the parameters free under their prior, and (A,) with the parameters known.
        """
        E = _project_out(self.Q, np.nan_to_num(effect.derivative, posinf=0.0, neginf=0.0))
        B = np.einsum("wif,wik->fk", self.K, E, optimize=True)
        known = np.einsum("wik,wik->k", E, E, optimize=True)
        return known - np.einsum("fk,fk->k", B, np.linalg.solve(self.normal, B)), known

    def inflation(
        self, effect: Sensitivities, next_prior: Array | None = None, next_factor: float = 1.0
    ) -> float:
        """Variance factor of an effect's score: its variance over that of white residuals.

        One where residuals are noise; more where the model errs alike all through a window, so that
        the same chi2 means less [White 1980; Liang & Zeger 1986, clustered by window]. In another
        flight like this one the parameters come with an error too, which the effect is taken for.
        With A = K'K + P, B = K'e, D = A^-1 B and E = e - K D for an effect's derivative e, the
        score and its variance, white and true, are

            sum_w E'r + D'P (k - mean):   chi2 E'E + D'P D   and   sum_w (E'r)(E'r)' + f D'P D,

        where r are the residuals that the effect leaves: what it explains alike in all windows is
        no scatter.

        Args:
            effect: its sensitivities at this fit.
            next_prior: (F, F) P, precision of the parameters' prior in another flight; None: the
                effect is judged in this flight, with the parameters that fit it best.
            next_factor: f, variance factor of that prior.
        """
        E = _project_out(self.Q, effect.derivative)
        B = np.einsum("wif,wik->fk", self.K, E, optimize=True)
        step = self.score(effect).values
        amplitudes = np.array([step[p.name] for p in effect.variant.effect.amplitudes])
        # What the parameters do not imitate of the effect, when both are fitted to this flight.
        left = self.residual + (E - self.K @ np.linalg.solve(self.normal, B)) @ amplitudes
        prior = self.prior if next_prior is None else next_prior
        across = np.linalg.solve(_regularise(self.normal - self.prior + prior), B)
        of_parameters = np.zeros((E.shape[2],) * 2)
        if next_prior is not None:
            of_parameters = across.T @ next_prior @ across
        return _variance_factor(
            E - self.K @ across, left, self.reduced_chi2, of_parameters, next_factor
        )

    def own_inflation(self, columns: Sequence[int]) -> float:
        """The variance factor for parameters of the fit itself, such as those of an effect in it.

        The residuals are those of the full fit: no linear step from a fit without the effect, which
        a strong one such as a stall exceeds.

        Args:
            columns: which of the free parameters.
        """
        if not columns:
            return 1.0
        others = [k for k in range(self.K.shape[2]) if k not in columns]
        E, K = self.K[..., list(columns)], self.K[..., others]
        B = np.einsum("wif,wik->fk", K, E, optimize=True)
        E = E - K @ np.linalg.solve(self.normal[np.ix_(others, others)], B)
        return _variance_factor(
            E, self.residual, self.reduced_chi2, np.zeros((len(columns),) * 2), 1.0
        )

    def block_delta_chi2(self, effects: Sequence[Sensitivities], blocks: int = 3) -> Array:
        """Evidence that effects have on parts of a baseline flight: the false-alarm level.

        Parameters are estimated on the other parts alone, as for another flight; what an effect
        explains here is noise and model error.

        Args:
            effects: sensitivities at this fit.
            blocks: contiguous parts of the flight.

        Returns:
            (E, blocks) chi2 in units of the reduced chi2.
        """
        projected = [_project_out(self.Q, e.derivative) for e in effects]
        part = np.array_split(np.arange(len(self.Q)), blocks)
        delta_chi2_blocks = np.empty((len(effects), blocks))
        for b, inside in enumerate(part):
            others = np.setdiff1d(np.arange(len(self.Q)), inside)
            known = (
                np.einsum("wif,wig->fg", self.K[others], self.K[others], optimize=True) + self.prior
            )
            known = _regularise(known)
            # Where the other parts alone would put the parameters.
            shift = -np.linalg.solve(
                known, np.einsum("wif,wi->f", self.K[others], self.residual[others], optimize=True)
            )
            # Normal equations of the parameters on this part, the same for every effect.
            K, r = self.K[inside], self.residual[inside]
            r = r + K @ shift
            A = _regularise(np.einsum("wif,wig->fg", K, K, optimize=True) + known)
            g_K = np.einsum("wif,wi->f", K, r, optimize=True)
            for e, (effect, E) in enumerate(zip(effects, projected, strict=True)):
                delta_chi2_blocks[e, b] = _score_test(
                    self, effect.variant, E[inside], K, r, A, g_K
                ).delta_chi2
        return delta_chi2_blocks


def _variance_factor(
    E: Array, left: Array, reduced_chi2: float, of_parameters: Array, factor: float
) -> float:
    """Variance of scores clustered by window over that of white residuals, mean of directions.

    Args:
        E: (W, R, A) derivatives of the effect, outside the span of all else that is fitted.
        left: (W, R) residuals that the effect leaves.
        reduced_chi2: variance of a white residual.
        of_parameters: (A, A) variance from parameters that another flight brings.
        factor: f, variance factor of those.
    """
    scores = np.einsum("wik,wi->wk", E, left, optimize=True)
    white = reduced_chi2 * np.einsum("wik,wil->kl", E, E, optimize=True) + of_parameters
    clustered = scores.T @ scores * len(E) / max(len(E) - 1, 1) + factor * of_parameters
    if not (np.isfinite(white).all() and np.isfinite(clustered).all()):
        return 1.0
    size = np.sqrt(np.maximum(np.diag(white), 1e-30))
    ratio = np.linalg.lstsq(white / np.outer(size, size), clustered / np.outer(size, size))[0]
    return float(np.trace(ratio)) / len(size)


def _score_test(
    fit: SchurComplement,
    variant: EffectVariant,
    E: Array,
    K: Array,
    r: Array,
    A: Array,
    g_K: Array,
) -> ScoreTest:
    """Score test over some windows, from the normal equations [A B; B' D] and their gradients.

    Args:
        fit: gives the reduced chi2.
        variant: the effect at a scan point.
        E: (W, R, A) its derivatives, K: (W, R, F) those of the parameters, r: (W, R) residuals;
            all outside the span of the initial states.
        A: (F, F) regularised normal matrix of the parameters, g_K: (F,) their gradient.
    """
    B = np.einsum("wif,wik->fk", K, E, optimize=True)
    D = np.einsum("wik,wil->kl", E, E, optimize=True)
    g_E = np.einsum("wik,wi->k", E, r, optimize=True)
    across = np.linalg.solve(A, np.column_stack([B, g_K]))
    # Eliminate the parameters: S = D - B' A^-1 B, gradient g_E - B' A^-1 g_K.
    S, pull = D - B.T @ across[:, :-1], g_E - B.T @ across[:, -1]
    if not (np.isfinite(S).all() and np.isfinite(pull).all()):
        return ScoreTest(variant, 0.0, dict(variant.values))
    size = np.sqrt(np.maximum(np.diag(D), 1e-30))
    # Step in the eigenvectors that the parameters do not imitate.
    seen, along = np.linalg.eigh(S / np.outer(size, size))
    along = along[:, seen > MIN_EIGENVALUE] / size[:, None]
    step = -along @ ((along.T @ pull) / seen[seen > MIN_EIGENVALUE])
    names = [p.name for p in variant.effect.amplitudes]
    delta_chi2 = float(max(-pull @ step, 0.0)) / fit.reduced_chi2
    return ScoreTest(
        variant, delta_chi2, {**variant.values, **dict(zip(names, step.tolist(), strict=True))}
    )


def _regularise(A: Array) -> Array:
    """A with a little more on its diagonal, and one where a parameter has no information at all."""
    diagonal = np.diag(A)
    return np.asarray(A + np.diag(np.where(diagonal > 0.0, 1e-9 * diagonal, 1.0)))


def _project_out(Q: Array, J: Array) -> Array:
    return np.asarray(J - Q @ (Q.transpose(0, 2, 1) @ J))
