"""What closing the loop is worth: ``python -m benchmarks closed_loop``."""
