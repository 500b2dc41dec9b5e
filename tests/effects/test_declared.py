"""Declared parameters: their names, bounds, and what is said when they are wrong."""

import pickle

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_rpto.effects import Declared, Scales, declare, parameter_names
from sb3_rpto.effects.batch import LiveSimulation, MujocoBatch, SimulationBatch
from sb3_rpto.effects.corrected_model_io import correct
from sb3_rpto.effects.library import candidates

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option density="1.2"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.2"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03"/>
      <body name="shared" pos="0 0 -0.5">
        <joint name="shared" axis="0 1 0" armature="0.01"/>
        <geom type="sphere" size="0.05"/>
      </body>
    </body>
    <body name="ball"><joint name="loose" type="free"/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" gear="3"/>
    <position name="servo" joint="shared" kp="5"/>
    <velocity name="speed" joint="hinge" kv="3"/>
    <general name="slow" joint="hinge" dyntype="filter" dynprm="0.03"/>
  </actuator>
</mujoco>""")


def labels(names: list[str]) -> list[str]:
    return [d.label for d in declare(MODEL, names)]


def test_nominal_values_and_units() -> None:
    found = declare(
        MODEL, ["hinge.damping", "motor.gear", "servo.kp", "arm.length", "option.gravity", "option.density"]
    )
    assert [d.values[0] for d in found] == pytest.approx([0.2, 3.0, 5.0, 0.5, 9.81, 1.2])
    assert [d.parameters[0].unit for d in found] == ["N·m·s/rad", "", "N·m/rad", "m", "m/s²", "kg/m³"]
    assert repr(found[0]) == "hinge.damping = 0.2 N·m·s/rad"


def test_a_servos_gains_are_those_of_servos() -> None:
    kp, kv, speed = declare(MODEL, ["servo.kp", "servo.kv", "speed.kv"])
    assert [float(d.values[0]) for d in (kp, kv, speed)] == [5.0, 0.0, 3.0]
    for name, said in (
        ("speed.kp", "no position servo; declare its kv or strength"),
        ("motor.kv", "no position or velocity"),
        ("motor.timeconst", "has no filter"),
    ):
        with pytest.raises(ValueError, match=f"{name}: the actuator (is )?{said}"):
            declare(MODEL, [name])
        assert name not in parameter_names(MODEL)


@pytest.mark.parametrize("actuator", ["muscle", 'dcmotor motorconst="0.05 0.05" resistance="1"'])
def test_of_a_force_that_is_not_linear_there_is_no_factor(actuator: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="h" range="-1 1" limited="true"/><geom size=".1" mass="1"/></body>'
        f'</worldbody><actuator><{actuator} name="m" joint="h"/></actuator></mujoco>'
    )
    for name in ("m.strength", "m.gain"):
        assert name not in parameter_names(model)
        with pytest.raises(ValueError, match=f"{name}: the actuator's force is not linear .* declare its gear"):
            declare(model, [name])
    assert "m.gear" in parameter_names(model)


def test_a_regulators_strength_is_a_factor_on_its_force() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="h"/><geom size=".1" mass="1"/></body></worldbody>'
        '<actuator><pid name="m" joint="h" kp="10"/></actuator></mujoco>'
    )
    forces = []
    for strength in (1.0, 2.0):
        data, (declared,) = mujoco.MjData(model), declare(model, ["m.strength"])
        corrected = correct(model, [declared.with_values(np.array([strength]))])
        data.ctrl[0] = 0.5
        mujoco.mj_forward(corrected, data)
        forces.append(data.actuator_force[0])
    assert forces == [5.0, 10.0]
    with pytest.raises(ValueError, match=r"m\.gain: .* no factor on its command; declare its strength"):
        declare(model, ["m.gain"])


def test_default_bounds() -> None:
    (damping,), (mass,), (length,) = (declare(MODEL, [n]) for n in ("hinge.damping", "arm.mass", "arm.length"))
    assert (damping.parameters[0].lower, damping.parameters[0].upper) == (0.0, np.inf)
    nominal = MODEL.body("arm").mass[0]
    assert (mass.parameters[0].lower, mass.parameters[0].upper) == pytest.approx((nominal / 10, nominal * 10))
    assert (length.parameters[0].lower, length.parameters[0].upper) == (0.25, 1.0)
    assert damping.with_values(np.array([-3.0])).values == [0.0]


def test_what_holds_a_joint_still_has_a_ceiling_in_a_trace() -> None:
    scales = Scales(torque=3.0, velocity=2.0, inertia=0.1, span=0.5)
    names = ("hinge.damping", "hinge.frictionloss", "hinge.stiffness", "hinge.armature", "hinge.damping=0:0.7")
    found = [one.ceiling(scales) for name in names for one in declare(MODEL, [name])]
    nominal = [one.nominal for name in names[:3] for one in declare(MODEL, [name])]
    # at the typical speed (moving at all, at the end of the range) five times the typical torque and the model's own
    held = np.array([5 * 3.0 / 2.0, 5 * 3.0, 5 * 3.0 / 0.5]) + nominal
    np.testing.assert_allclose(found[:3], np.maximum(held, 11 * np.array(nominal)))
    assert found[3:] == [np.inf, 0.7]
    (strong,) = declare(MODEL, ["hinge.damping"])
    assert strong.ceiling(Scales(torque=1e-6)) == pytest.approx(11 * strong.nominal)
    (told,) = declare(MODEL, ["hinge.damping=0:40"])
    assert told.ceiling(scales) == told.ceiling(Scales(torque=1e-6)) == 40


@pytest.mark.parametrize(
    ("name", "least"),
    [("arm.mass=-1:3", "above 0"), ("arm.mass=0:30", "above 0"), ("hinge.damping=-1:2", "at least 0")],
)
def test_bounds_that_no_machine_has_are_refused(name: str, least: str) -> None:
    with pytest.raises(ValueError, match=f"the lower bound .* must be {least}"):
        declare(MODEL, [name])


def test_names_may_have_brackets() -> None:
    xml = """<mujoco><worldbody><body name="leg[0]"><joint name="hip[0]" damping="0.1"/><geom size="0.1"/></body>
    <body name="leg[1]"><joint name="hip[1]" damping="0.2"/><geom size="0.1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    assert [d.label for d in declare(model, ["hip[0].damping", "leg[1].mass"])] == ["hip[0].damping", "leg[1].mass"]
    assert [d.label for d in declare(model, ["hip*.damping"])] == ["hip[0].damping", "hip[1].damping"]


def test_given_bounds() -> None:
    (damping,) = declare(MODEL, ["hinge.damping=0.1:0.9"])
    assert (damping.parameters[0].lower, damping.parameters[0].upper) == (0.1, 0.9)
    for wrong, said in (
        ("hinge.damping=0.1", "write bounds as <name>=<lower>:<upper>"),
        ("hinge.damping=a:b", "write bounds as <name>=<lower>:<upper>"),
        ("hinge.damping=0.3:0.9", r"\[0.3, 0.9\] do not hold the nominal value 0.2"),
        ("hinge.damping=0.9:0.1", r"\[0.9, 0.1\] are the wrong way round; give low:high"),
    ):
        with pytest.raises(ValueError, match=said):
            declare(MODEL, [wrong])


def test_a_wildcard_leaves_out_a_motors_damping_that_is_null() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="pole"><joint name="hinge" damping="0.1"/><geom size=".1" pos="0 0 -1"/></body>
        </worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    )
    assert [d.label for d in declare(model, ["*.damping"])] == ["hinge.damping"]
    assert [d.label for d in declare(model, ["motor.damping"])] == ["motor.damping"]


def test_wildcards() -> None:
    assert labels(["*.frictionloss"]) == ["hinge.frictionloss", "shared.frictionloss"]
    assert labels(["hinge.*"]) == ["hinge.damping", "hinge.frictionloss", "hinge.armature", "hinge.stiffness"]
    assert labels(["*.length"]) == ["arm.length"], "no capsule, no length"
    assert labels(["hinge.d*", "hinge.damping"]) == ["hinge.damping"], "none twice"
    with pytest.raises(ValueError, match=r"'\*.wobble' matches nothing"):
        declare(MODEL, ["*.wobble"])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("hinge", "write <object>.<parameter>"),
        ("hing.damping", "did you mean 'hinge'"),
        ("hinge.dampin", "did you mean 'damping'"),
        ("option.gravty", "did you mean 'gravity'"),
        ("body:hinge.mass", "the model has no body 'hinge'"),
        ("loose.damping", "neither a hinge nor a slide"),
        ("shared.length", "is 0 in the model, so it cannot be scaled"),
    ],
)
def test_wrong_names_are_answered(name: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        declare(MODEL, [name])


def test_a_string_is_no_list() -> None:
    with pytest.raises(TypeError, match=r"write \['hinge.damping'\]"):
        declare(MODEL, "hinge.damping")
    for bounds in ({"hinge.damping": (0.1, 0.5)}, [("hinge.damping", 0.1, 0.5)]):
        with pytest.raises(TypeError, match=r"must be a list of names.*bounds are part of one: 'arm.mass=0.2:0.9'"):
            declare(MODEL, bounds)  # type: ignore[arg-type]


def test_one_number_is_declared_once_by_whatever_name() -> None:
    (found,) = declare(MODEL, ["hinge.damping", "joint:hinge.damping=0.001:2"])
    assert (found.parameters[0].lower, found.parameters[0].upper) == (0.001, 2.0)


def test_prefixes_tell_objects_of_one_name_apart() -> None:
    mass, armature = declare(MODEL, ["body:shared.mass", "joint:shared.armature"])
    assert mass.values == [MODEL.body("shared").mass]
    assert armature.values == [0.01]
    assert labels(["shared.mass"]) == ["shared.mass"], "only a body has a mass"
    # A joint and an actuator both have a damping.
    twins = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
    <actuator><motor name="j" joint="j"/></actuator></mujoco>""")
    with pytest.raises(ValueError, match=r"may be of joint or actuator; write 'joint:j.damping'"):
        declare(twins, ["j.damping"])
    assert {"joint:j.damping", "actuator:j.damping", "j.armature"} <= set(parameter_names(twins))


def test_every_name_can_be_declared() -> None:
    for name in parameter_names(MODEL):
        try:
            declared = Declared(MODEL, name)
        except ValueError as error:
            assert "cannot be scaled" in str(error)  # noqa: PT017 (the others must not raise)
        else:
            assert declared.label == name


def written(batch: SimulationBatch, name: str, value: float) -> SimulationBatch:
    batch.restore()
    Declared(MODEL, name, (0.0, np.inf)).write(batch, np.array([[value]]))
    batch.settle()
    return batch


@pytest.mark.parametrize(
    ("name", "value", "field", "where", "expected"),
    [
        ("hinge.damping", 0.7, "dof_damping", 0, 0.7),
        ("hinge.frictionloss", 0.4, "dof_frictionloss", 0, 0.4),
        ("hinge.stiffness", 2.0, "jnt_stiffness", 0, 2.0),
        ("motor.gear", 4.0, "actuator_gear", (0, 0), 4.0),
        ("motor.strength", 0.5, "actuator_gainprm", (0, 0), 0.5),
        ("servo.kp", 7.0, "actuator_biasprm", (1, 1), -7.0),
        ("servo.kv", 0.5, "actuator_gainprm", (1, 0), 5.0),
        ("servo.kv", 0.5, "actuator_biasprm", (1, 2), -0.5),
        ("speed.kv", 2.0, "actuator_gainprm", (2, 0), 2.0),
        ("speed.kv", 2.0, "actuator_biasprm", (2, 2), -2.0),
        ("speed.kv", 2.0, "actuator_biasprm", (2, 1), 0.0),
        ("slow.timeconst", 0.08, "actuator_dynprm", (3, 0), 0.08),
        ("rod.friction", 0.3, "geom_friction", (0, 0), 0.3),
        ("rod.timeconst", 0.05, "geom_solref", (0, 0), 0.05),
        ("rod.dampratio", 0.5, "geom_solref", (0, 1), 0.5),
        ("option.gravity", 4.905, "opt.gravity", 2, -4.905),
        ("option.density", 3.0, "opt.density", (), 3.0),
        ("option.viscosity", 0.2, "opt.viscosity", (), 0.2),
    ],
)
def test_writing(name: str, value: float, field: str, where: tuple[int, ...], expected: float) -> None:
    for batch in (MujocoBatch(MODEL, 1, 1), LiveSimulation(MODEL.__copy__(), mujoco.MjData(MODEL))):
        at = (0, *where) if isinstance(where, tuple) else (0, where)
        before = float(batch.field(field)[at])
        assert written(batch, name, value).field(field)[at] == pytest.approx(expected)
        batch.restore()
        assert batch.field(field)[at] == before


def test_plain_numbers_reach_the_model() -> None:
    model = MODEL.__copy__()
    batch = LiveSimulation(model, mujoco.MjData(model))
    written(batch, "option.density", 40.0)
    assert model.opt.density == 40.0
    batch.restore()
    assert model.opt.density == 1.2


def test_a_velocity_servo_stays_one_whose_gain_is_fitted() -> None:
    model = MODEL.__copy__()
    for batch in (MujocoBatch(MODEL, 1, 1), LiveSimulation(model, mujoco.MjData(model))):
        for name, value in (("speed.gain", 4.0), ("speed.kv", 2.0)):
            Declared(MODEL, name).write(batch, np.array([[value]]))
        assert batch.field("actuator_gainprm")[0, 2, 0] == 2.0


@given(st.floats(0.15, 9))
def test_mass_scales_inertia_and_inertia_leaves_mass(factor: float) -> None:
    body = MODEL.body("arm").id
    mass, inertia = MODEL.body_mass[body], MODEL.body_inertia[body]
    heavy = written(MujocoBatch(MODEL, 1, 1), "arm.mass", factor * mass)
    np.testing.assert_allclose(heavy.field("body_mass")[0, body], factor * mass)
    np.testing.assert_allclose(heavy.field("body_inertia")[0, body], factor * inertia)
    round_ = written(MujocoBatch(MODEL, 1, 1), "arm.inertia", factor * inertia[0])
    assert round_.engine.expand("body_mass")[0, body] == mass
    np.testing.assert_allclose(round_.field("body_inertia")[0, body], factor * inertia)


def test_the_range_of_a_joint_keeps_the_reference_pose_or_the_bound_next_to_it() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><compiler angle="radian"/><worldbody><body>
        <joint name="around" range="-1 0.5"/><joint name="away" range="0.4 1"/><joint name="moved" ref="2" range="1 3"/>
        <joint name="free"/><geom size="1"/></body></worldbody></mujoco>""")
    found = declare(model, ["*.range"])
    assert {d.label: d.values[0] for d in found} == pytest.approx(
        {"around.range": 1.5, "away.range": 0.6, "moved.range": 2}
    )
    batch = MujocoBatch(model, 2, 1)
    for parameter in found:
        parameter.write(batch, parameter.values * np.array([[0.5], [2.0]]))
    half, double = batch.field("jnt_range")
    np.testing.assert_allclose(half[:3], [(-0.5, 0.25), (0.4, 0.7), (1.5, 2.5)])
    np.testing.assert_allclose(double[:3], [(-2, 1), (0.4, 1.6), (0, 4)])
    with pytest.raises(ValueError, match=r"free\.range is 0 in the model"):
        Declared(model, "free.range")


@pytest.mark.parametrize("name", ["hinge.damping", "body:shared.mass", "option.gravity", "hinge.stiffness"])
def test_it_pickles(name: str) -> None:
    (known,) = declare(MODEL, [name])
    moved = known.with_values(known.values + 0.1)
    twin = pickle.loads(pickle.dumps(moved))
    assert repr(twin) == repr(moved)
    assert (twin.parameters[0].size_for(Scales()), twin.nominal) == (
        moved.parameters[0].size_for(Scales()),
        known.nominal,
    )
    batches = MujocoBatch(MODEL, 1, 1), MujocoBatch(MODEL, 1, 1)
    for effect, batch in zip((moved, twin), batches):
        effect.write(batch, effect.values[None])
    for field in ("dof_damping", "body_mass", "opt.gravity", "jnt_stiffness"):
        np.testing.assert_array_equal(batches[0].field(field), batches[1].field(field))


@pytest.mark.parametrize("names", [["motor.strength", "motor.gain"], ["motor.gain", "motor.strength"]])
def test_a_factor_comes_after_what_it_multiplies_in_any_order(names: list[str]) -> None:
    values = {"motor.strength": 2.0, "motor.gain": 1.5}
    model = correct(MODEL, [d.with_values(np.array([values[d.label]])) for d in declare(MODEL, names)])
    assert model.actuator_gainprm[0, 0] == 3.0


def test_gears_may_be_negative_or_along_another_axis() -> None:
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size=".1"/><site name="tail"/></body></worldbody>
    <actuator><motor name="motor" joint="hinge" gear="-2"/><general name="rotor" site="tail" gear="0 0 1 0 0 -.02"/>
    </actuator></mujoco>""")
    motor, rotor = declare(model, ["*.gear"])
    assert (motor.nominal, motor.parameters[0].lower, motor.parameters[0].upper) == (-2.0, -20.0, -0.2)
    corrected = correct(model, [motor.with_values(np.array([-3.0])), rotor.with_values(np.array([1.5]))])
    assert corrected.actuator_gear[0, 0] == -3.0
    np.testing.assert_allclose(corrected.actuator_gear[1], [0, 0, 1.5, 0, 0, -0.03])


@pytest.mark.parametrize("joint", ["a=b", "a=1:2", "=", "x.y=z", "[0]=*", "k=0.1:0.9"])
def test_names_of_objects_may_have_an_equals_sign(joint: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="arm"><joint name="{joint}" damping=".1"/><geom size=".1" mass="1"/></body>'
        "</worldbody></mujoco>"
    )
    for entry in (f"{joint}.damping", f"joint:{joint}.damping", "*.damping"):
        (one,) = declare(model, [entry])
        assert (one.owner, one.index) == ("joint", 0)
        (bounded,) = declare(model, [f"{entry}=0.05:0.5"])
        assert (bounded.parameters[0].lower, bounded.parameters[0].upper) == (0.05, 0.5)
        assert declare(model, [bounded.label])[0].number == one.number
    assert "viscous_friction" not in {e.kind for e in candidates(model, ["*.damping"])}
    with pytest.raises(ValueError, match="write bounds as <name>=<lower>:<upper>"):
        declare(model, [f"{joint}.damping=5"])
    with pytest.raises(ValueError, match="write bounds as"):
        declare(model, ["*.damping=0.1:x"])
    with pytest.raises(ValueError, match=r"did you mean '.*damping'"):
        declare(model, [f"{joint}.dampin"])
