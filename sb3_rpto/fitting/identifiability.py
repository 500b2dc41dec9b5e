"""Which parameters data cannot tell apart, from the derivatives of a fit's residuals."""

from __future__ import annotations

import numpy as np

#: A direction of phi in which the squared residuals change by less than this share of the most sensitive one (each
#: parameter by as much as moves the residuals alike) is not determined. On gymnasium's tasks directions that physics
#: does not determine come out below 2e-9 (contacts end their iterations early), all others above 2e-6.
NULL = 5e-8
#: Parameters with less than this share of a direction's largest one do not belong to it.
LOAD = 0.05
#: A parameter that moves no residual by this share of the typical one, for a change by its scale, is not identified.
INSENSITIVE = 1e-3


def sensitive(jacobian: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Which parameters move the residuals (m,) at all, by the derivatives (m, p); (p,), bool."""
    size = np.sqrt((jacobian**2).sum(axis=0))
    return np.asarray(size >= INSENSITIVE * max(float(np.sqrt((residuals**2).sum())), 1e-6))


def null_directions(normal: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Directions in which phi moves no residual although its parameters do one by one, (p, k), orthonormal, in scales.

    Their span alone is determined: shares in it do not depend on the directions that the solver takes for it.

    :param normal: Gauss-Newton matrix of the residuals by phi in scales, (p, p)
    :param shown: parameters that move residuals at all, (p,); the others belong to no direction
    """
    size = np.sqrt(np.diag(normal))
    free = np.flatnonzero(shown & (size > 0))
    if len(free) < 2:
        return np.zeros((len(normal), 0))
    eigenvalues, vectors = np.linalg.eigh(normal[np.ix_(free, free)] / np.outer(size[free], size[free]))
    found = vectors[:, eigenvalues < NULL * eigenvalues[-1]]
    directions = np.zeros((len(normal), found.shape[1]))
    directions[free] = found / size[free, None]
    return np.asarray(np.linalg.qr(directions)[0])


def confounded_parameters(directions: np.ndarray) -> np.ndarray:
    """Parameters that have a share in one of the directions (p, k), (p,), bool."""
    share = np.linalg.norm(directions, axis=1)
    return np.asarray(share > LOAD * share.max(initial=0.0))


def parameters_to_fix(directions: np.ndarray) -> np.ndarray:
    """One parameter for each of the directions (p, k), such that with them fixed the others are determined, (p,), bool.

    The later ones are fixed: a choice by the order of declaration stays the same from fit to fit.
    """
    fixed = np.zeros(len(directions), dtype=bool)
    while directions.shape[1]:
        last = np.flatnonzero(confounded_parameters(directions))[-1]
        fixed[last] = True
        # What remains of the space of directions while this parameter stays.
        _, _, rows = np.linalg.svd(directions[last : last + 1])
        directions = directions @ rows[1:].T
    return fixed
