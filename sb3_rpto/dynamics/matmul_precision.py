"""Faster float32 matrix products: accurate kernels where the machine has them, no numbers that slow it down."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch as th

#: Largest error of a product, relative to the largest entry, that counts as float32: bfloat16 errs by far more.
ACCURATE = 1e-5
#: They must be faster by so much to be chosen: what rounds differently makes another run of the same seed, so a busy
#: machine must choose as an idle one does. Machines are known that gain a factor of 2, and others up to 1.14.
FASTER = 1.5
#: Products of each sort that the probe times.
ROUNDS = 100
#: A product as in SAC's update: batch, hidden, hidden.
SHAPE = (256, 256, 256)
#: The setting that was found, once for each that is inside.
_FOUND: list[str] = []
_LOCK = threading.Lock()


@contextmanager
def fast_products(device: th.device | str = "cpu") -> Iterator[None]:
    """Inside, float32 products on the CPU take oneDNN's kernels if a probe finds them accurate and faster here.

    The setting that was found is restored at the end: the user's other code is not touched. It is one for all threads,
    so the last that is inside restores what the first found.

    :param device: where the products are made; on others than the CPU nothing is changed
    """
    with _LOCK:
        found = _FOUND[0] if _FOUND else th.get_float32_matmul_precision()
        if th.device(device).type == "cpu" and found == "highest" and pays():
            th.set_float32_matmul_precision("medium")
        _FOUND.append(found)
    try:
        yield
    finally:
        with _LOCK:
            found = _FOUND.pop()
            if not _FOUND:
                th.set_float32_matmul_precision(found)


@contextmanager
def no_denormals() -> Iterator[None]:
    """Inside, the CPU takes numbers below the smallest normal float for 0: it computes many times slower with them.

    Saturated units have them: of a fit to transitions far from what the networks knew, they take half of the time.
    """
    before = float(th.tensor(1e-40) * 1.0) == 0.0
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(before)


@cache
def pays() -> bool:
    """Whether oneDNN's float32 products are accurate and faster on this machine; probed once in a process."""
    before = th.get_float32_matmul_precision()
    rows, inner, columns = SHAPE
    generator = th.Generator().manual_seed(0)
    a, b = th.randn(rows, inner, generator=generator), th.randn(inner, columns, generator=generator)
    exact = a.double() @ b.double()
    try:
        # The least of several, by turns, as other work on the machine only adds, and may come and go.
        seconds = {"highest": math.inf, "medium": math.inf}
        for _ in range(ROUNDS):
            for precision in seconds:
                th.set_float32_matmul_precision(precision)
                start = time.perf_counter()
                product = a @ b
                seconds[precision] = min(seconds[precision], time.perf_counter() - start)
        error = float((product.double() - exact).abs().max() / exact.abs().max())
    finally:
        th.set_float32_matmul_precision(before)
    return error < ACCURATE and seconds["highest"] > FASTER * seconds["medium"]
