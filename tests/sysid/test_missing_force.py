"""What is missing in exact samples that lie as far apart as decisions, where differences are no accelerations."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated import compiled, recorded

from sb3_rpto.effects import Simulation, declare
from sb3_rpto.effects.commands import CommandDelay
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.problem.inverse_dynamics import ForceResidual, force_residuals, learnable_share, summary
from sb3_rpto.sysid.problem.missing_force import missing_forces

RATE, LEVEL = 25, 0.15  # Hz, N·m
ARRAYS = ("time", "qpos", "qvel", "ctrl", "qfrc", "enabled", "usable", "placed")


def decided(planted: list[Effect], model: mujoco.MjModel | None = None) -> Measurements:
    return recorded(planted, model, episodes=3, duration=4.0, noise=0.0, exact=True, rate=RATE)


def missing(
    data: Measurements, effects: list[Effect] | None = None, model: mujoco.MjModel | None = None
) -> list[ForceResidual]:
    simulation = Simulation(model or compiled(), effects or [], 1)
    return missing_forces(simulation, simulation.values(), data)


@pytest.mark.parametrize("integrator", ["mjINT_EULER", "mjINT_RK4"])
def test_a_constant_torque_shows_as_what_it_is(integrator: str) -> None:
    model = compiled()
    model.opt.integrator = getattr(mujoco.mjtIntegrator, integrator)
    found = missing(decided([TorqueOffset("hinge", offset=LEVEL)], model), model=model)
    assert len(found) == 3
    for r in found:
        assert len(r.time) > 90
        assert np.median(r.force) == pytest.approx(LEVEL, rel=0.05)  # damping takes its part within a step
        np.testing.assert_allclose(r.force, LEVEL, rtol=0.25)


@pytest.mark.parametrize("effect", [CoulombFriction("hinge", level=LEVEL), CommandDelay("motor", delay=0.02)])
def test_nothing_is_left_of_what_is_known_where_inverse_dynamics_leave_something(effect: Effect) -> None:
    data = decided([effect])
    simulation = Simulation(compiled(), [effect], 1)
    before, after = summary(missing(data)), summary(missing(data, [effect]))
    assert before[0] > 0.1
    assert after[0] < 1e-6
    assert summary(force_residuals(simulation, simulation.values(), data))[0] > 0.005


def test_friction_shows_against_the_motion() -> None:
    found = missing(decided([CoulombFriction("hinge", level=LEVEL)]))
    force, speed = (np.concatenate([getattr(r, n)[:, 0] for r in found]) for n in ("force", "qvel"))
    fast = np.abs(speed) > 0.5 * np.abs(speed).max()
    assert fast.sum() > 30
    np.testing.assert_allclose(force[fast], -LEVEL * np.sign(speed[fast]), rtol=0.15)


def test_a_declared_inertia_is_in_the_mass_matrix() -> None:
    (armature,) = declare(compiled(), ["hinge.armature"])
    heavy = armature.with_values(np.array([0.5]))
    (found,) = {
        round(float(np.median(r.force)), 2)
        for r in missing(decided([heavy, TorqueOffset("hinge", offset=LEVEL)]), [heavy])
    }
    assert found == LEVEL


def test_every_row_is_that_of_inverse_dynamics_but_for_the_force() -> None:
    data = decided([CoulombFriction("hinge", level=LEVEL)])
    simulation = Simulation(compiled(), [], 1)
    for r, plain in zip(missing(data), force_residuals(simulation, np.empty(0), data)):
        assert r.episode == plain.episode
        for name in ("time", "qpos", "qvel", "load", "command"):
            np.testing.assert_array_equal(getattr(r, name), getattr(plain, name)[:-1])  # the last leads nowhere


def test_unknown_states_are_left_out() -> None:
    data = decided([TorqueOffset("hinge", offset=LEVEL)])
    e = data.episodes[0]
    holes = replace(e, usable=(np.arange(len(e)) < 40) | (np.arange(len(e)) > 50))
    (found,) = missing(replace(data, episodes=[holes]))
    rows = np.rint(found.time * RATE).astype(int)
    assert not set(rows) & set(range(39, 51))  # the step to the first of them is not known either
    assert set(rows) > set(range(5, 38)) | set(range(52, 90))
    unknown = replace(e, usable=np.zeros(len(e), dtype=bool))
    assert missing(replace(data, episodes=[unknown])) == []


FLOATING = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="base">{free}
  <geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/>
  <body name="arm"><joint name="hinge" axis="0 1 0" damping="0.01"/>
  <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1" contype="0" conaffinity="0"/></body>
  </body></worldbody><actuator><motor name="m" joint="hinge"/></actuator></mujoco>"""


@pytest.mark.parametrize("free", ["", '<freejoint name="root"/>'])
def test_a_robot_that_floats_lacks_what_one_lacks_that_is_bolted_down(free: str) -> None:
    """What moves the base is no force on it: the joint's torque moves both."""
    model = mujoco.MjModel.from_xml_string(FLOATING.format(free=free))
    rng, mj, rows = np.random.default_rng(0), mujoco.MjData(model), []
    for _ in range(100):
        mj.ctrl[:] = rng.uniform(-0.1, 0.1)
        rows.append([mj.time, *mj.qpos, *mj.qvel, *mj.ctrl])
        mj.qfrc_applied[-1] = 0.02
        mujoco.mj_step(model, mj, 4)
    named = [*([f"root.{i}" for i in range(7)] if free else []), "hinge"]
    moved = [*([f"root.{i}" for i in range(6)] if free else []), "hinge"]
    names = ["time", *(f"qpos.{n}" for n in named), *(f"qvel.{n}" for n in moved), "ctrl.m"]
    data = replace(Measurements.from_tables({"a": dict(zip(names, np.array(rows).T))}), exact=True)
    (found,) = missing(data, model=model)
    np.testing.assert_allclose(found.force[:, -1], 0.02, rtol=0.05)
    assert np.abs(found.force[:, :-1]).max(initial=0.0) < 0.005  # the inertia changes within a step


def test_the_shortest_episodes_are_left_out() -> None:
    data = decided([TorqueOffset("hinge", offset=LEVEL)])
    short = [replace(e, **{n: getattr(e, n)[:rows] for n in ARRAYS}) for e, rows in zip(data.episodes, (5, 6, 9))]
    found = missing(replace(data, episodes=short))
    assert all(len(r.time) > 1 for r in found)
    assert [r.episode for r in found] == [e.name for e in short[1:]]
    learnable_share(found, 0)


def test_noisy_samples_are_differentiated() -> None:
    data = recorded([TorqueOffset("hinge", offset=LEVEL)], episodes=2, duration=2.0)
    simulation = Simulation(compiled(), [], 1)
    for r, plain in zip(missing(data), force_residuals(simulation, np.empty(0), data)):
        np.testing.assert_array_equal(r.force, plain.force)
