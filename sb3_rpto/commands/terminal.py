"""What commands print."""

import sys


def say(text: str) -> None:
    """Print, with question marks for what the terminal's encoding lacks: units and file names are not all ASCII."""
    encoding = sys.stdout.encoding or "utf-8"
    print(text.encode(encoding, errors="replace").decode(encoding), flush=True)
