"""Angles in degrees are refused before the search where the data show it, and no fast turns in rad are."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, compiled, recorded

from sb3_rpto.effects import LIBRARY
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data.angle_units import check_degrees, large_angles
from sb3_rpto.sysid.problem.data_model_consistency import check_against

FRICTION = LIBRARY["coulomb_friction"]("hinge", level=0.15)
WHEEL = """<mujoco><option timestep="0.005"/><worldbody><body><joint name="axle" axis="0 0 1" damping="{}"/>
<geom type="cylinder" size=".1 .1" mass="{}"/></body></worldbody><actuator>{}</actuator></mujoco>"""


def in_degrees(data: Measurements, wrap: bool = False) -> Measurements:
    table = {name: column for name, column in data.tables().items() if not name.startswith("qvel")}
    for name in [name for name in table if name.startswith("qpos")]:
        degrees = np.rad2deg(table[name])
        table[name] = (degrees + 180) % 360 - 180 if wrap else degrees
    return Measurements.from_tables({"runs": table})


@pytest.mark.parametrize("effects", [[], [FRICTION], [LIBRARY["command_delay"]("motor", delay=0.02)]])
def test_a_pendulum_in_degrees_is_refused_whatever_the_model_lacks(effects: list) -> None:
    data = recorded(effects)
    check_against(compiled(), data)
    with pytest.raises(ValueError, match=r"'qpos.hinge' spans \d+ turns.*read in degrees.* give angles in rad"):
        check_against(compiled(), in_degrees(data))
    lighter = PENDULUM.replace('mass="0.5"', 'mass="0.4"')
    with pytest.raises(ValueError, match="give angles in rad"):
        check_degrees(compiled(lighter), in_degrees(data))


def test_degrees_that_are_wrapped_are_refused() -> None:
    data = recorded(start=(0.5, 25.0))
    assert np.ptp(data.episodes[0].qpos) > 2 * np.pi
    with pytest.raises(ValueError, match="jumps by about 360"):
        check_degrees(compiled(), in_degrees(data, wrap=True))


def spun(mass: float, damping: float, gear: float) -> Measurements:
    motor = f'<motor name="m" joint="axle" gear="{gear}"/>'
    model, tables = compiled(WHEEL.format(damping, mass, motor)), {}
    for run in range(3):
        data, rng, rows = mujoco.MjData(model), np.random.default_rng(run), []
        data.qvel[:] = 60.0
        told = np.repeat(rng.uniform(-1, 1, 10), 40)
        for now in told:
            rows.append(data.qpos[0])
            data.ctrl[:] = now
            mujoco.mj_step(model, data, 2)
        noisy = np.array(rows) + 1e-3 * rng.standard_normal(len(rows))
        tables[f"run{run}"] = {"time": np.arange(len(rows)) / 100, "qpos.axle": noisy, "ctrl.m": told}
    return Measurements.from_tables(tables)


@pytest.mark.parametrize("mass", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("damping", [0.0, 0.003])
@pytest.mark.parametrize("gear", [0.0, 0.05, 1.0])
def test_fast_wheels_in_rad_are_not(mass: float, damping: float, gear: float) -> None:
    """Also where the model's own mass and gear are far off, and its damping is none."""
    data = spun(mass, damping, gear)
    model = compiled(WHEEL.format(0, 1, '<motor name="m" joint="axle" gear=".3"/>'))
    assert large_angles(model, data)
    check_degrees(model, data)
    check_degrees(model, replace(data, exact=True))
