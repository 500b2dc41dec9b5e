"""A servo with a wrong zero of its encoder or another stiffness, simulated without MuJoCo.

Where the zero is wrong gravity acts at another angle than is shown.
"""

import numpy as np
import pytest

from sb3_rpto.sysid import Measurements, Report, trace

KP, DAMPING, MASS, LENGTH, OFFSET, NOISE, RATE = 6.0, 0.15, 0.8, 0.4, 0.12, 1e-3, 100
ARM = f"""<mujoco><option timestep="0.005"/><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.1"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="{KP}"/></actuator></mujoco>"""


def swung(rng: np.random.Generator, offset: float, kp: float, duration: float = 4.0) -> dict[str, np.ndarray]:
    """A run of goals that are held for a while, by semi-implicit Euler; the pendulum hangs at zero."""
    steps = 20
    count, dt = round(duration * RATE), 1 / RATE / steps
    goals = np.repeat(rng.uniform(-1.5, 1.5, count // 40 + 1), 40)[:count]
    inertia, q, v, seen = MASS * LENGTH**2, rng.uniform(-0.5, 0.5), 0.0, np.empty(count)
    for k, goal in enumerate(goals):
        seen[k] = q + offset
        for _ in range(steps):
            torque = kp * (goal - q - offset) - DAMPING * v - MASS * 9.81 * LENGTH * np.sin(q)
            v += dt * torque / inertia
            q += dt * v
    return {
        "time": np.arange(count) / RATE,
        "qpos.hinge": seen + NOISE * rng.standard_normal(count),
        "ctrl.servo": goals,
    }


def traced(offset: float, kp: float = KP, declared: tuple[str, ...] = ("hinge.damping", "servo.kp")) -> Report:
    rng = np.random.default_rng(3)
    runs = {f"run{i}": swung(rng, offset, kp) for i in range(6)}
    kinds = ["sensor_bias", "sensor_gain", "torque_offset", "command_gain", "servo_gain", "coulomb_friction", "spring"]
    data = Measurements.from_tables(runs)
    return trace(ARM, data, declared, candidates=kinds, threads=1)


@pytest.mark.slow
def test_the_zero_is_found_and_not_what_it_resembles() -> None:
    report = traced(OFFSET)
    assert report.verdict == "explained"
    (found,) = report.effects
    assert found.label == "sensor_bias(hinge)"
    assert found.effect.values[0] == pytest.approx(OFFSET, rel=0.05)
    before, after, floor = (
        {e.horizon: e.rmse[0] for e in errors} for errors in (report.before, report.after, report.floor)
    )
    assert after[0.5] < 1.3 * floor[0.5]
    assert after[0.5] < 0.2 * before[0.5]


@pytest.mark.slow
def test_a_right_zero_is_no_finding() -> None:
    assert traced(0.0).verdict == "complete"


@pytest.mark.slow
@pytest.mark.parametrize("change", [-0.2, 0.0])
def test_another_stiffness_is_found_where_nobody_declared_it(change: float) -> None:
    report = traced(0.0, (1 + change) * KP, declared=("hinge.damping",))
    assert report.verdict == ("explained" if change else "complete")
    assert [found.label for found in report.effects] == ["servo_gain(servo)"] * bool(change)
    for found in report.effects:
        assert found.effect.values[0] == pytest.approx(change, abs=0.005)
