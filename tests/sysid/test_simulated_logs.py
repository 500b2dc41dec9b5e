"""Logs as users simulate them: position servos in semi-implicit steps, coarse encoders, MuJoCo's own friction."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.hypotheses.simulated_data import OtherSubsteps
from sb3_rpto.sysid.problem.problem import Assumptions, Inputs, prepare
from sb3_rpto.sysid.selection.search import search

ARM = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.002" integrator="implicitfast">
<flag contact="disable"/></option><worldbody><body name="upper">
<joint name="shoulder" axis="0 1 0" damping="0.1" frictionloss="{friction}"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6"/>{fore}</body></worldbody>
<actuator><position name="shoulder_servo" joint="shoulder" kp="25" kv="0.6" forcerange="-6 6"/>{servo}</actuator>
</mujoco>"""
FORE = """<body name="fore" pos="0.25 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.015" mass="0.3"/></body>"""
ELBOW = '<position name="elbow_servo" joint="elbow" kp="12" kv="0.25" forcerange="-3 3"/>'
ONE, TWO = {"fore": "", "servo": ""}, {"fore": FORE, "servo": ELBOW}


def log(parts: dict, friction: float = 0.0, mass: float = 1.0, late: int = 0, runs: int = 6) -> Measurements:
    """What an encoder of 12 bits shows at 100 Hz of an arm that is simulated in steps of a millisecond."""
    model = mujoco.MjModel.from_xml_string(ARM.format(friction=friction, **parts))
    model.opt.timestep = 0.001
    model.body_mass[-1] *= mass
    model.body_inertia[-1] *= mass
    tables, every, count = {}, 10, 500
    for run in range(runs):
        rng, data = np.random.default_rng(run), mujoco.MjData(model)
        tone, size, phase = (rng.uniform(*span, (3, model.nu)) for span in ((0.1, 1.2), (0.1, 0.45), (0, 6.28)))
        steps = rng.uniform(-0.4, 0.4, (10, model.nu)) * (run % 2)
        t = 0.01 * np.arange(count)
        u = (size * np.sin(2 * np.pi * tone * t[:, None, None] + phase)).sum(1) + steps[(t / 0.8).astype(int)]
        fine, q = np.repeat(u, every, axis=0), np.zeros((count, model.nq))
        for k in range(every * count):
            if k % every == 0:
                q[k // every] = data.qpos
            data.ctrl[:] = fine[k - late] if k >= late else 0.0
            mujoco.mj_step(model, data)
        q = np.round(q / (2 * np.pi / 4096)) * (2 * np.pi / 4096)
        table = {"time": t} | {f"qpos.{model.joint(j).name}": q[:, j] for j in range(model.nq)}
        tables[f"run{run}"] = table | {f"ctrl.{model.actuator(a).name}": u[:, a] for a in range(model.nu)}
    return Measurements.from_tables(tables)


def test_a_simulators_own_steps_are_met_where_they_are_shorter_than_the_models() -> None:
    report = trace(ARM.format(friction=0, **ONE), log(ONE, mass=1.1), ["upper.mass", "shoulder.damping"], threads=1)
    assert report.verdict == "complete"
    mass, damping = (t.effect.values[0] for t in report.declared)
    assert mass == pytest.approx(0.66, rel=3e-3)
    assert damping == pytest.approx(0.1, rel=0.02)
    (found,) = [f for f in report.findings if f.kind == FindingKind.SIMULATED]
    assert "in steps of 1 ms" in found.message


@pytest.mark.slow
def test_commands_that_are_late_at_all_joints_and_late_sensors_are_one_class() -> None:
    kinds = ["command_delay", "sensor_delay", "coulomb_friction"]
    declared = ["fore.mass", "shoulder.damping", "elbow.damping"]
    report = trace(ARM.format(friction=0, **TWO), log(TWO, mass=1.2, late=15), declared, candidates=kinds, threads=1)
    assert report.verdict == "explained"
    assert len(report.effects) == 2
    for traced, joint in zip(report.effects, ("shoulder", "elbow")):
        assert traced.effect.values == pytest.approx([0.015], abs=1e-3)
        assert {traced.label, *traced.alike} >= {f"command_delay({joint}_servo)", f"sensor_delay({joint})"}


@pytest.mark.slow
def test_the_simulators_steps_are_chosen_anew_with_what_was_found() -> None:
    kinds = ("soft_friction",)
    asked = Inputs(
        ARM.format(friction=0, **ONE), log(ONE, friction=0.3), ["shoulder.damping"], candidates=kinds, threads=1
    )
    problem = prepare(asked, Assumptions(simulated=True))  # in steps of 2 ms
    result = search(problem)
    assert [effect.kind for effect in result.named] == ["soft_friction"]
    hypothesis = OtherSubsteps()
    assert hypothesis.applies(problem, result)
    other = hypothesis.alternative(problem, result)
    assert other is not None
    assert other.data.substeps == 2  # of a millisecond, as the log's
    other, then = hypothesis.search(other, result)
    assert hypothesis.accepts(result, then)
    assert then.after.ratio < result.after.ratio
    assert then.named[0].kind == "soft_friction"
    assert hypothesis.alternative(other, then) is None


@pytest.mark.slow
@pytest.mark.parametrize("nominal", [0.0, 0.1])
def test_declared_friction_is_mujocos_own_whatever_it_starts_at(nominal: float) -> None:
    names = ["upper.mass", "shoulder.frictionloss"]
    xml = ARM.format(friction=nominal, **ONE)
    report = trace(xml, log(ONE, friction=0.3), names, candidates=["torque_offset"], threads=1)
    assert report.verdict == "complete"
    assert report.declared[1].effect.values == pytest.approx([0.3], rel=0.03)
