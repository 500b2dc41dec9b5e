"""Honest times on a noisy machine: variants take turns in one run, and their ratios are formed turn by turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_rpto.dynamics.matmul_precision import fast_products

Variants = Mapping[str, Callable[[], Any]]


@dataclass(frozen=True)
class Times:
    """Seconds of each variant in each round.

    :param seconds: variant -> (rounds,)
    """

    seconds: dict[str, np.ndarray]

    def median(self, name: str) -> float:
        """Median seconds of a variant."""
        return float(np.median(self.seconds[name]))

    def ratio(self, slow: str, fast: str) -> tuple[float, float, float]:
        """How many times as long ``slow`` takes as ``fast``: median, least and largest of the rounds."""
        ratios = self.seconds[slow] / self.seconds[fast]
        return float(np.median(ratios)), float(ratios.min()), float(ratios.max())


def interleaved(variants: Variants, rounds: int, device: th.device | str = "cpu") -> Times:
    """Time variants in turns, each round in another order, after a round that does not count.

    :param variants: name -> what is done
    :param rounds: at least 1
    :param device: is waited for where it computes on its own
    """
    names = list(variants)
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(rounds + 1):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            _wait(device)
            start = time.perf_counter()
            variants[name]()
            _wait(device)
            if turn:
                seconds[name].append(time.perf_counter() - start)
    return Times({name: np.array(values) for name, values in seconds.items()})


def products(shapes: Mapping[tuple[int, int, int, int], int], device: th.device | str = "cpu") -> Callable[[], None]:
    """Matrix products alone, by the fastest means found here: what they take is the floor of what needs them.

    :param shapes: (batch, rows, inner, columns) -> how many
    :return: makes them all, and nothing else
    """
    whole = [(_pair(*shape, device), count) for shape, count in shapes.items()]

    def run() -> None:
        with fast_products(device):
            for (a, b), count in whole:
                for _ in range(count):
                    th.matmul(a, b)

    return run


def flops(shapes: Mapping[tuple[int, int, int, int], int]) -> float:
    """Floating-point operations of the products."""
    return sum(2.0 * n * rows * inner * columns * count for (n, rows, inner, columns), count in shapes.items())


def _pair(n: int, rows: int, inner: int, columns: int, device: th.device | str) -> tuple[th.Tensor, th.Tensor]:
    a, b = th.randn(n, rows, inner, device=device), th.randn(n, inner, columns, device=device)
    return (a[0], b[0]) if n == 1 else (a, b)


def _wait(device: th.device | str) -> None:
    if th.device(device).type == "cuda":
        th.cuda.synchronize(device)
