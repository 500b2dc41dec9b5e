"""What speaks for a number that nobody declared, where recordings are not explained."""

from __future__ import annotations

import re

import pytest

from sb3_rpto.experiments.planting import generate
from sb3_rpto.tracing import trace


@pytest.mark.slow
def test_a_mass_that_was_not_declared_is_named_with_its_size() -> None:
    planted = generate("cartpole", None, seed=3, episodes=6, duration=3.0)
    light, times = 0.225, planted.truth.declared["pole.mass"] / 0.225
    xml, found = re.subn(
        r'mass="0.3" diaginertia="[^"]*"', f'mass="{light}" diaginertia="0.00675 0.00675 4.5e-05"', planted.xml
    )
    assert found == 1
    others = [name for name in planted.declared if name != "pole.mass"]
    report = trace(xml, planted.measurements, others, candidates=["coulomb_friction", "payload"])
    assert report.verdict == "unexplained"
    (hint,) = [finding for finding in report.findings if finding.kind == "undeclared mass"]
    assert hint.where == "pole"
    assert float(hint.message.split()[1]) == pytest.approx(times, rel=0.02)
    assert "declare pole.mass" in hint.message
    assert trace(xml, planted.measurements, planted.declared, candidates=["coulomb_friction"]).verdict == "complete"
