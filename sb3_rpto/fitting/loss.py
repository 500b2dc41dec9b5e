"""The robust loss of the fits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Typical error, in units of the noise, above which it is the model's more than the noise's.
FAR = 2.0
#: The loss turns linear at so many typical residuals: contacts and outliers are borne, noise is squared.
CLIP = 3.0


class Loss(NamedTuple):
    """Soft-L1: quadratic for small residuals, linear for large ones.

    :param clip: where the loss of a residual turns linear
    """

    clip: float

    @classmethod
    def of(cls, r: np.ndarray, least: float = 1.0) -> Loss:
        """The loss that fits residuals of this size: it turns linear at :data:`CLIP` typical ones.

        :param r: residuals of any shape
        :param least: the typical residual is taken to be this at least. Residuals in units of the noise are not
            smaller than 1 by more than chance; those in other units may be, up to rounding
        """
        return cls(CLIP * max(least, 1.4826 * float(np.median(np.abs(r)))))

    @property
    def model_error_dominates(self) -> bool:
        """Whether the typical residual, in units of the noise, is the model's more than the noise's."""
        return self.clip > CLIP * FAR

    def cost(self, r: np.ndarray) -> np.ndarray:
        """Loss of each residual; of small ones the square."""
        return np.asarray(2 * self.clip**2 * (np.sqrt(1 + (r / self.clip) ** 2) - 1))

    def weights(self, r: np.ndarray, share: float | np.ndarray = 1.0) -> np.ndarray:
        """Weights of the residuals in the least squares that stand for the loss in a step: these have its slope.

        :param r: residuals
        :param share: of each residual in the cost, as it broadcasts with ``r``
        """
        return np.asarray(share / np.sqrt(1 + (r / self.clip) ** 2))

    def second_derivative(self, r: np.ndarray) -> np.ndarray:
        """Half of the loss's own second derivative: less than the :meth:`weights`."""
        return np.asarray((1 + (r / self.clip) ** 2) ** -1.5)

    def curvature(self, r: np.ndarray) -> float:
        """How curved the loss is, as a share of the weighted least squares that stand for it in a step.

        An estimate moves by the gradient over the curvature (Huber 1964): over the weights alone it would seem to
        scatter less than it does.
        """
        bent = 1 + (r / self.clip) ** 2
        return float(np.mean(bent**-1.5) / np.mean(bent**-0.5))
