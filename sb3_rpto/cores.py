"""How many cores this process may use."""

from __future__ import annotations

import os


def cores() -> int:
    """Cores that this process is allowed to run on, which ``taskset``, a batch system or a container may have bounded.

    ``os.cpu_count()`` and MuJoCo's own default count the machine's.
    """
    allowed = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    return len(allowed(0)) if allowed else os.cpu_count() or 1
