"""Commands that show what a machine hides: slow and small ones for dry friction, fast and strong ones for the rest.

The motor follows a reference softly and is pushed on top of that,

    u = clip(K (r(t) - q) - B qd + w(t), -peak, peak),

so the machine stays where it is sensible and the recorded command is still all that drives it.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.tracing.planting.systems import System


@dataclass(frozen=True)
class Style:
    """Character of one episode.

    :param reach: amplitude of the reference in rad (0.4 of it in m on a slide)
    :param push: amplitude of the push, as a fraction of the peak
    :param slowest: lowest frequency in Hz
    :param fastest: highest frequency in Hz
    :param steps: fraction of reference and push made of filtered steps rather than sinusoids
    """

    reach: float
    push: float
    slowest: float
    fastest: float
    steps: float


STYLES = (
    Style(reach=1.2, push=0.2, slowest=0.15, fastest=0.6, steps=0.0),
    Style(reach=1.2, push=0.8, slowest=0.4, fastest=2.0, steps=0.2),
    Style(reach=0.5, push=0.15, slowest=0.3, fastest=1.0, steps=0.5),
    Style(reach=1.0, push=1.0, slowest=0.3, fastest=1.5, steps=1.0),
    Style(reach=0.8, push=0.4, slowest=0.3, fastest=4.0, steps=0.3),
)
"""Episodes take these in turn."""
RISE = 0.03
"""Time constant of the filtered steps in s."""
TONES = 4
STIFFNESS, DAMPING = 0.8, 0.05
"""K and B at a hinge as fractions of the peak, per rad and per rad/s."""


def sinusoids(style: Style, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sum of tones with random frequencies and phases at times ``t`` (T,), of amplitude about one."""
    frequency = np.exp(rng.uniform(np.log(style.slowest), np.log(style.fastest), TONES))
    phase, weight = rng.uniform(0, 2 * np.pi, TONES), rng.uniform(0.5, 1.0, TONES)
    return np.sin(2 * np.pi * np.outer(t, frequency) + phase) @ weight / np.sqrt((weight**2).sum())


def filtered_steps(style: Style, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random levels at times ``t`` (T,), each held for about half a period, reached smoothly.

    They begin at 0 and lie in [-2, 2]: steps between levels in [-1, 1], less the first level.
    """
    n = int(2 * t[-1] * style.fastest) + 2
    at = np.cumsum(rng.uniform(0.5, 1.5, n)) / (2 * style.fastest)
    jumps = np.diff(rng.uniform(-1, 1, n + 1))
    return (jumps * 0.5 * (1 + np.tanh((t[:, None] - at) / (2 * RISE)))).sum(1)


class Excitation:
    """The commands of E episodes.

    :param system: the machine; only the joints with a motor are driven
    :param times: of the samples in s, shape (E, T)
    :param rng: of the draw
    """

    def __init__(self, system: System, times: np.ndarray, rng: np.random.Generator) -> None:
        turn = np.array([1.0 if link.hinge else 0.4 for link in system.links])
        episodes, n = len(times), len(system.links)
        self.peak, self.stiffness, self.damping = (
            system.peak,
            STIFFNESS * system.peak / turn,
            DAMPING * system.peak / turn,
        )
        self.reference = np.zeros((*times.shape, n))
        self.push = np.zeros((*times.shape, n))
        for e in range(episodes):
            style = STYLES[e % len(STYLES)]
            for j in range(n):
                parts = [
                    (1 - style.steps) * sinusoids(style, times[e], rng)
                    + style.steps * filtered_steps(style, times[e], rng)
                    for _ in range(2)
                ]
                self.reference[e, :, j] = style.reach * turn[j] * parts[0]
                self.push[e, :, j] = style.push * system.peak[j] * parts[1]
        reach = np.array([STYLES[e % len(STYLES)].reach for e in range(episodes)])[:, None]
        self.q = rng.uniform(-0.5, 0.5, (episodes, n)) * reach * turn
        """First positions, shape (E, n); the machine is let go at rest."""

    def command(self, k: int, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Command of sample ``k`` from what the sensors say, in N·m or N, shape (E, n); zero at passive joints."""
        u = self.stiffness * (self.reference[:, k] - q) - self.damping * qd + self.push[:, k]
        return np.clip(u, -self.peak, self.peak)
