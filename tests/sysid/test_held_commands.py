"""Where a command changes an acceleration does, and must not pass for noise."""

import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.shooting.windows import noise_levels

SERVO = """<mujoco><option timestep="0.01"/><worldbody><body name="pole">
<joint name="hinge" axis="0 1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="0.3"/>
</body></worldbody><actuator><position name="motor" joint="hinge" kp="5" kv=".2"/></actuator></mujoco>"""
DRY = 'damping="0.05" frictionloss="0.01" solreffriction="0.02 1" solimpfriction="0.99 0.99 0.001"'
NOISE = 5e-4
KINDS = ["coulomb_friction", "torque_offset", "quadratic_drag"]


def log(xml: str, hold: int) -> Measurements:
    """Six runs of 2 s at 100 Hz, the servo's command new after every so many samples."""
    model, rows = mujoco.MjModel.from_xml_string(xml), []
    for run in range(6):
        rng, data = np.random.default_rng(run), mujoco.MjData(model)
        for sample in range(200):
            if sample % hold == 0:
                data.ctrl[:] = rng.uniform(-1, 1)
            rows.append([run, 0.01 * sample, data.qpos[0] + NOISE * rng.standard_normal(), data.ctrl[0]])
            mujoco.mj_step(model, data)
    names = ["episode", "time", "qpos.hinge", "ctrl.motor"]
    return Measurements.from_tables({"log": dict(zip(names, np.array(rows).T))})


@pytest.mark.parametrize("hold", [6, 8, 40])
def test_held_commands_leave_the_noise_what_it_is(hold: int) -> None:
    assert noise_levels(log(SERVO, hold)) == pytest.approx([NOISE], rel=0.1)


@pytest.mark.parametrize("hold", [1, 8])
def test_noise_that_is_mostly_motion_is_told(hold: int) -> None:
    data = log(SERVO, hold)
    report = trace(SERVO, data, ["pole.mass"], candidates=[], simulated=True, threads=1)
    assert report.verdict == "complete"
    vague = hold == 1
    assert (noise_levels(data)[0] > 2 * NOISE) == vague
    assert [f.kind == FindingKind.VAGUE_NOISE for f in report.findings].count(True) == vague


@pytest.mark.parametrize("lacks", ["nothing", "dry friction"])
def test_friction_does_not_hide_below_what_commands_do(lacks: str) -> None:
    robot = SERVO if lacks == "nothing" else SERVO.replace('damping="0.05"', DRY)
    report = trace(SERVO, log(robot, 8), ["pole.mass"], candidates=KINDS, simulated=True, threads=1)
    assert report.verdict == ("complete" if lacks == "nothing" else "explained")
    assert [traced.label for traced in report.effects] == ["coulomb_friction(hinge)"] * (lacks != "nothing")
    assert [traced.effect.values[0] for traced in report.effects] == pytest.approx(
        [0.01] * len(report.effects), rel=0.05
    )
