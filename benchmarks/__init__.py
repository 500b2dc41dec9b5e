"""Studies that take longer than a test, run from a checkout: ``python -m benchmarks.NAME``."""
