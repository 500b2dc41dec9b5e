import pytest

from sb3_rpto.experiments.planting import Planted, generate
from sb3_rpto.tracing import Report, trace

CANDIDATES = ["coulomb_friction", "torque_offset", "command_delay"]


@pytest.fixture(scope="session")
def planted() -> Planted:
    """A pendulum with dry friction that its model does not have."""
    return generate("pendulum", [("coulomb_friction", "large")], seed=0, episodes=6, duration=3.0)


@pytest.fixture(scope="session")
def report(planted: Planted) -> Report:
    """What a trace of it finds; not to be changed."""
    return trace(planted.xml, planted.measurements, ["pole.mass"], candidates=CANDIDATES)
