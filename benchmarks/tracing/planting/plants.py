"""Effects that may be planted in a machine, each with its own equation: nothing of it is shared with the tracer.

Order of the chain from command to joint: deadband, saturation, gain, backlash (once a sample), then delay and lag.
Arrays are (E,) for E episodes at the plant's own joint, or (E, n) over all joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from benchmarks.tracing.planting.systems import System


@dataclass
class Plant:
    """One effect at one joint; the methods here do nothing. Every field but ``joint`` is a parameter in SI units.

    :param joint: index of the joint it acts on; the last one for effects of the whole machine
    """

    joint: int
    kind: ClassVar[str]
    library: ClassVar[bool] = True
    """False for what no effect of the tracer's library can explain."""

    @property
    def parameters(self) -> dict[str, float]:
        """True values in SI units."""
        return {f.name: float(getattr(self, f.name)) for f in fields(self) if f.name != "joint"}

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        """Forget the past: episodes begin at positions ``q`` (E,) of the joint."""

    def body(self, system: System) -> System:
        """Change the rigid bodies."""
        return system

    def command(self, u: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Change the command that is given at time ``t`` (E,); called once a sample, in order of time."""
        return u

    def drive(self, tau: np.ndarray, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Change the motor's mean torque over the step from ``t`` to ``t + h``; called once a step."""
        return tau

    def disturb(self, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray | float:
        """Force with a memory of its own; called once a step."""
        return 0.0

    def force(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | float:
        """Force that is a function of position and velocity."""
        return 0.0

    def bound(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray | float:
        """Largest dry friction, >= 0; the step opposes motion with it, or holds the joint with what that takes."""
        return 0.0

    def record(self, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> None:
        """Keep the state of the joint at time ``t`` (E,); called at the start and after every step."""

    def sense(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the joint's sensor says of a position and a velocity."""
        return q, v


@dataclass
class CoulombFriction(Plant):
    """tau = -F sign(qd), F = ``torque``."""

    torque: float = 0.0
    kind = "coulomb_friction"

    def bound(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray | float:
        return self.torque


@dataclass
class StribeckFriction(Plant):
    """tau = -(Fc + (Fs - Fc) exp(-(qd / vs)^2)) sign(qd); Fc = ``coulomb``, Fs = ``static``, vs = ``speed``."""

    coulomb: float = 0.0
    static: float = 0.0
    speed: float = 0.1
    kind = "stribeck_friction"

    def bound(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray | float:
        return self.coulomb + (self.static - self.coulomb) * np.exp(-((v / self.speed) ** 2))


@dataclass
class LoadFriction(Plant):
    """tau = -mu |tau_motor| sign(qd), mu = ``coefficient``."""

    coefficient: float = 0.0
    kind = "load_friction"

    def bound(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray | float:
        return self.coefficient * np.abs(tau)


@dataclass
class PositionFriction(Plant):
    """tau = -F (1 + cos(q - phase)) / 2 sign(qd), F = ``torque``."""

    torque: float = 0.0
    phase: float = 0.0
    kind = "position_friction"

    def bound(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray | float:
        return self.torque * (1 + np.cos(q - self.phase)) / 2


@dataclass
class QuadraticDrag(Plant):
    """tau = -c |qd| qd, c = ``coefficient``."""

    coefficient: float = 0.0
    kind = "quadratic_drag"

    def force(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | float:
        return -self.coefficient * np.abs(v) * v


@dataclass
class AsymmetricDamping(Plant):
    """tau = -b max(qd, 0), b = ``forward``: damping beyond the declared one in one direction only."""

    forward: float = 0.0
    kind = "asymmetric_damping"

    def force(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | float:
        return -self.forward * np.maximum(v, 0.0)


@dataclass
class TorqueRipple(Plant):
    """tau = a sin(n q) + b cos(n q) with a = ``sine``, b = ``cosine`` and n = 6 per turn."""

    sine: float = 0.0
    cosine: float = 0.0
    kind = "torque_ripple"
    per_turn: ClassVar[int] = 6

    def force(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | float:
        return self.sine * np.sin(self.per_turn * q) + self.cosine * np.cos(self.per_turn * q)


@dataclass
class TorqueOffset(Plant):
    """tau = c, c = ``torque``."""

    torque: float = 0.0
    kind = "torque_offset"

    def force(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | float:
        return self.torque


@dataclass
class Spring(Plant):
    """tau = -k q, k = ``stiffness``."""

    stiffness: float = 0.0
    kind = "spring"

    def force(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | float:
        return -self.stiffness * q


@dataclass
class GravityTilt(Plant):
    """Gravity becomes g (sin ``angle``, 0, -cos ``angle``), from where the machine has it."""

    angle: float = 0.0
    kind = "gravity_tilt"

    def body(self, system: System) -> System:
        return replace(system, tilt=system.tilt + self.angle)


@dataclass
class Payload(Plant):
    """A point ``mass`` at the end of the last link, beside what it carries."""

    mass: float = 0.0
    kind = "payload"

    def body(self, system: System) -> System:
        return replace(system, payload=system.payload + self.mass)


@dataclass
class Armature(Plant):
    """``inertia`` added to the joint's own diagonal of M."""

    inertia: float = 0.0
    kind = "armature"

    def body(self, system: System) -> System:
        links = list(system.links)
        links[self.joint] = replace(links[self.joint], armature=links[self.joint].armature + self.inertia)
        return replace(system, links=tuple(links))


@dataclass
class CommandDeadband(Plant):
    """u becomes sign(u) max(|u| - d, 0), d = ``width``."""

    width: float = 0.0
    kind = "command_deadband"

    def command(self, u: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.sign(u) * np.maximum(np.abs(u) - self.width, 0.0)


@dataclass
class CommandSaturation(Plant):
    """u becomes min(max(u, -s), s), s = ``limit``."""

    limit: float = np.inf
    kind = "command_saturation"

    def command(self, u: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.clip(u, -self.limit, self.limit)


@dataclass
class CommandGain(Plant):
    """u becomes g u, g = ``gain``."""

    gain: float = 1.0
    kind = "command_gain"

    def command(self, u: np.ndarray, t: np.ndarray) -> np.ndarray:
        return self.gain * u


@dataclass
class Backlash(Plant):
    """Play in the command: w = min(max(w, u - gap / 2), u + gap / 2), zero at first; w drives the motor.

    The classical play operator on the command: ``gap`` is in N·m, not the free travel of a gear in rad.
    """

    gap: float = 0.0
    kind = "backlash"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._w = np.zeros_like(q)

    def command(self, u: np.ndarray, t: np.ndarray) -> np.ndarray:
        self._w = np.clip(self._w, u - self.gap / 2, u + self.gap / 2)
        return self._w


@dataclass
class CommandDelay(Plant):
    """u becomes u(t - d), d = ``delay`` in s, any fraction of a sample; the command is zero before the episode.

    The held command is a staircase, so its mean over a step is exact: sum_i u_i overlap_i / h.
    """

    delay: float = 0.0
    kind = "command_delay"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._times, self._values = np.empty((0, len(q))), np.empty((0, len(q)))

    def command(self, u: np.ndarray, t: np.ndarray) -> np.ndarray:
        ended = np.zeros(len(self._times), bool)
        ended[:-1] = (self._times[1:] < t - self.delay).all(1)
        self._times = np.vstack([self._times[~ended], t])
        self._values = np.vstack([self._values[~ended], u])
        return u

    def drive(self, tau: np.ndarray, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        if self.delay == 0:
            return tau
        start = np.maximum(self._times, t - self.delay)
        ends = np.vstack([self._times[1:], np.full((1, len(t)), np.inf)])
        overlap = np.maximum(np.minimum(ends, t + h - self.delay) - start, 0.0)
        return (self._values * overlap).sum(0) / h


@dataclass
class ActuatorLag(Plant):
    """du_f/dt = (u - u_f) / tau with tau = ``time_constant``; u_f drives the motor and starts at zero.

    u holds within a step, so u_f = u + (u_f(0) - u) exp(-t / tau) and its mean over the step are exact.
    """

    time_constant: float = 0.0
    kind = "actuator_lag"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._filtered = np.zeros_like(q)

    def drive(self, tau: np.ndarray, q: np.ndarray, v: np.ndarray, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        if self.time_constant == 0:
            return tau
        behind, decay = self._filtered - tau, np.expm1(-h / self.time_constant)
        self._filtered = self._filtered + behind * decay
        return tau - behind * decay * self.time_constant / h


@dataclass
class SensorBias(Plant):
    """The sensor says q + ``bias``."""

    bias: float = 0.0
    kind = "sensor_bias"

    def sense(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return q + self.bias, v


@dataclass
class SensorGain(Plant):
    """The sensor says ``gain`` q and, as the velocity comes from the same encoder, ``gain`` qd."""

    gain: float = 1.0
    kind = "sensor_gain"

    def sense(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.gain * q, self.gain * v


@dataclass
class SensorDelay(Plant):
    """The sensor says q(t - d) and qd(t - d), d = ``delay`` in s; before the episode, its first state.

    Between two steps the position is their cubic, the velocity its derivative.
    """

    delay: float = 0.0
    kind = "sensor_delay"

    def reset(self, q: np.ndarray, rng: np.random.Generator) -> None:
        self._past: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def record(self, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> None:
        old = sum((then < t - self.delay).all() for then, _, _ in self._past)
        self._past = [*self._past[max(0, old - 1) :], (t, q.copy(), v.copy())]

    def sense(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.delay == 0 or len(self._past) < 2:
            return q, v
        t, past_q, past_v = (np.stack(kept) for kept in zip(*self._past))
        at = np.maximum(t[-1] - self.delay, t[0])
        k = np.clip((t <= at).sum(0) - 1, 0, len(t) - 2)
        e = np.arange(len(at))
        h = t[k + 1, e] - t[k, e]
        s = (at - t[k, e]) / h
        rise, v0, v1 = past_q[k + 1, e] - past_q[k, e], h * past_v[k, e], h * past_v[k + 1, e]
        square, cube = 3 * rise - 2 * v0 - v1, v0 + v1 - 2 * rise
        return past_q[k, e] + s * (v0 + s * (square + s * cube)), (v0 + s * (2 * square + 3 * s * cube)) / h


LIBRARY: Sequence[type[Plant]] = (
    CoulombFriction,
    StribeckFriction,
    QuadraticDrag,
    AsymmetricDamping,
    LoadFriction,
    PositionFriction,
    TorqueRipple,
    TorqueOffset,
    Spring,
    GravityTilt,
    Payload,
    Armature,
    CommandDeadband,
    CommandSaturation,
    CommandGain,
    Backlash,
    CommandDelay,
    ActuatorLag,
    SensorDelay,
    SensorBias,
    SensorGain,
)
"""What a library of effects can explain; those of the command in the order in which they act."""
