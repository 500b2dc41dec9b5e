"""``python -m benchmarks STUDY [PART] ...``: measure how well the package does, and make the committed tables."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

#: By study and part, the module whose ``main(arguments)`` runs it; "" is what runs where no part is named.
STUDIES: dict[str, dict[str, str]] = {
    "tracing": {
        "": "benchmarks.tracing",
        "encoders": "benchmarks.tracing.encoders",
        "robots": "benchmarks.tracing.gymnasium_robots",
        "shapes": "benchmarks.tracing.shapes",
        "targets": "benchmarks.tracing.targets",
        "threshold": "benchmarks.tracing.threshold",
    },
    "transfer": {
        "": "benchmarks.transfer.sweep",
        "cartpole": "benchmarks.transfer.cartpole_panels",
        "double_pendulum": "benchmarks.transfer.double_pendulum_ablation",
        "pictures": "benchmarks.transfer.render_targets",
        "report": "benchmarks.transfer.tables",
    },
    "closed_loop": {"": "benchmarks.closed_loop.run", "retraining": "benchmarks.closed_loop.retraining_ablation"},
    "speed": {"": "benchmarks.speed"},
    "machines": {"": "benchmarks.machines.run"},
    "theory": {"": "benchmarks.theory.table"},
    "frozen": {"": "benchmarks.frozen"},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study.

    :param arguments: its name, that of its part where it has several, and their options
    :return: exit code
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] not in STUDIES:
        print("usage: python -m benchmarks STUDY [PART] [OPTIONS]; STUDY and PART are:", file=sys.stderr)
        for name, parts in STUDIES.items():
            print(f"  {name:12} {', '.join(filter(None, parts))}".rstrip(), file=sys.stderr)
        return 0 if given[:1] in (["-h"], ["--help"]) else 2
    parts, rest = STUDIES[given[0]], given[1:]
    part = rest.pop(0) if rest and rest[0] in parts else ""
    return int(importlib.import_module(parts[part]).main(rest) or 0)


if __name__ == "__main__":
    sys.exit(main())
