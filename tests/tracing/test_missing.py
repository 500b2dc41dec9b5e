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
from sb3_rpto.tracing import Measurements
from sb3_rpto.tracing.missing import missing_forces
from sb3_rpto.tracing.residuals import ForceResidual, force_residuals, summary

RATE, LEVEL = 25, 0.15  # Hz, N·m


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
        assert np.median(r.force) == pytest.approx(LEVEL, rel=0.03)  # damping takes its part within a step
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
            np.testing.assert_array_equal(getattr(r, name), getattr(plain, name))


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


def test_noisy_samples_are_differentiated() -> None:
    data = recorded([TorqueOffset("hinge", offset=LEVEL)], episodes=2, duration=2.0)
    simulation = Simulation(compiled(), [], 1)
    for r, plain in zip(missing(data), force_residuals(simulation, np.empty(0), data)):
        np.testing.assert_array_equal(r.force, plain.force)
