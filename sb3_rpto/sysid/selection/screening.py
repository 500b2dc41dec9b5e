"""Which candidates could the data show at all, and which look alike?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_rpto.fitting.loss import Loss
from sb3_rpto.sysid.settings import DEFAULTS, ScreeningSettings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem


@dataclass(frozen=True)
class Screening:
    """Rollout sensitivities of the candidates, orthogonal to the declared parameters.

    :param sensitivity: of each effect of the simulation, in units of noise for an effect of plausible size, (e,)
    :param cosine: likeness of the influences of effects, (e, e), 1 on the diagonal
    :param taken: of each effect that shows only in what declared parameters do, the likest of them, else None, (e,)
    :param settings: thresholds
    """

    sensitivity: np.ndarray
    cosine: np.ndarray
    taken: list[int | None]
    settings: ScreeningSettings = DEFAULTS.screening

    def excited(self, effect: int) -> bool:
        """Whether the data could show this effect."""
        return bool(self.sensitivity[effect] >= self.settings.excited)

    def alike(self, effect: int) -> list[int]:
        """The other excited effects of its class."""
        near = np.flatnonzero(np.abs(self.cosine[effect]) > self.settings.same)
        return [int(i) for i in near if i != effect and self.excited(int(i))]


def screen(problem: Problem, fit: Fit, settings: ScreeningSettings = DEFAULTS.screening) -> Screening:
    """Linearise at the null of every candidate.

    :param problem: training windows
    :param fit: of the declared parameters
    """
    simulation = problem.simulation
    strength = np.flatnonzero(simulation.strength)
    r, jt, jx = problem.linearise(fit.values, fit.starts, strength)
    # As if the model fitted: what noise alone would let the data show.
    reduced = problem.reduce(0 * r, jt, jx, 0 * fit.starts, Loss(3.0))
    known = problem.known[strength]
    c = np.flatnonzero(~known)
    perp = _orthogonal(reduced.normal.sum(0), known)
    # Near an unstable pose everything grows alike: each window has the same say in what looks like what.
    size = np.maximum(np.einsum("wff->f", reduced.normal), 1e-12)
    share = np.einsum("wff,f->w", reduced.normal, 1 / size)
    even = _orthogonal((reduced.normal / (share + 1e-3 * share.mean() + 1e-12)[:, None, None]).sum(0), known)
    count = len(simulation.effects)
    groups = [np.flatnonzero(np.isin(strength[c], np.arange(s.start, s.stop))) for s in simulation.slices]
    sensitivity, cosine = np.zeros(count), np.eye(count)
    for e, g in enumerate(groups):
        if len(g):
            sensitivity[e] = np.sqrt(max(0.0, float(np.linalg.eigvalsh(perp[np.ix_(g, g)])[-1])))
    roots = [_inverse_root(even[np.ix_(g, g)]) if len(g) else np.zeros((0, 0)) for g in groups]
    for a in range(count):
        for b in range(a):
            if len(roots[a]) and len(roots[b]):
                canonical = np.linalg.svd(roots[a] @ even[np.ix_(groups[a], groups[b])] @ roots[b].T, compute_uv=False)
                # The smaller group must lie in the larger one.
                cosine[a, b] = cosine[b, a] = round(float(np.clip(canonical.min(), 0, 1)), settings.digits)
    taken = _taken(problem, reduced.normal.sum(0), sensitivity, settings)
    return Screening(sensitivity, cosine, taken, settings)


def _taken(
    problem: Problem, normal: np.ndarray, sensitivity: np.ndarray, settings: ScreeningSettings
) -> list[int | None]:
    """Of each effect the known one that does the same, see :class:`Screening`.

    :param normal: of all strengths, (f, f)
    """
    simulation = problem.simulation
    strength = np.flatnonzero(simulation.strength)
    groups = [np.flatnonzero(np.isin(strength, np.arange(s.start, s.stop))) for s in simulation.slices]
    known = [e for e, effect in enumerate(simulation.effects) if effect.known]
    size = np.sqrt(np.maximum(np.diag(normal), 1e-12))
    likeness = np.abs(normal / size / size[:, None]).round(settings.digits)
    taken: list[int | None] = []
    for e, g in enumerate(groups):
        alone = np.sqrt(max(0.0, float(np.linalg.eigvalsh(normal[np.ix_(g, g)])[-1]))) if len(g) else 0.0
        hidden = e not in known and known and sensitivity[e] < settings.excited <= alone
        taken.append(max(known, key=lambda d: float(likeness[np.ix_(groups[d], g)].max())) if hidden else None)
    return taken


def _orthogonal(normal: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The normal matrix of the candidates after the declared parameters have taken what they can."""
    d, c = np.flatnonzero(known), np.flatnonzero(~known)
    if not len(d):
        return normal
    # Declared parameters that the data leave open must not hide anything: a small ridge holds them.
    inner = normal[np.ix_(d, d)] + (1e-9 * np.trace(normal[np.ix_(d, d)]) + 1e-12) * np.eye(len(d))
    return normal[np.ix_(c, c)] - normal[np.ix_(c, d)] @ np.linalg.solve(inner, normal[np.ix_(d, c)])


def _inverse_root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    keep = values > 1e-9 * max(values.max(), 1e-12)
    return (vectors[:, keep] / np.sqrt(values[keep])).T
