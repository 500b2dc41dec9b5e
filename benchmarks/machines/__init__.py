"""Three real machines, measured by others: ``python -m benchmarks machines``."""
