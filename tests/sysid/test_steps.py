"""Steps in time that err, and commands logged late, do not pass for something that the model lacks."""

import mujoco
import numpy as np
import pytest
from simulated import briefly

from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.data_model_consistency import carried_weights, soft_friction, soft_ties
from sb3_rpto.sysid.problem.problem import IdentificationProblem

CRANK = """
<mujoco><option timestep="0.002"/><worldbody><body name="crank">
  <joint name="crank" axis="0 1 0" damping="0.05" {friction}/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6"/>
</body></worldbody><actuator><motor name="motor" joint="crank"/></actuator></mujoco>
"""
# As hard as dry friction is; MuJoCo's usual one gives way over many milliseconds.
HARD = 'frictionloss="0.25" solreffriction="0.0008 1" solimpfriction="0.999 0.9999 0.001"'


def crank(friction: str, late: int = 0) -> Measurements:
    """The machine, finely simulated; rows hold the commands of so many rows before."""
    model, rng, tables = mujoco.MjModel.from_xml_string(CRANK.format(friction=friction)), np.random.default_rng(1), {}
    model.opt.timestep, model.opt.integrator = 2e-4, int(mujoco.mjtIntegrator.mjINT_RK4)
    for run in range(5):
        data, t = mujoco.MjData(model), np.arange(500) / 250
        frequencies, phases = rng.uniform(0.3, 2.5, (4, 1)), rng.uniform(0, 6.28, (4, 1))
        torque, position = np.sin(2 * np.pi * frequencies * t + phases).sum(0), []
        for now in torque:
            position.append(data.qpos[0])
            data.ctrl[0] = now
            mujoco.mj_step(model, data, 20)
        noisy = np.array(position) + 1e-3 * rng.standard_normal(len(t))
        tables[f"run{run}"] = {"time": t, "qpos.crank": noisy, "ctrl.motor": np.roll(torque, late)}
    return Measurements.from_tables(tables)


@pytest.fixture(scope="module")
def rubbing() -> Measurements:
    return crank(HARD)


@pytest.mark.slow
def test_dry_friction_is_judged_with_steps_that_meet_its_kinks(rubbing: Measurements) -> None:
    model = CRANK.format(friction="")
    report = trace(model, rubbing, ["crank.damping"], candidates=["coulomb_friction"], threads=1)
    assert report.verdict == "explained"
    assert [t.label for t in report.effects] == ["coulomb_friction(crank)"]
    assert report.effects[0].effect.values == pytest.approx([0.25], rel=0.02)
    assert [f.where for f in report.findings if f.kind == FindingKind.TIME_STEP] == ["model"]


@pytest.mark.slow
def test_a_rubbing_machine_whose_friction_is_declared_is_complete(rubbing: Measurements) -> None:
    model = CRANK.format(friction='frictionloss="0.1" solreffriction="0.001 1" solimpfriction="0.99 0.99"')
    declared = ["crank.damping", "crank.frictionloss"]
    report = briefly(model, rubbing, declared, candidates=["coulomb_friction"])
    assert report.verdict == "complete"
    assert not [f for f in report.findings if f.kind == FindingKind.SOFT_FRICTION]


def test_friction_that_creeps_is_said_to() -> None:
    model = mujoco.MjModel.from_xml_string(CRANK.format(friction='frictionloss="0.1"'))
    assert [f.where for f in soft_friction(model)] == ["joint crank"]
    assert not soft_friction(mujoco.MjModel.from_xml_string(CRANK.format(friction="")))


def test_bodies_whose_weight_the_model_carries_are_said_to_be() -> None:
    arm = """<mujoco><worldbody><body name="link" gravcomp="{}"><joint name="a"/><geom size="0.1"/></body></worldbody>
    </mujoco>"""
    assert [f.where for f in carried_weights(mujoco.MjModel.from_xml_string(arm.format(1)))] == ["body link"]
    assert not carried_weights(mujoco.MjModel.from_xml_string(arm.format(0)))


def test_ties_that_give_way_are_said_to() -> None:
    fingers = """<mujoco><worldbody><body><joint name="a" type="slide"/><geom size="0.1"/></body><body pos="1 0 0">
    <joint name="b" type="slide"/><geom size="0.1"/></body></worldbody>
    <equality><joint name="mimic" joint1="a" joint2="b" {}/></equality></mujoco>"""
    for written, places in (
        ("", ["equality mimic"]),
        ('active="false"', []),
        ('solref="0.002 1" solimp="0.99 0.999 0.0001"', []),
        ('solref="-5000 -100"', []),  # a stiffness that somebody has chosen
    ):
        assert [f.where for f in soft_ties(mujoco.MjModel.from_xml_string(fingers.format(written)))] == places


@pytest.mark.slow
def test_finer_steps_are_not_taken_where_the_model_is_adequate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(IdentificationProblem, "in_finer_steps", lambda *_: pytest.fail("nothing is missing"))
    model, rng, tables = mujoco.MjModel.from_xml_string(CRANK.format(friction="")), np.random.default_rng(0), {}
    model.opt.timestep = 2e-4
    for run in range(4):
        data, position = mujoco.MjData(model), []
        data.qpos[0] = rng.uniform(-2, 2)
        for _ in range(500):
            position.append(data.qpos[0])
            mujoco.mj_step(model, data, 20)
        noisy = np.array(position) + 1e-3 * rng.standard_normal(500)
        tables[f"run{run}"] = {"time": np.arange(500) / 250, "qpos.crank": noisy, "ctrl.motor": np.zeros(500)}
    data = Measurements.from_tables(tables)
    report = briefly(CRANK.format(friction=""), data, ["crank.damping"], candidates=["coulomb_friction"])
    assert report.verdict == "complete"


@pytest.mark.slow
@pytest.mark.parametrize(("late", "friction", "said"), [(1, "", ["all episodes, ctrl"]), (0, HARD, [])])
def test_commands_logged_after_they_acted_are_found(late: int, friction: str, said: list[str]) -> None:
    model = CRANK.format(friction="")
    report = briefly(model, crank(friction, late), ["crank.damping"], candidates=["command_gain"])
    assert report.verdict not in ("complete", "explained")
    assert [f.where for f in report.findings if f.kind == FindingKind.EARLY_RESPONSE] == said
