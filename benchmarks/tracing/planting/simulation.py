"""Time stepping of planted machines, with exact stiction."""

from collections.abc import Sequence

import numpy as np

from benchmarks.tracing.planting.plants import Plant
from benchmarks.tracing.planting.systems import System

SWEEPS = 200


class Simulation:
    """E episodes of one machine side by side.

    A step of length h drifts by half a step, kicks the velocity and drifts by the other half (second order):

        q' = q + h/2 v
        v+ = v + M(q')^-1 (h f(q', (v + v+) / 2) + p)     the implicit mean by two passes
        q+ = q' + h/2 v+

    Dry friction is the impulse p: at each joint either |p| < h F and the joint stands still after the kick, exactly, or
    |p| = h F against its motion. Projected Gauss-Seidel on M^-1 finds it.

    :param system: the machine's nominal rigid bodies with the true values of what is declared
    :param plants: effects in it; they act in the order given
    :param q: first positions in rad or m, shape (E, n)
    :param qd: first velocities in rad/s or m/s, shape (E, n)
    :param rng: of the effects that are random
    """

    def __init__(
        self, system: System, plants: Sequence[Plant], q: np.ndarray, qd: np.ndarray, rng: np.random.Generator
    ) -> None:
        for plant in plants:
            system = plant.body(system)
            plant.reset(q[:, plant.joint], rng)
        self.system, self.plants = system, plants
        self.q, self.qd = q.copy(), qd.copy()
        self._impulse = np.zeros_like(self.q)
        self._begun = False

    def sense(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity as the sensors say, without noise, (E, n) each."""
        q, qd = self.q.copy(), self.qd.copy()
        for plant in self.plants:
            j = plant.joint
            q[:, j], qd[:, j] = plant.sense(q[:, j], qd[:, j])
        return q, qd

    def hold(self, command: np.ndarray, start: np.ndarray, duration: np.ndarray, steps: int) -> None:
        """Hold a command for a while.

        :param command: in N·m or N, shape (E, n), zero at joints without a motor
        :param start: time of the command in each episode in s, shape (E,); not before the end of the last
        :param duration: in s, shape (E,)
        :param steps: how many steps to take
        """
        command = command.copy()
        for plant in self.plants:
            command[:, plant.joint] = plant.command(command[:, plant.joint], start)
        h = duration / steps
        if not self._begun:
            self._record(start)
            self._begun = True
        for i in range(steps):
            self._step(command, start + i * h, h)
            self._record(start + (i + 1) * h)

    def _record(self, t: np.ndarray) -> None:
        for plant in self.plants:
            plant.record(t, self.q[:, plant.joint], self.qd[:, plant.joint])

    def _step(self, command: np.ndarray, t: np.ndarray, h: np.ndarray) -> None:
        system, v, step = self.system, self.qd, h[:, None]
        q = self.q + step / 2 * v
        tau = command.copy()
        for plant in self.plants:
            j = plant.joint
            tau[:, j] = plant.drive(tau[:, j], q[:, j], v[:, j], t, h)
        m, c, steady = system.terms(q)
        steady += tau
        for plant in self.plants:
            j = plant.joint
            steady[:, j] += plant.disturb(q[:, j], v[:, j], t, h)
        inverse = np.linalg.inv(m)
        mean = v
        for _ in range(2):
            force = steady - (c @ (system.rates(mean) ** 2)[..., None])[..., 0] - system.damping * mean
            bound = np.zeros_like(v)
            for plant in self.plants:
                j = plant.joint
                force[:, j] += plant.force(q[:, j], mean[:, j])
                bound[:, j] += plant.bound(q[:, j], mean[:, j], tau[:, j])
            after = v + step * (inverse @ force[..., None])[..., 0]
            if bound.any():
                after, self._impulse = stop(inverse, after, step * bound, self._impulse)
            mean = (v + after) / 2
        self.qd = after
        self.q = q + step / 2 * after


def stop(inverse: np.ndarray, v: np.ndarray, bound: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Impulses p of dry friction: v+ = v + M^-1 p and, at each joint, v+ = 0 with |p| < bound or p = -bound sign(v+).

    :param inverse: M^-1, shape (E, n, n)
    :param v: velocities without friction, shape (E, n)
    :param bound: largest impulses >= 0 in N·m·s or N·s, shape (E, n)
    :param guess: impulses to begin with, shape (E, n)
    :return: velocities after the impulse, exactly zero where a joint sticks, and the impulses
    """
    joints = np.flatnonzero(bound.any(0))
    p = np.clip(guess, -bound, bound)
    v = v + (inverse @ p[..., None])[..., 0]
    for _ in range(SWEEPS):
        change = 0.0
        for j in joints:
            new = np.clip(p[:, j] - v[:, j] / inverse[:, j, j], -bound[:, j], bound[:, j])
            kick = inverse[:, :, j] * (new - p[:, j])[:, None]
            p[:, j] = new
            v = v + kick
            change = max(change, float(np.abs(kick).max()))
        if len(joints) == 1 or change < 1e-13:
            break
    return np.where(np.abs(p) < bound, 0.0, v), p
