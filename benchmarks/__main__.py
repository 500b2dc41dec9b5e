"""``python -m benchmarks STUDY [PART] ...``: measure how well the package does, and make the committed tables."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

#: By study and part, the module whose ``main(arguments)`` runs it, or ``module:function``; "" is what runs where no
#: part is named.
STUDIES: dict[str, dict[str, str]] = {
    "tracing": {
        "": "benchmarks.tracing.run",
        "report": "benchmarks.tracing.table",
        "encoders": "benchmarks.tracing.encoders",
        "robots": "benchmarks.tracing.robots",
        "shapes": "benchmarks.tracing.shapes",
        "targets": "benchmarks.tracing.targets",
        "threshold": "benchmarks.tracing.threshold",
    },
    "transfer": {
        "": "benchmarks.transfer.sweep",
        "cartpole": "benchmarks.transfer.cartpole",
        "panels": "benchmarks.transfer.cartpole:draw",
        "double_pendulum": "benchmarks.transfer.double_pendulum",
        "pictures": "benchmarks.transfer.pictures",
        "report": "benchmarks.transfer.tables",
    },
    "closed_loop": {
        "": "benchmarks.closed_loop.run",
        "report": "benchmarks.closed_loop.run:report_table",
        "retraining": "benchmarks.closed_loop.retraining",
    },
    "speed": {"": "benchmarks.speed"},
    "machines": {"": "benchmarks.machines.run"},
    "theory": {"": "benchmarks.theory.table"},
    "frozen": {"": "benchmarks.frozen"},
}
BAD_INPUT, INTERRUPTED = 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study.

    :param arguments: its name, that of its part where it has several, and their options
    :return: exit code: 0 done, 1 where runs failed, 2 bad input, 130 interrupted
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] not in STUDIES:
        print("usage: python -m benchmarks STUDY [PART] [OPTIONS]; STUDY and PART are:", file=sys.stderr)
        for name, parts in STUDIES.items():
            print(f"  {name:12} {', '.join(filter(None, parts))}".rstrip(), file=sys.stderr)
        return 0 if given[:1] in (["-h"], ["--help"]) else BAD_INPUT
    parts, rest = STUDIES[given[0]], given[1:]
    part = rest.pop(0) if rest and rest[0] in parts else ""
    traceback = "--traceback" in rest
    try:
        module, _, function = parts[part].partition(":")
        run = getattr(importlib.import_module(module), function or "main")
        return int(run([option for option in rest if option != "--traceback"]) or 0)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, FileNotFoundError, ImportError) as error:
        if traceback:
            raise
        print(f"error: {error} (--traceback shows where)", file=sys.stderr)
        return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
