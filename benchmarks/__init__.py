"""Studies that take longer than a test, run from a checkout: ``python -m benchmarks STUDY``."""

from pathlib import Path

#: Where the committed tables lie, one folder a study.
RESULTS = Path(__file__).parent / "results"
