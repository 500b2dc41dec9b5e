"""Recordings of a machine that touches the floor now and then."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.contacts import contact_changes
from sb3_rpto.sysid.shooting.initial_states import misfit
from sb3_rpto.sysid.shooting.windows import noise_levels

LEG = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="trunk" pos="0 0 0.6">
      <joint name="height" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.1 0.1 0.05" mass="2" contype="0" conaffinity="0"/>
      <body name="leg">
        <joint name="knee" type="slide" axis="0 0 1" damping="4" stiffness="400"/>
        <geom name="foot" type="sphere" size="0.05" pos="0 0 -0.4" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="thrust" joint="knee" gear="40"/></actuator>
</mujoco>
"""
RATE, FINE = 200, 20


def hops(xml: str = LEG, runs: int = 8, samples: int = 300, noise: float = 1e-3) -> Measurements:
    """A leg that is pushed at random and hops, by steps of 0.25 ms; noisy positions, no velocities."""
    model, tables = mujoco.MjModel.from_xml_string(xml), {}
    model.opt.timestep = 1 / RATE / FINE
    for run in range(runs):
        rng, data = np.random.default_rng(run), mujoco.MjData(model)
        told, path = np.repeat(rng.uniform(-1, 1, samples // 15), 15), []
        for command in told:
            path.append(data.qpos.copy())
            data.ctrl[:] = command
            mujoco.mj_step(model, data, FINE)
        shown = np.array(path) + noise * rng.standard_normal((samples, 2))
        time = np.arange(samples) / RATE
        tables[f"run{run}"] = {"time": time, "qpos.height": shown[:, 0], "qpos.knee": shown[:, 1], "ctrl.thrust": told}
    return Measurements.from_tables(tables)


@pytest.mark.parametrize(("heights", "changes"), [((0.0, 0.1), 0), ((0.0, -0.2), 9), ((-0.2, -0.2), 0)])
def test_touch_downs_and_lift_offs_are_counted(heights: tuple[float, float], changes: int) -> None:
    """The foot's sphere reaches the floor at a height of -0.15 m; every other sample is at the second height."""
    height = np.tile(heights, 5)
    table = {"time": np.arange(10) / 10, "qpos.height": height, "qpos.knee": 0 * height, "ctrl.thrust": 0 * height}
    data = Measurements.from_tables({"run": table})
    assert contact_changes(mujoco.MjModel.from_xml_string(LEG), data, noise_levels(data)) == pytest.approx(
        changes / 0.9
    )


def test_what_lies_on_the_floor_touches_it_all_the_time() -> None:
    height = -0.15 + 1e-3 * np.random.default_rng(0).standard_normal(200)
    table = {"time": np.arange(200) / 100, "qpos.height": height, "qpos.knee": 0 * height, "ctrl.thrust": 0 * height}
    model = mujoco.MjModel.from_xml_string(LEG)
    assert contact_changes(model, Measurements.from_tables({"run": table}), np.array([1e-3, 1e-7])) < 0.5
    assert not model.geom_margin.any()


BOX = """<mujoco><option timestep="0.002" cone="elliptic" impratio="10"/><worldbody>
<geom name="floor" type="plane" size="20 20 .1" friction="{} .005 .0001"/><body pos="0 0 .1">
<joint name="along" type="slide" axis="1 0 0"/><joint name="up" type="slide" axis="0 0 1"/>
<geom type="box" size=".1 .1 .1" mass="1" friction=".1 .005 .0001"/></body></worldbody>
<actuator><motor name="push" joint="along"/></actuator></mujoco>"""


@pytest.mark.slow
def test_the_friction_of_what_slides_is_found_in_windows_of_the_usual_length() -> None:
    model, tables = mujoco.MjModel.from_xml_string(BOX.format(0.55)), {}
    model.opt.timestep = 5e-4
    for run in range(4):
        rng, data, path = np.random.default_rng(run), mujoco.MjData(model), []
        told = 9 * np.repeat(rng.uniform(-1, 1, 9), 30)[:250]
        for command in told:
            path.append(data.qpos.copy())
            data.ctrl[:] = command
            mujoco.mj_step(model, data, 20)
        along, up = (np.array(path) + 1e-3 * rng.standard_normal((250, 2))).T
        tables[f"run{run}"] = {"time": np.arange(250) / 100, "qpos.along": along, "qpos.up": up, "ctrl.push": told}
    kinds = ["geom_friction", "viscous_friction", "coulomb_friction"]
    report = trace(BOX.format(0.5), Measurements.from_tables(tables), candidates=kinds, threads=1)
    assert report.verdict == "explained"
    (found,) = report.effects
    assert found.label == "geom_friction(floor)"
    assert found.effect.values == pytest.approx([0.05], abs=0.005)


@pytest.mark.parametrize(("jump", "low", "high"), [(0.0, 1.0, 1.8), (5.0, 4.0, 8.0)])
def test_a_smoothed_start_is_less_certain_where_a_velocity_jumps(jump: float, low: float, high: float) -> None:
    """Nine samples 5 ms apart about a jump by 5 m/s: a cubic misses them by 6 mm (RMS), the noise is 1 mm."""
    t = np.arange(-20, 21) / RATE
    path = 0.3 * t - 2 * t**2 + jump * np.maximum(t, 0) + 1e-3 * np.random.default_rng(0).standard_normal(41)
    table = {"time": t - t[0], "qpos.height": path, "qpos.knee": 0 * t, "ctrl.thrust": 0 * t}
    (episode,) = Measurements.from_tables({"run": table}).episodes
    assert low <= misfit(episode, 20, np.full(2, 1e-3))[0] <= high


@pytest.mark.slow
def test_a_complete_model_that_hops_is_complete() -> None:
    report = trace(LEG, hops(runs=6), ["knee.damping"], candidates=["coulomb_friction"], seed=0)
    (finding,) = (f for f in report.findings if f.kind == FindingKind.CONTACTS)
    assert "windows of 0.1 s" in finding.message
    assert report.verdict == "complete"
    assert report.declared[0].effect.values[0] == pytest.approx(4, rel=0.05)
