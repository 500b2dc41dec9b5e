"""Every method on every task: ``python -m benchmarks transfer``."""
