"""Peak memory of a process that holds a model and its replay buffers."""

from __future__ import annotations

import re
import resource
import sys
from multiprocessing import get_context
from pathlib import Path

from benchmarks.speed.cases import BATCH, rpo_with_data, sac_with_data

MAKERS = {"SB3": sac_with_data, "ours": rpo_with_data}


def peak_memory(whose: str, rows: int, observation: int) -> float:
    """Peak resident memory in MB of a process of its own that fills a replay buffer and updates once.

    :param whose: one of :data:`MAKERS`
    :param rows: transitions in the buffer (ours: of the source)
    :param observation: their dimension
    """
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_measure, (whose, rows, observation))


def _measure(whose: str, rows: int, observation: int) -> float:
    MAKERS[whose]("cpu", observation, BATCH, rows).train(1, BATCH)
    return _peak()


def _peak() -> float:
    try:  # the resource module's figure may be that of the process that started this one
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    except OSError:
        found = None
    if found:
        return int(found[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
