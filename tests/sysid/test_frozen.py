"""A lift with a load that nobody declared, and a damping that could hold it still instead; simulated without MuJoCo."""

import numpy as np
import pytest

from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.findings import FindingKind

MASS, LOAD, DAMPING, GEAR, RATE, NOISE = 0.5, 0.6, 3.0, 40.0, 200, 5e-4
LIFT = f"""<mujoco><option timestep="0.005" integrator="{{}}"/><worldbody><body name="quill">
<joint name="z" type="slide" axis="0 0 1" damping="2"/><geom size="0.01" mass="{MASS}"/></body></worldbody>
<actuator><motor name="motor" joint="z" gear="{GEAR}"/></actuator></mujoco>"""


def lifted(rng: np.random.Generator, load: float, duration: float = 3.0, steps: int = 10) -> dict[str, np.ndarray]:
    """A run whose controller knows of the load, by semi-implicit Euler."""
    time = np.arange(round(duration * RATE)) / RATE
    goal = sum(0.01 * np.sin(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi)) for f in (0.5, 1.1, 1.9))
    mass, z, v, dt = MASS + load, goal[0], 0.0, 1 / RATE / steps
    seen, sent = np.empty(len(time)), np.empty(len(time))
    for k in range(len(time)):
        seen[k], sent[k] = z, np.clip((900 * (goal[k] - z) - 30 * v + 9.81 * mass) / GEAR, -1, 1)
        for _ in range(steps):
            v += dt * (GEAR * sent[k] - DAMPING * v - 9.81 * mass) / mass
            z += dt * v
    return {"time": time, "qpos.z": seen + NOISE * rng.standard_normal(len(time)), "ctrl.motor": sent}


def traced(integrator: str) -> Report:
    rng = np.random.default_rng(5)
    data = Measurements.from_tables({f"run{i}": lifted(rng, LOAD) for i in range(6)})
    kinds = ["payload", "quadratic_drag", "coulomb_friction"]
    return trace(LIFT.format(integrator), data, ["z.damping"], candidates=kinds, threads=1)


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "astray"), [("Euler", True), ("RK4", False)])
def test_the_load_is_found_though_a_damping_could_freeze_the_lift(integrator: str, astray: bool) -> None:
    report = traced(integrator)
    assert report.verdict == "explained"
    (found,) = report.effects
    assert found.label == "payload(quill)"
    assert found.effect.values[0] == pytest.approx(LOAD, rel=0.02)
    (damping,) = report.declared
    assert damping.effect.values[0] == pytest.approx(DAMPING, rel=0.1)
    assert report.before[0].rmse[0] < 1.0  # of a lift that moves, not of one that blew up
    said = [f.message for f in report.findings if f.kind in (FindingKind.UNSTABLE, FindingKind.OWN_STEPS)]
    assert len(said) == astray  # the saved lift takes Euler's long steps
    assert all("(EULER, 0.005 s)" in message for message in said)
