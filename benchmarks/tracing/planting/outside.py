"""Effects that no library of forces, delays and gains explains: a tracer must say that it cannot."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.tracing.planting.plants import Plant


@dataclass
class Outside(Plant):
    """An effect outside the library."""

    library = False


@dataclass
class Flexible(Outside):
    """Elastic transmission: the motor's rotor has a hidden angle r and drives the joint through a spring.

    J rdd = u - T,  T = k (r - q) + d (rd - qd),  and T drives the joint; J = ``inertia``, k = ``stiffness``,
    d = ``damping``. An infinite stiffness is the rigid machine without the rotor.
    """

    inertia: float = 1.0
    stiffness: float = np.inf
    damping: float = 0.0
    kind = "flexible"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._r, self._rate = q.copy(), np.zeros_like(q)

    def drive(self, tau: np.ndarray, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        if np.isinf(self.stiffness):
            return tau
        middle = self._r + h / 2 * self._rate
        transmitted = self.stiffness * (middle - q) + self.damping * (self._rate - v)
        self._rate = self._rate + h / self.inertia * (tau - transmitted)
        self._r = middle + h / 2 * self._rate
        return transmitted


@dataclass
class BoucWen(Outside):
    """Hysteresis: tau = -F z, dz/dt = (qd - |qd| |z| z) / s; F = ``torque``, s = ``travel`` to yield.

    Long travel: neither a spring (it yields) nor friction (it pulls back after a stop).
    """

    torque: float = 0.0
    travel: float = 1.0
    kind = "bouc_wen"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._z = np.zeros_like(q)

    def disturb(self, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray | float:
        z = self._z
        self._z = z + h / self.travel * (v - np.abs(v) * np.abs(z) * z)
        return -self.torque * (z + self._z) / 2


@dataclass
class Thermal(Outside):
    """The motor grows weaker as it warms: u becomes u (1 - drop min(t / duration, 1))."""

    drop: float = 0.0
    duration: float = 4.0
    kind = "thermal"

    def drive(self, tau: np.ndarray, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        return tau * (1 - self.drop * np.minimum(t / self.duration, 1.0))


@dataclass
class WindGusts(Outside):
    """tau = A sin(2 pi f t + p): A = ``torque``, f = ``frequency``; p is drawn for each episode and not recorded."""

    torque: float = 0.0
    frequency: float = 1.0
    kind = "wind_gusts"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._phase = rng.uniform(0, 2 * np.pi, len(q))

    def disturb(self, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray | float:
        return self.torque * np.sin(2 * np.pi * self.frequency * (t + h / 2) + self._phase)


@dataclass
class RandomWalk(Outside):
    """tau = w, dw = ``rate`` dW: Brownian, from zero; its standard deviation after t is rate sqrt(t)."""

    rate: float = 0.0
    kind = "random_walk"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._w, self._rng = np.zeros_like(q), rng

    def disturb(self, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray | float:
        self._w = self._w + self.rate * np.sqrt(h) * self._rng.standard_normal(len(h))
        return self._w


OUTSIDE: Sequence[type[Plant]] = (Thermal, Flexible, BoucWen, WindGusts, RandomWalk)
"""What a tracer must call unexplained; those of the motor in the order in which they act."""
