"""What a reader is told beside a verdict."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, WITH_WHEEL, compiled, recorded

from sb3_rpto.effects import LIBRARY, Simulation
from sb3_rpto.effects.forces import Spring, TorqueOffset
from sb3_rpto.sysid import Finding, Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.hypotheses.finer_steps import FinerSteps
from sb3_rpto.sysid.report.diagnostics import (
    above_noise,
    brief_delays,
    encoder_zeros,
    missed,
    no_nearer,
    own_steps,
    tied_sensors,
)
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, horizon_errors, noise_floor
from sb3_rpto.sysid.shooting.windows import cut, discretised, noise_levels

SERVO = """<mujoco><worldbody><body><joint name="elbow" axis="0 1 0"/><geom size="0.1"/></body></worldbody>
<actuator>{}</actuator></mujoco>"""
ERROR = HorizonError(
    0.5, ("a", "b"), np.array([1.5e-3, 1e-3]), np.array([1.3e-3, 0.9e-3]), np.array([1.7e-3, 1.1e-3]), np.zeros(2), 40
)
FLOOR = replace(ERROR, rmse=np.array([1e-3, 1e-3]), low=np.full(2, 0.9e-3), high=np.full(2, 1.1e-3))


@pytest.mark.parametrize(("ratio", "low", "told"), [(1.3, 1.3e-3, True), (1.3, 1e-3, False), (1.05, 1.3e-3, False)])
def test_a_model_that_few_windows_pass_is_told_where_the_test_runs_deny_it(
    ratio: float, low: float, told: bool
) -> None:
    after = replace(ERROR, low=np.array([low, 0.9e-3]))
    errors = [after, replace(after, horizon="whole run")]
    found = above_noise(errors, [FLOOR], ratio, length=0.8)
    assert [f.kind for f in found] == [FindingKind.FEW_WINDOWS] * told
    assert above_noise(errors, [FLOOR], ratio, length=1.1) == []  # over so little the starts decide


@pytest.mark.slow
def test_a_light_joint_under_noise_for_commands_is_missed_by_the_model_of_another_load_alone() -> None:
    light = PENDULUM.replace('mass="0.5"', 'mass="0.01"').replace('damping="0.05"', 'damping="0.005"')
    commands = np.random.default_rng(4).uniform(-0.8, 0.8, (2, 210))
    made = recorded(model=compiled(light), episodes=2, commands=commands, noise=1e-4, start=(0.2, 0.2), rate=100)
    columns = {name: column for name, column in made.tables().items() if not name.startswith("qvel")}
    data = Measurements.from_tables({"run": columns})
    own, other = (
        Simulation(discretised(compiled(xml), data, fine=True), [], 1)
        for xml in (light, light.replace("0.01", "0.015"))
    )
    sigma = noise_levels(data)
    after, floor = horizon_errors(own, own.null, data, sigma, 0), noise_floor(own, own.null, data, sigma, 0)
    assert after[0].rmse > 10 * floor[0].rmse  # what smoothing shifts the starts by is no part of the floor
    assert missed(own, own.null, data, sigma, 0) == []
    assert [f.where for f in missed(other, other.null, data, sigma, 0)] == ["0 and 1"]


def test_a_sensor_at_a_tied_joint_is_told() -> None:
    xml = WITH_WHEEL.replace(
        "<actuator>", '<equality><joint joint1="hinge" joint2="axle" active="{}"/></equality><actuator>'
    )
    on, off, free = (compiled(text) for text in (xml.format("true"), xml.format("false"), WITH_WHEEL))
    named = [LIBRARY["sensor_gain"]("axle", change=0.1), LIBRARY["coulomb_friction"]("hinge", level=0.1)]
    assert [f.where for f in tied_sensors(on, named)] == ["sensor_gain(axle)"]
    assert tied_sensors(off, named) == tied_sensors(free, named) == []


def test_what_explains_nothing_and_predicts_worse_is_told() -> None:
    worse = replace(ERROR, rmse=np.array([1.4e-3, 3e-3]))
    whole = replace(ERROR, horizon="whole run", rmse=np.array([1e-9, 1e-9]))  # of a few runs: chance
    (found,) = no_nearer([ERROR, replace(ERROR, horizon="whole run")], [worse, whole])
    assert "worse with what is listed (worst for b, 0.5 s ahead: 0.001 before, 0.003 after)" in found.message
    soon, late = replace(ERROR, horizon=0.1), replace(ERROR, horizon=1.0)  # much worse soon, somewhat better late
    (found,) = no_nearer([soon, late], [replace(soon, rmse=3 * soon.rmse), replace(late, rmse=0.8 * late.rmse)])
    assert "0.1 s ahead" in found.message
    assert no_nearer([ERROR], [replace(ERROR, rmse=1.04 * ERROR.rmse)]) == []  # a trifle
    assert no_nearer([worse], [ERROR]) == no_nearer([whole], [worse]) == no_nearer([], []) == []


PAIR = """<mujoco><option timestep="0.02" integrator="Euler"/><worldbody>
<body><joint name="still" axis="0 1 0"/><geom size="0.01" mass="1" pos="0 0 -0.3"/></body>
<body pos="0 1 0"><joint name="swings" axis="0 1 0"/><geom size="0.01" mass="1" pos="0 0 -0.1"/></body>
</worldbody></mujoco>"""


def test_the_models_own_steps_are_compared_where_positions_are() -> None:
    model = mujoco.MjModel.from_xml_string(PAIR)
    time = np.arange(200) * 0.02
    swing = 0.5 * np.cos(np.sqrt(9.81 / 0.1) * time)
    table = {"time": time, "qpos.still": np.zeros(200), "qpos.swings": swing}
    data = replace(Measurements.from_tables({"run": table}), unobserved=("still",))
    fine = Simulation(discretised(model, data, fine=True), [], 1)
    sigma = np.array([1e-12, 1e-3])
    (found,) = own_steps(model, fine, fine.null, data, sigma, 0.5)
    assert "(EULER, 0.02 s)" in found.message
    assert "at swings, where the noise is 0.001" in found.message
    model.opt.timestep, model.opt.integrator = 0.002, mujoco.mjtIntegrator.mjINT_RK4
    assert own_steps(model, fine, fine.null, data, sigma, 0.5) == []


@pytest.mark.parametrize(("step", "told"), [(0.02, False), (0.001, True)])
def test_transitions_of_finer_steps_than_the_models_are_told(step: float, told: bool) -> None:
    model, target = (mujoco.MjModel.from_xml_string(PAIR) for _ in range(2))
    target.opt.timestep, state, rows = step, mujoco.MjData(target), []
    state.qpos[:] = 0.3, 0.8
    for _ in range(100):
        rows.append([*state.qpos, *state.qvel])
        mujoco.mj_step(target, state, round(0.04 / step))
    table = dict(zip(("qpos.still", "qpos.swings", "qvel.still", "qvel.swings"), np.array(rows).T))
    tables = {"run": {"time": 0.04 * np.arange(100), **table}}
    data = replace(Measurements.from_tables(tables), exact=True, simulated=True)
    own = Simulation(model, [], 1)
    problem = Problem(own, cut(model, data, noise_levels(data), 0.16, 20), [])

    def hints(data: Measurements) -> list[Finding]:
        task: Any = SimpleNamespace(fitted=data, settings=DEFAULTS)
        fit: Any = SimpleNamespace(problem=problem, values=own.null, free=np.empty(0, dtype=int), horizon=0.16)
        return FinerSteps().hints(task, None, fit)  # type: ignore[arg-type]

    found = hints(data)
    assert [f.kind for f in found] == ["time step"] * told
    assert not told or "with steps of 5 ms in place of 20 ms" in found[0].message
    assert hints(replace(data, exact=False)) == []


def named(actuator: str, torque: float = -3.75) -> list[str]:
    model = mujoco.MjModel.from_xml_string(SERVO.format(actuator))
    effects = [TorqueOffset("elbow", offset=torque), Spring("elbow", stiffness=1.0)]
    for effect in effects:
        effect.bind(model)
    return [f.message for f in encoder_zeros(model, effects)]


def test_a_constant_torque_where_a_servo_holds_may_be_a_zero_of_the_recordings_own() -> None:
    (message,) = named('<position joint="elbow" kp="30"/>')
    assert "two zeros that differ by -0.125 rad" in message
    (geared,) = named('<position joint="elbow" kp="30" gear="0.5"/>')
    assert "two zeros that differ by -0.5 rad" in geared
    for other in ('<motor joint="elbow"/>', '<velocity joint="elbow" kv="3"/>'):
        assert named(other) == []


def test_a_delay_far_shorter_than_a_sample_may_be_a_clocks() -> None:
    late = LIBRARY["sensor_delay"]("elbow", delay=2.5e-4), LIBRARY["command_delay"]("motor", delay=8e-3)
    (found,) = brief_delays([*late, TorqueOffset("elbow", offset=1.0)], 0.02)
    assert found.where == "sensor_delay(elbow)"
    assert "0.25 ms are 1.2% of the 20 ms between two samples" in found.message
    assert found.message.endswith("and a simulator that steps 0.5 ms")
    assert brief_delays(late, 0.002) == []


HINGED = """<mujoco><option timestep="0.001" integrator="RK4"/><worldbody><body>
<joint name="hinge" axis="0 1 0" damping="0.05" {}/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
HOLDS = 'solreffriction="0.002 1" solimpfriction="0.99 0.99"'


@pytest.mark.slow
@pytest.mark.parametrize("constraint", ["", HOLDS], ids=["creeps", "holds"])
def test_friction_that_creeps_as_mujocos_does_by_default_is_told(constraint: str) -> None:
    model = mujoco.MjModel.from_xml_string(HINGED.format(f'frictionloss="0.3" {constraint}'))
    rng, tables = np.random.default_rng(0), {}
    for run in range(4):
        data, rows = mujoco.MjData(model), []
        data.qpos[0], phase = rng.uniform(-1, 1), rng.uniform(0, 6)
        for _ in range(150):
            data.ctrl[0] = 0.9 * np.sin(phase + 2.0 * data.time)
            rows.append((data.time, data.qpos[0] + rng.normal(0, 5e-4), data.ctrl[0]))
            mujoco.mj_step(model, data, 10)
        tables[f"run{run}"] = dict(zip(("time", "qpos.hinge", "ctrl.motor"), np.array(rows).T))
    known = [LIBRARY["coulomb_friction"]("hinge", level=0.3)]
    coarse = HINGED.format("").replace('timestep="0.001"', 'timestep="0.004"')  # fine enough without the constraint
    data = Measurements.from_tables(tables)
    report = trace(coarse, data, ["hinge.damping"], known=known, candidates=[], threads=1)
    assert (report.verdict == "complete") == bool(constraint)
    told = [f.where for f in report.findings if f.kind == FindingKind.SOFT_FRICTION]
    assert told == ([] if constraint else ["coulomb_friction(hinge)"])
