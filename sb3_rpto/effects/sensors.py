"""What a joint's sensor shows."""

import numpy as np

from sb3_rpto.effects.effect import Effect, Parameter, register

Pair = tuple[np.ndarray, np.ndarray]


def _along(x: np.ndarray, q: np.ndarray) -> np.ndarray:
    """A parameter (n,) with axes added so that it spreads over (n, ...)."""
    return x.reshape(x.shape + (1,) * (q.ndim - x.ndim))


@register
class SensorBias(Effect):
    """An encoder whose zero is wrong: it shows :math:`q + b`; the speed is right."""

    kind = "sensor_bias"
    place = "sensor"
    parameters = (Parameter("offset", "rad", lambda s: 0.01 * s.span),)
    equation = "q_shown = q + offset"
    excite = "poses at which gravity or a spring tells where zero is"

    def observe(self, q: np.ndarray, v: np.ndarray, x: np.ndarray) -> Pair:
        """Shift the position."""
        return q + _along(x[..., 0], q), v

    def unobserve(self, q: np.ndarray, v: np.ndarray, x: np.ndarray) -> Pair:
        """Shift it back."""
        return q - _along(x[..., 0], q), v


@register
class SensorGain(Effect):
    r"""A wrong scale of an encoder or potentiometer: it shows :math:`(1 + g)\,q` and :math:`(1 + g)\,\dot q`."""

    kind = "sensor_gain"
    place = "sensor"
    parameters = (Parameter("change", "", 0.01, lower=-0.5, upper=1.0),)
    equation = "q_shown = (1 + change) q"
    excite = "positions far from zero"

    def observe(self, q: np.ndarray, v: np.ndarray, x: np.ndarray) -> Pair:
        """Scale position and velocity."""
        gain = 1 + _along(x[..., 0], q)
        return q * gain, v * gain

    def unobserve(self, q: np.ndarray, v: np.ndarray, x: np.ndarray) -> Pair:
        """Scale them back."""
        gain = 1 + _along(x[..., 0], q)
        return q / gain, v / gain
