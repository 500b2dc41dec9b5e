"""Searches that begin again as recordings turn out to be of another kind: of friction that gives way."""

import pytest
from simulated import compiled, recorded

from sb3_rpto.effects import LIBRARY
from sb3_rpto.tracing import conclude, trace

OWN = """<mujoco><option timestep="0.005"/><worldbody><body name="pole">
<joint name="hinge" axis="0 -1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
KINDS = ["coulomb_friction", "stribeck_friction", "torque_offset"]


@pytest.mark.parametrize("kind", ["soft_friction", "coulomb_friction"])
@pytest.mark.parametrize("noise", [0.0, 2e-4], ids=["exact", "noisy"])
def test_dry_friction_is_found_as_the_robot_has_it(kind: str, noise: float) -> None:
    data = recorded([LIBRARY[kind]("hinge", level=0.3)], compiled(OWN), noise=noise, exact=not noise)
    report = trace(OWN, data, ["pole.mass"], candidates=KINDS, simulated=True, threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == [f"{kind}(hinge)"]
    assert report.effects[0].effect.values == pytest.approx([0.3], rel=1e-2 if noise else 1e-6)
    assert [f.kind for f in report.findings].count("soft friction") == (kind == "soft_friction")


def test_friction_that_gives_way_is_not_looked_for_where_no_dry_one_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conclude, "creeping", lambda *_: pytest.fail("nobody asked for dry friction"))
    data = recorded([LIBRARY["soft_friction"]("hinge", level=0.3)], compiled(OWN), noise=0.0, exact=True)
    report = trace(OWN, data, ["pole.mass"], candidates=["torque_offset"], simulated=True, threads=1)
    assert report.verdict == "unexplained"
    assert [c.label for c in report.candidates] == ["torque_offset(hinge)"]
