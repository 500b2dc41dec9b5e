"""Whole turns, jittered clocks and degrees: what is repaired or refused with the model or all runs beside it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, compiled, recorded

from sb3_rpto.effects import LIBRARY
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data.repairs import check_degrees, large_angles, remove_whole_turns, use_even_clock
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.data_model_consistency import check_against

TURN = 2 * np.pi
ANGLE = 0.4 * np.sin(np.linspace(0, 6, 200)) - 0.1


def arm(joint: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/><worldbody><body>
        <joint name="hinge" axis="0 1 0" {joint}/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/>
        </body></worldbody></mujoco>""")


def encoded(angle: np.ndarray) -> Measurements:
    return Measurements.from_tables({"run": {"time": np.arange(len(angle)) * 0.01, "qpos.hinge": angle}})


@pytest.mark.parametrize("joint", ['range="-1.5 1.5"', 'stiffness="0.5"'], ids=["limits", "spring"])
@pytest.mark.parametrize("start", [0, 30], ids=["begins below zero", "begins above zero"])
def test_a_wrapped_angle_comes_to_where_the_model_has_it(joint: str, start: int) -> None:
    angle = ANGLE[start:]
    data, found = remove_whole_turns(arm(joint), encoded(np.mod(angle, TURN)))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], angle, atol=1e-12)
    assert {f.kind for f in found} <= {FindingKind.WHOLE_TURNS}


def test_an_angle_outside_its_limits_is_shifted_though_it_never_wrapped() -> None:
    data, found = remove_whole_turns(arm('range="-1.5 1.5"'), encoded(ANGLE + TURN))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], ANGLE, atol=1e-12)
    assert [f.kind for f in found] == [FindingKind.WHOLE_TURNS]


@pytest.mark.parametrize("joint", ["", 'stiffness="0.5"'], ids=["free", "wound-up spring"])
def test_turns_that_may_be_meant_stay(joint: str) -> None:
    data, found = remove_whole_turns(arm(joint), encoded(ANGLE + 2 * TURN))
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], ANGLE + 2 * TURN)
    assert found == []


def test_what_no_turn_accounts_for_is_said_and_kept() -> None:
    _, found = remove_whole_turns(arm('range="-1.5 1.5"'), encoded(ANGLE + 1.4))
    assert FindingKind.OUTSIDE_LIMITS in [f.kind for f in found]


def test_degrees_are_refused_where_the_joints_limits_tell_them() -> None:
    with pytest.raises(
        ValueError, match=r"run, qpos.hinge spans \d+.* limits are -1.5 and 1.5 rad; give rad, not degrees"
    ):
        remove_whole_turns(arm('range="-1.5 1.5"'), encoded(np.degrees(ANGLE)))
    remove_whole_turns(arm(""), encoded(np.degrees(ANGLE)))  # a wheel may well turn so far


@pytest.mark.parametrize(("factor", "units"), [(1000, "mm"), (100, "cm or mm")])
def test_a_slide_in_other_units_is_refused_where_its_limits_tell_them(factor: float, units: str) -> None:
    with pytest.raises(ValueError, match=rf"qpos.hinge spans \d+.* limits are -1.5 and 1.5 m; give m, not {units}$"):
        remove_whole_turns(arm('type="slide" range="-1.5 1.5"'), encoded(factor * ANGLE))
    remove_whole_turns(arm('type="slide"'), encoded(factor * ANGLE))  # it may be long
    _, found = remove_whole_turns(arm('type="slide" range="-0.05 0.05"'), encoded(ANGLE))  # or the limits are wrong
    assert [f.kind for f in found] == [FindingKind.OUTSIDE_LIMITS]


def test_a_joint_without_a_name_has_whole_turns_too() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><compiler angle="radian"/><worldbody><body>
        <joint axis="0 1 0" range="-1.5 1.5"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/>
        </body></worldbody></mujoco>""")
    column = {"time": np.arange(len(ANGLE)) * 0.01, "qpos.joint0": ANGLE + TURN}
    data, found = remove_whole_turns(model, Measurements.from_tables({"run": column}))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], ANGLE, atol=1e-12)
    assert [f.kind for f in found] == [FindingKind.WHOLE_TURNS]


def servo(gear: float = 1.0) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><body>
        <joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/></body></worldbody>
        <actuator><position name="servo" joint="hinge" kp="6" kv=".3" gear="{gear}"/></actuator></mujoco>""")


def commanded(angle: np.ndarray, command: np.ndarray, **columns: np.ndarray) -> Measurements:
    table = {"time": np.arange(len(angle)) * 0.01, "qpos.hinge": angle, "ctrl.servo": command, **columns}
    return Measurements.from_tables({"run": table})


@pytest.mark.parametrize("gear", [1.0, -2.0])
@pytest.mark.parametrize("centre", [4.0, 14.0], ids=["wraps", "wraps twice away"])
def test_what_a_servo_holds_comes_to_its_command(centre: float, gear: float) -> None:
    angle = centre + 3 * ANGLE
    encoder = np.mod(angle + np.pi, TURN) - np.pi
    data, found = remove_whole_turns(servo(gear), commanded(encoder, gear * (angle + 0.05)))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], angle, atol=1e-12)
    assert [f.kind for f in found] == [FindingKind.WHOLE_TURNS]


def test_a_servos_limits_are_its_own_where_another_actuator_takes_two_commands() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body>
        <joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/></body><body>
        <joint name="other" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/></body></worldbody>
        <actuator><pid name="two" joint="other" kp="1"/><position name="servo" joint="hinge" kp="6" ctrlrange="3 9"/>
        </actuator></mujoco>""")
    angle = np.full(200, 3.2)
    data, _ = remove_whole_turns(model, commanded(angle - TURN, np.full(200, -50.0)))  # held at the lower end
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], angle, atol=1e-12)


@pytest.mark.parametrize(
    ("command", "columns"),
    [
        (np.linspace(0, 3 * TURN, 200), {}),
        (ANGLE + TURN + 1.0, {}),
        (ANGLE + TURN, {"enabled.servo": np.zeros(200)}),
    ],
    ids=["is under way", "is too weak", "is off"],
)
def test_a_servo_that_does_not_hold_tells_no_turns(command: np.ndarray, columns: dict[str, np.ndarray]) -> None:
    data, found = remove_whole_turns(servo(), commanded(ANGLE, command, **columns))
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], ANGLE)
    assert found == []


# --- clocks ---


def stamped(stamps: float, samples: float, noise: float = 3e-4, slow: float = 1.0, lost: int = 0) -> Measurements:
    """Two runs of a fast swing at 100 Hz: its stamps, or its samples, are off their ticks by these seconds."""
    tables = {}
    for run in range(2):
        rng = np.random.default_rng(run)
        ticks = np.delete(np.arange(800), np.arange(100, 100 + lost))
        even = 0.01 * ticks
        taken = even + samples * rng.standard_normal(len(even))
        time = (taken if samples else even) + stamps * rng.standard_normal(len(even))
        q = np.sin(2 * np.pi * slow * taken) + noise * rng.standard_normal(len(even))
        tables[f"run{run}"] = {"time": time, "qpos.hinge": q, "ctrl.motor": np.zeros(len(even))}
    return Measurements.from_tables(tables)


@pytest.mark.parametrize("simulated", [False, True])
@pytest.mark.parametrize("lost", [0, 2])
def test_stamps_that_jitter_give_way_to_an_even_clock(lost: int, simulated: bool) -> None:
    there = stamped(stamps=3e-4, samples=0.0, lost=lost)
    data, findings = use_even_clock(replace(there, simulated=simulated))
    assert [f.kind for f in findings] == [FindingKind.EVEN_CLOCK] * 2
    assert not [f for f in data.findings if f.kind == FindingKind.JITTER]
    for e in data.episodes:
        ticks = np.round((e.time - e.time[0]) / 0.01)
        np.testing.assert_allclose(e.time, 0.01 * ticks + e.time[0], atol=1.2e-4)
        assert len(e) == 800 - lost


@pytest.mark.parametrize(
    ("stamps", "samples", "slow"),
    [
        pytest.param(0.0, 3e-4, 1.0, id="samples jitter"),
        pytest.param(0.0, 0.0, 1.0, id="nothing jitters"),
        pytest.param(3e-4, 0.0, 0.02, id="too slow to tell"),
    ],
)
def test_what_the_positions_do_not_speak_against_stays(stamps: float, samples: float, slow: float) -> None:
    there = stamped(stamps, samples, slow=slow)
    data, findings = use_even_clock(there)
    assert data is there
    assert findings == []


# --- degrees ---


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
