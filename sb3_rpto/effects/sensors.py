"""What a joint's sensor shows, to whoever records it and, but for a delay, to the servo that regulates it."""

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import JOINTS, joints_of_tendon
from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.effect import Effect, Parameter, register

Pair = tuple[np.ndarray, np.ndarray]


def _along(x: np.ndarray, q: np.ndarray) -> np.ndarray:
    """A parameter (n,) with axes added so that it spreads over (n, ...)."""
    return x.reshape(x.shape + (1,) * (q.ndim - x.ndim))


def readers(sensor: Effect, model: mujoco.MjModel) -> dict[int, float]:
    """The actuators that feed back the sensor's position, kp (u - q) for one, with gear g kp (u - g q).

    :return: how much of the position their length has, without gear: all, or a fixed tendon's coefficient
    """
    feedback = (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE) & (model.actuator_biasprm[:, 1] != 0)
    lengths = {int(a): _lengths(model, int(a)).get(sensor.index, 0.0) for a in np.flatnonzero(feedback)}
    return {a: share for a, share in lengths.items() if share}


def _lengths(model: mujoco.MjModel, actuator: int) -> dict[int, float]:
    """The joints whose positions an actuator's length sums, each with its factor; none of other kinds of length."""
    if model.actuator_trntype[actuator] in JOINTS:
        return {int(model.actuator_trnid[actuator, 0]): 1.0}
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_TENDON:
        return {}
    return joints_of_tendon(model, actuator) or {}


def ago(steps: np.ndarray, q: np.ndarray, v: np.ndarray) -> Pair:
    """Position and velocity of a joint some time ago, between two steps in a straight line; at most at the first.

    :param steps: how long ago, (n,)
    :param q: positions of K + 1 steps, the newest last, (n, K + 1)
    :param v: velocities, likewise
    :return: (n,) each
    """
    last = q.shape[1] - 1
    at = np.maximum(last - steps, 0.0)
    k = at.astype(int)
    rows, part, after = np.arange(len(q)), at - k, np.minimum(k + 1, last)
    return (1 - part) * q[rows, k] + part * q[rows, after], (1 - part) * v[rows, k] + part * v[rows, after]


@register
class SensorDelay(Effect):
    r"""A sensor that is late, by its bus or its filter: it shows :math:`q(t - d)` and :math:`\dot q(t - d)`.

    A position servo regulates what is there now: in MuJoCo it reads no sensor. Before an episode has lasted so long, it
    shows the first state. Where all sensors are as late as each other, the
    recordings are those of late commands. A constant delay from sensor to controller (Nilsson 1998).
    """

    kind = "sensor_delay"
    place = "sensor"
    parameters = (Parameter("delay", "s", 0.005, lower=0.0, upper=0.1),)
    equation = "q_shown = q(t - delay)"
    excite = "fast motion, and more than one joint: else it is a late command"

    def late(self, x: np.ndarray) -> np.ndarray:
        """The delay."""
        return x[..., 0]


@register
class SensorBias(Effect):
    """An encoder whose zero is wrong: it shows :math:`q + b`; the speed is right.

    The joint offset of a robot's geometric calibration (Khalil & Dombre 2002). A position servo on the joint, or on a
    fixed tendon with it, regulates what it shows, :math:`k_p (u - q - b)`.
    """

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

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Feed back what is shown."""
        for i, share in readers(self, batch.model).items():
            bias, gear = batch.field("actuator_biasprm"), batch.field("actuator_gear")
            bias[:, i, 0] += bias[:, i, 1] * gear[:, i, 0] * share * x[:, 0]


@register
class SensorGain(Effect):
    r"""A wrong scale of an encoder or potentiometer: it shows :math:`(1 + g)\,q` and :math:`(1 + g)\,\dot q`.

    The joint transducers' part of a robot's calibration (Mooring, Roth & Driels 1991). A position servo on the joint,
    or on a fixed tendon of it alone, regulates what it shows, :math:`k_p (u - (1 + g) q)`; feedback of the speed may
    be back-EMF, and stays. One on a tendon of several joints regulates the true length.
    """

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

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Feed back what is shown."""
        alone = [i for i in readers(self, batch.model) if len(_lengths(batch.model, i)) == 1]
        for i in alone:
            batch.field("actuator_biasprm")[:, i, 1] *= 1 + x[:, 0]
