"""``python -m sb3_rpto.experiments.tracing_benchmark``."""

import sys

from sb3_rpto.experiments.tracing_benchmark import main

if __name__ == "__main__":
    sys.exit(main())
