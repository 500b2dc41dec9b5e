"""Recordings of a machine, and of a simulation in the model's own steps."""

import gymnasium as gym
import numpy as np
import pytest
from simulated import compiled, recorded

from sb3_rpto.effects import LIBRARY
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.data_origin import are_exact_states, find_origin, may_be_exact
from sb3_rpto.sysid.problem.problem import Assumptions, Inputs, prepare

#: semi-implicit steps of 5 ms err by far more than a tenth of a milliradian
OWN = """<mujoco><option timestep="0.005"/><worldbody><body name="pole">
<joint name="hinge" axis="0 -1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
DECLARED = ["hinge.damping", "pole.mass"]


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_complete_simulator_that_was_logged_is_complete(noise: float) -> None:
    data = recorded([], compiled(OWN), episodes=6, noise=noise)
    report = trace(OWN, data, DECLARED, candidates=["coulomb_friction", "torque_offset"], threads=1)
    assert report.verdict == "complete"
    assert report.data.exact == (noise == 0)
    assert [f.kind for f in report.findings].count(FindingKind.SIMULATED) == 1
    np.testing.assert_allclose([t.effect.values[0] for t in report.declared], [0.05, 0.5], rtol=1e-2)


def test_a_machine_whose_motion_is_continuous_is_none() -> None:
    fine = compiled(OWN.replace('timestep="0.005"', 'timestep="0.001" integrator="RK4"'))
    data = recorded([], fine, episodes=3, noise=1e-4)
    assert find_origin(compiled(OWN), data, DECLARED, np.array([1e-4]), 0.4, 1) == "machine"


def test_what_is_missing_is_not_taken_for_steps() -> None:
    fine = compiled(OWN.replace('timestep="0.005"', 'timestep="0.001" integrator="RK4"'))
    data = recorded([CoulombFriction("hinge", level=0.1)], fine, episodes=3)
    assert find_origin(compiled(OWN), data, DECLARED, np.array([1e-3]), 0.4, 1) == "machine"


@pytest.mark.slow
def test_own_steps_are_recognised_once_what_is_missing_is_found() -> None:
    """At first a large friction hides how the steps err; found, it is out of the way, and the search begins anew."""
    data = recorded([CoulombFriction("hinge", level=0.3)], compiled(OWN), noise=1e-3)
    assert find_origin(compiled(OWN), data, DECLARED, np.array([1e-3]), 0.8, 1) == "machine"
    report = trace(OWN, data, DECLARED, candidates=["coulomb_friction"], threads=1)
    assert report.verdict == "explained"
    assert ["searched again" in f.message for f in report.findings if f.kind == FindingKind.SIMULATED] == [True]
    np.testing.assert_allclose([t.effect.values[0] for t in report.declared], [0.05, 0.5], rtol=0.05)
    assert report.effects[0].effect.values == pytest.approx([0.3], rel=0.02)


def test_what_is_told_to_be_simulated_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_rpto.sysid.problem.problem.find_origin", lambda *_: pytest.fail("it was told"))
    inputs = Inputs(OWN, recorded([], compiled(OWN)), DECLARED, candidates=[], horizon=0.4, threads=1)
    task = prepare(inputs, Assumptions(simulated=True))
    assert task.fitted.simulated
    assert "simulated" not in [f.kind for f in task.findings]


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 0.5])
@pytest.mark.parametrize("velocities", [True, False])
def test_a_simulator_that_was_logged_as_slowly_as_it_is_commanded_is_exact(offset: float, velocities: bool) -> None:
    """What the motion does between such samples looks like noise."""
    env = gym.make("InvertedPendulum-v5")
    robot = apply_effects(env, [LIBRARY["torque_offset"]("hinge", offset=offset)] if offset else [])
    rng, rows = np.random.default_rng(0), []
    for run in range(12):
        robot.reset(seed=run)
        state = robot.unwrapped.data
        for step, command in enumerate(rng.uniform(-1, 1, (16, 1))):
            rows.append([run, 0.04 * step, *state.qpos, *command, *state.qvel])
            robot.step(command)
    names = ["episode", "time", "qpos.slider", "qpos.hinge", "ctrl.slide", "qvel.slider", "qvel.hinge"]
    table = dict(zip(names[: 7 if velocities else 5], np.array(rows).T))
    report = trace(env, Measurements.from_tables({"log": table}), candidates=["torque_offset", "coulomb_friction"])
    if not velocities:
        assert report.verdict == "unexplained"
        return
    assert report.verdict == ("explained" if offset else "complete")
    assert [traced.label for traced in report.effects] == (["torque_offset(hinge)"] if offset else [])
    assert all(traced.effect.values == pytest.approx([offset], rel=1e-4) for traced in report.effects)
    assert ["searched again" in f.message for f in report.findings if f.kind == FindingKind.SIMULATED] == [True]


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_states_without_noise_are_met_with_what_was_found(noise: float) -> None:
    friction = CoulombFriction("hinge", level=0.2)
    data = recorded([friction], compiled(OWN), episodes=3, rate=40, noise=noise)
    assert not are_exact_states(compiled(OWN), data, DECLARED, 0.4, 1)
    assert are_exact_states(compiled(OWN), data, DECLARED, 0.4, 1, [friction]) == (noise == 0)


@pytest.mark.slow
def test_what_explains_a_slow_log_of_a_simulator_does_not_hide_that_it_is_exact() -> None:
    """Taken for noise, the motion between its samples leaves wrong numbers unnoticed: a length of 0.625 for 0.6."""
    env = gym.make("InvertedPendulum-v5")
    robot = apply_effects(env, [LIBRARY["coulomb_friction"]("slider", level=20.0)])
    rng, rows = np.random.default_rng(0), []
    for run in range(6):
        robot.reset(seed=run)
        rng.uniform()
        state = robot.unwrapped.data
        for step in range(80):
            command = np.array([1.5 * rng.uniform(-1, 1)], dtype=np.float32)
            rows.append([run, 0.04 * step, *state.qpos, *state.qvel, *command])
            robot.step(command)
    names = ["episode", "time", "qpos.slider", "qpos.hinge", "qvel.slider", "qvel.hinge", "ctrl.slide"]
    data = Measurements.from_tables({"log": dict(zip(names, np.array(rows).T))})
    kinds = ["coulomb_friction", "viscous_friction", "torque_offset", "command_gain"]
    report = trace(env, data, ["pole.length"], candidates=kinds, threads=1)
    assert report.verdict == "explained"
    assert report.data.exact
    (length,), (friction,) = report.declared, report.effects
    assert length.effect.values == pytest.approx([0.6], rel=1e-4)
    assert friction.label == "coulomb_friction(slider)"
    assert friction.effect.values == pytest.approx([20.0], rel=1e-4)


@pytest.mark.slow
def test_a_machine_that_was_logged_slowly_and_lacks_what_is_not_looked_for_is_none() -> None:
    fine = compiled(OWN.replace('timestep="0.005"', 'timestep="0.001" integrator="RK4"'))
    data = recorded([CoulombFriction("hinge", level=0.2)], fine, rate=40)
    assert may_be_exact(data)
    report = trace(OWN, data, DECLARED, candidates=["torque_offset"], threads=1)
    assert not report.data.exact
    assert report.verdict not in ("complete", "explained")
