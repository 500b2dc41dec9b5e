"""How often the tracer is right, on generated sets whose truth is known: ``python -m benchmarks tracing``."""
