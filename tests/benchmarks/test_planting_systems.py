from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.tracing.planting import SYSTEMS
from benchmarks.tracing.planting.simulation import Simulation


def with_extras(system):
    links = tuple(replace(link, armature=0.02) for link in system.links)
    return replace(system, links=links, tilt=0.2)


@pytest.mark.parametrize("extras", [lambda s: s, with_extras, lambda s: replace(s, payload=0.3)])
@pytest.mark.parametrize("name", SYSTEMS)
def test_accelerations_are_those_of_mujoco(name, extras):
    system = extras(SYSTEMS[name])
    model = mujoco.MjModel.from_xml_string(system.xml)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, qd, tau = 3 * rng.normal(size=(3, 1, len(system.links)))
        tau = np.clip(tau, -system.peak, system.peak)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q[0], qd[0], tau[0, system.driven]
        mujoco.mj_forward(model, data)
        ours = system.acceleration(q, qd, tau)[0]
        np.testing.assert_allclose(ours, data.qacc, rtol=0, atol=1e-9 * np.abs(ours).max())


@pytest.mark.parametrize("name", SYSTEMS)
def test_mjcf_has_the_names_and_the_declared_values(name):
    system = SYSTEMS[name]
    model = mujoco.MjModel.from_xml_string(system.xml)
    assert model.opt.timestep == 0.002
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert [model.joint(i).name for i in range(model.njnt)] == list(system.joints)
    assert [model.actuator(i).name for i in range(model.nu)] == list(system.motors)
    for parameter, value in system.declared.items():
        owner, _, field = parameter.partition(".")
        read = model.joint(owner).damping[0] if field == "damping" else model.body(owner).mass[0]
        assert read == value


@pytest.mark.parametrize("name", SYSTEMS)
def test_energy_is_kept_without_damping(name):
    system = SYSTEMS[name]
    system = system.with_declared({f"{joint}.damping": 0.0 for joint in system.joints})
    q = np.full((2, len(system.links)), 1.0) * np.array([[1.0], [0.5]])
    drift = []
    for h in (0.0005, 0.00025):
        sim = Simulation(system, [], q, np.ones_like(q), np.random.default_rng(0))
        before, worst = system.energy(sim.q, sim.qd), np.zeros(2)
        for k in range(20):
            sim.hold(np.zeros_like(q), np.full(2, 0.05 * k), np.full(2, 0.05), round(0.05 / h))
            worst = np.maximum(worst, np.abs(system.energy(sim.q, sim.qd) - before))
        drift.append(worst.max())
    assert drift[0] < 1e-4
    assert drift[1] < drift[0] / 3, "the error must fall with the square of the step"


def test_damped_wheel_decays_exponentially():
    wheel = replace(SYSTEMS["pendulum"], vertical=False)
    rate = wheel.damping[0] / (0.5 * 0.6**2 / 3)
    sim = Simulation(wheel, [], np.zeros((1, 1)), np.full((1, 1), 2.0), np.random.default_rng(0))
    sim.hold(np.zeros((1, 1)), np.zeros(1), np.ones(1), 2000)
    np.testing.assert_allclose(sim.qd, 2 * np.exp(-rate), rtol=1e-7)
    np.testing.assert_allclose(sim.q, 2 * (1 - np.exp(-rate)) / rate, rtol=1e-7)


def test_unknown_declared_parameter_is_refused():
    with pytest.raises(ValueError, match=r"hinge\.mass"):
        SYSTEMS["pendulum"].with_declared({"hinge.mass": 1.0})
