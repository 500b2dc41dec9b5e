"""Peak memory of a process that holds a model and its replay buffers."""

from __future__ import annotations

import resource
import sys
from multiprocessing import get_context

from sb3_rpto.experiments.speed.cases import update


def peak_memory(rows: int, observation: int) -> float:
    """Peak resident memory in MB of a process of its own that fills SB3's buffer and ours and updates both.

    :param rows: transitions in each buffer
    :param observation: their dimension
    """
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_measure, (rows, observation))


def _measure(rows: int, observation: int) -> float:
    case = update("cpu", 1, observation=observation, rows=rows)
    for variant in case.variants.values():
        variant()
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
