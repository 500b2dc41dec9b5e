"""What commands print."""

import sys
import time
from collections.abc import Callable


def say(text: str) -> None:
    """Print, with question marks for what the terminal's encoding lacks: units and file names are not all ASCII."""
    encoding = sys.stdout.encoding or "utf-8"
    print(text.encode(encoding, errors="replace").decode(encoding), flush=True)


def lines() -> Callable[[float, str], None]:
    """Progress as a line for each thing that is done."""
    last, began = [""], time.monotonic()

    def tell(share: float, what: str) -> None:
        if what != last[0]:
            print(f"[{share:4.0%}, {time.monotonic() - began:.0f} s] {what}", file=sys.stderr)
        last[0] = what

    return tell
