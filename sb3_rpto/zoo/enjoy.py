"""``python -m sb3_rpto.zoo.enjoy``: ``rl_zoo3 enjoy`` for agents of ``python -m sb3_rpto.zoo.train``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from sb3_rpto import zoo
from sb3_rpto.zoo.train import command_line, fill_zoo


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an agent in its target.

    :param arguments: those of ``rl_zoo3 enjoy``, without the program's name; default: those of the process
    :return: exit code: 0 done, 2 bad input
    """
    try:
        zoo.require()
    except ImportError as error:
        print(f"sb3_rpto.zoo.enjoy: error: {error}", file=sys.stderr)
        return 2
    import rl_zoo3.enjoy

    fill_zoo()
    with command_line(list(sys.argv[1:] if arguments is None else arguments)):
        rl_zoo3.enjoy.enjoy()
    return 0


if __name__ == "__main__":
    sys.exit(main())
