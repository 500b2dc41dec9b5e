"""Whole turns between an encoder's zero and the model's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data.encoder_unwrapping import settle_turns
from sb3_rpto.sysid.findings import FindingKind

TURN = 2 * np.pi
ANGLE = 0.4 * np.sin(np.linspace(0, 6, 200)) - 0.1


def arm(joint: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/><worldbody><body>
        <joint name="hinge" axis="0 1 0" {joint}/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/>
        </body></worldbody></mujoco>""")


def recorded(angle: np.ndarray) -> Measurements:
    return Measurements.from_tables({"run": {"time": np.arange(len(angle)) * 0.01, "qpos.hinge": angle}})


@pytest.mark.parametrize("joint", ['range="-1.5 1.5"', 'stiffness="0.5"'], ids=["limits", "spring"])
@pytest.mark.parametrize("start", [0, 30], ids=["begins below zero", "begins above zero"])
def test_a_wrapped_angle_comes_to_where_the_model_has_it(joint: str, start: int) -> None:
    angle = ANGLE[start:]
    data, found = settle_turns(arm(joint), recorded(np.mod(angle, TURN)))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], angle, atol=1e-12)
    assert {f.kind for f in found} <= {FindingKind.WHOLE_TURNS}


def test_an_angle_outside_its_limits_is_shifted_though_it_never_wrapped() -> None:
    data, found = settle_turns(arm('range="-1.5 1.5"'), recorded(ANGLE + TURN))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], ANGLE, atol=1e-12)
    assert [f.kind for f in found] == [FindingKind.WHOLE_TURNS]


@pytest.mark.parametrize("joint", ["", 'stiffness="0.5"'], ids=["free", "wound-up spring"])
def test_turns_that_may_be_meant_stay(joint: str) -> None:
    data, found = settle_turns(arm(joint), recorded(ANGLE + 2 * TURN))
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], ANGLE + 2 * TURN)
    assert found == []


def test_what_no_turn_accounts_for_is_said_and_kept() -> None:
    _, found = settle_turns(arm('range="-1.5 1.5"'), recorded(ANGLE + 1.4))
    assert FindingKind.OUTSIDE_LIMITS in [f.kind for f in found]


def test_degrees_are_refused_where_the_joints_limits_tell_them() -> None:
    with pytest.raises(
        ValueError, match=r"run, qpos.hinge spans \d+.* limits are -1.5 and 1.5 rad; give rad, not degrees"
    ):
        settle_turns(arm('range="-1.5 1.5"'), recorded(np.degrees(ANGLE)))
    settle_turns(arm(""), recorded(np.degrees(ANGLE)))  # a wheel may well turn so far


@pytest.mark.parametrize(("factor", "units"), [(1000, "mm"), (100, "cm or mm")])
def test_a_slide_in_other_units_is_refused_where_its_limits_tell_them(factor: float, units: str) -> None:
    with pytest.raises(ValueError, match=rf"qpos.hinge spans \d+.* limits are -1.5 and 1.5 m; give m, not {units}$"):
        settle_turns(arm('type="slide" range="-1.5 1.5"'), recorded(factor * ANGLE))
    settle_turns(arm('type="slide"'), recorded(factor * ANGLE))  # it may be long
    _, found = settle_turns(arm('type="slide" range="-0.05 0.05"'), recorded(ANGLE))  # or the limits are wrong
    assert [f.kind for f in found] == [FindingKind.OUTSIDE_LIMITS]


def test_a_joint_without_a_name_has_whole_turns_too() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><compiler angle="radian"/><worldbody><body>
        <joint axis="0 1 0" range="-1.5 1.5"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/>
        </body></worldbody></mujoco>""")
    column = {"time": np.arange(len(ANGLE)) * 0.01, "qpos.joint0": ANGLE + TURN}
    data, found = settle_turns(model, Measurements.from_tables({"run": column}))
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
    data, found = settle_turns(servo(gear), commanded(encoder, gear * (angle + 0.05)))
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], angle, atol=1e-12)
    assert [f.kind for f in found] == [FindingKind.WHOLE_TURNS]


def test_a_servos_limits_are_its_own_where_another_actuator_takes_two_commands() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body>
        <joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/></body><body>
        <joint name="other" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03"/></body></worldbody>
        <actuator><pid name="two" joint="other" kp="1"/><position name="servo" joint="hinge" kp="6" ctrlrange="3 9"/>
        </actuator></mujoco>""")
    angle = np.full(200, 3.2)
    data, _ = settle_turns(model, commanded(angle - TURN, np.full(200, -50.0)))  # held at the lower end
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
    data, found = settle_turns(servo(), commanded(ANGLE, command, **columns))
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], ANGLE)
    assert found == []
