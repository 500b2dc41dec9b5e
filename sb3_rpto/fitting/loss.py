"""The robust loss of the fits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Typical error, in units of the noise, above which it is the model's more than the noise's.
FAR = 2.0


class Loss(NamedTuple):
    """Soft-L1, and how firmly the starts are held.

    :param clip: where the loss of a residual turns linear: at three typical ones, at least three units of noise
    """

    clip: float

    @property
    def far(self) -> bool:
        """Whether the typical residual is the model's more than the noise's."""
        return self.clip > 3 * FAR

    @property
    def hold(self) -> float:
        """Weight of the starts: where the model errs by more than noise, they must not make up for it."""
        return (self.clip / 3) ** 2

    def curvature(self, r: np.ndarray) -> float:
        """How curved the loss is, as a share of the weighted least squares that stand for it in a step.

        An estimate moves by the gradient over the curvature (Huber 1964): over the weights alone it would seem to
        scatter less than it does.
        """
        bent = 1 + (r / self.clip) ** 2
        return float(np.mean(bent**-1.5) / np.mean(bent**-0.5))

    @classmethod
    def of(cls, r: np.ndarray) -> Loss:
        """The loss that fits residuals of this size."""
        return cls(3 * max(1.0, 1.4826 * float(np.median(np.abs(r)))))

    def energy(self, r: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Robust sum of squares of each window with its start, (..., W)."""
        soft = 2 * self.clip**2 * (np.sqrt(1 + (r / self.clip) ** 2) - 1)
        return soft.sum(-1) + self.hold * (starts**2).sum(-1)
