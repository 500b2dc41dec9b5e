"""Which effects a model may lack, and how a user adds another."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_rpto.effects import (
    LIBRARY,
    Drive,
    Effect,
    Parameter,
    Scales,
    Simulation,
    SimulationBatch,
    candidates,
    from_json,
    register,
)
from sb3_rpto.effects.names import near
from sb3_rpto.effects.validate_effect import try_out

XML = """
<mujoco>
  <option OPTION/>
  <worldbody>
    <geom name="floor" type="plane" pos="0 0 -2" size="1 1 1" contype="0" conaffinity="1"/>
    <body name="post"><geom name="post" type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/></body>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="box" type="box" size="0.1 0.1 0.1"/>
      <body name="pole">
        <joint axis="0 1 0"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 0.5" size="0.03" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="slide" coef="1"/></fixed></tendon>
  <actuator><motor name="motor" joint="slide"/>MORE</actuator>
</mujoco>"""


def model(option: str = "", more: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.replace("OPTION", option).replace("MORE", more))


def offered(model: mujoco.MjModel, *exclude: str) -> set[str]:
    found = [e.label for e in candidates(model, exclude)]
    assert len(found) == len(set(found))
    return set(found)


def test_all_at_all_places() -> None:
    got = offered(model())
    joints = ("slide", "joint1")  # nameless ones have a name too
    for kind in ("coulomb_friction", "stribeck_friction", "viscous_friction", "quadratic_drag", "asymmetric_damping"):
        assert {f"{kind}({joint})" for joint in joints} <= got
    for kind in ("torque_offset", "spring", "armature", "sensor_bias", "sensor_gain"):
        assert {f"{kind}({joint})" for joint in joints} <= got
    for kind in ("torque_ripple", "position_friction"):
        assert {label for label in got if label.startswith(kind)} == {f"{kind}(joint1)"}
    for kind in ("load_friction", "directional_load_friction"):
        assert {label for label in got if label.startswith(kind)} == {f"{kind}(slide)"}
    for kind in ("command_delay", "command_gain", "actuator_lag", "backlash", "dc_motor"):
        assert f"{kind}(motor)" in got
    assert {label for label in got if label.startswith("payload")} == {"payload(cart)", "payload(pole)"}
    assert {label for label in got if label.startswith("link_length")} == {"link_length(pole)"}
    assert not [label for label in got if label.startswith("soft_friction")], "it is no machine's"
    named = candidates(model(), ["slide.frictionloss"], ["soft_friction", "command_delay"])
    assert {e.label for e in named} == {"soft_friction(joint1)", "command_delay(motor)"}
    assert {label for label in got if label.startswith("geom_friction")} == {
        "geom_friction(floor)",
        "geom_friction(box)",
        "geom_friction(rod)",
    }
    assert {"gravity_tilt", "fluid"} <= got
    assert "wind" not in got
    assert all(e.values.tolist() == [p.null for p in e.parameters] for e in candidates(model()))


def test_all_can_be_simulated_together() -> None:
    compiled = model('density="1"')
    sim = Simulation(compiled, candidates(compiled), 1)
    drive = Drive(np.random.default_rng(0).normal(size=(3, 20, 1)))
    start = np.zeros((3, 2)), np.ones((3, 2))
    plain = Simulation(compiled, [], 1).rollout(np.empty((3, 0)), *start, drive)
    np.testing.assert_array_equal(sim.rollout(np.tile(sim.null, (3, 1)), *start, drive)[0], plain[0])


def test_a_task_with_bodies_in_a_simplified_form_can_have_all_of_them_at_size() -> None:
    """MuJoCo refuses to recompute a body that it knows to have its centre of mass at its origin when that moves."""
    compiled = gym.make("Reacher-v5").unwrapped.model
    effects = candidates(compiled)
    assert {e.on for e in effects if e.kind == "payload"} == {"body0", "body1", "fingertip", "target"}
    sim = Simulation(compiled, effects, 1)
    sizes = np.concatenate([[p.size_for(Scales()) for p in e.parameters] for e in effects])
    bounds = np.array([(p.lower, p.upper) for e in effects for p in e.parameters]).T
    drive = Drive(np.random.default_rng(0).uniform(-1, 1, (2, 20, 2)))
    start = np.tile(compiled.qpos0 + 0.1, (2, 1)), np.ones((2, compiled.nv))
    plain = sim.rollout(np.tile(sim.null, (2, 1)), *start, drive)[0]
    for s in sim.slices:
        values = np.tile(sim.null, (2, 1))
        values[0, s] = np.clip(sim.null + sizes, *bounds)[s]
        q = sim.rollout(values, *start, drive)[0]
        assert np.isfinite(q).all()
        np.testing.assert_array_equal(q[1], plain[1])
    together = sim.rollout(np.tile(np.clip(sim.null + 0.1 * sizes, *bounds), (2, 1)), *start, drive)[0]
    assert np.isfinite(together).all()
    assert not np.allclose(together, plain)


def test_a_payload_at_a_body_whose_centre_is_its_origin_only_weighs() -> None:
    ball = """<mujoco><worldbody><body name="b"><joint axis="0 1 0" pos="0 0 1"/><geom size=".1" mass="1"/></body>
    </worldbody></mujoco>"""
    compiled = mujoco.MjModel.from_xml_string(ball)
    sim = Simulation(compiled, [LIBRARY["payload"]("b")], 1)
    got = sim.rollout(np.array([[0.5, 3.0]]), np.array([[0.4]]), np.zeros((1, 1)), Drive(np.zeros((1, 50, 0))))
    compiled.body_mass[1] = 1.5  # and its inertia stays
    mujoco.mj_setConst(compiled, mujoco.MjData(compiled))
    expected = Simulation(compiled, [], 1).rollout(
        np.empty((1, 0)), np.array([[0.4]]), np.zeros((1, 1)), Drive(np.zeros((1, 50, 0)))
    )
    np.testing.assert_allclose(got[0], expected[0], rtol=1e-12)


def test_without_contacts_gravity_or_memoryless_motors() -> None:
    assert not any(
        label.startswith("geom_friction") for label in offered(model('><flag contact="disable"/></option><size'))
    )
    assert "gravity_tilt" not in offered(model('gravity="0 0 0"'))
    assert "gravity_tilt" not in offered(model('><flag gravity="disable"/></option><size'))
    assert "wind" in offered(model('density="1"'))
    more = '<motor name="pull" tendon="t"/><general name="slow" joint="slide" dyntype="filter" dynprm="0.1"/>'
    got = offered(model(more=more))
    assert {"command_delay(pull)", "command_delay(slow)", "dc_motor(motor)"} <= got
    assert not {"dc_motor(pull)", "dc_motor(slow)"} & got


@pytest.mark.parametrize(
    ("declared", "gone"),
    [
        ("slide.damping", {"viscous_friction(slide)"}),
        ("joint:slide.damping", {"viscous_friction(slide)"}),
        ("*.armature", {"armature(slide)", "armature(joint1)"}),
        ("slide.frictionloss=0:9", {"coulomb_friction(slide)"}),
        ("slide.stiffness", {"spring(slide)"}),
        ("pole.length", {"link_length(pole)"}),
        ("pole.mass", set()),
        ("box.friction", {"geom_friction(box)"}),
        ("motor.gear", {"command_gain(motor)"}),
        ("motor.strength", {"command_gain(motor)"}),
        ("motor.damping", set()),
        ("option.viscosity", {"fluid"}),
        ("option.gravity", set()),
    ],
)
def test_what_is_declared_is_left_out(declared: str, gone: set[str]) -> None:
    assert offered(model()) - offered(model(), declared) == gone


@pytest.mark.parametrize(
    ("declared", "gone"),
    [
        ("servo.kp", {"servo_gain(servo)"}),
        ("servo.kv", {"servo_damping(servo)"}),
        ("servo.strength", {"servo_gain(servo)", "command_gain(servo)"}),  # beside it one of the two gains is free
        ("drive.kv", {"velocity_servo_gain(drive)"}),
        ("floor.timeconst", {"contact_softness(floor)"}),
        ("floor.dampratio", {"contact_softness(floor)"}),
    ],
)
def test_gains_of_a_servo_and_contacts_that_are_declared_are_left_out(declared: str, gone: set[str]) -> None:
    compiled = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body><joint name="hinge"/><geom size=".1"/></body></worldbody>
    <actuator><position name="servo" joint="hinge" kp="9" kv="1"/>
    <velocity name="drive" joint="hinge" kv="2"/></actuator></mujoco>""")
    every = {e.label for e in candidates(compiled, kinds=LIBRARY)}
    assert every - {e.label for e in candidates(compiled, [declared], LIBRARY)} == gone


def test_unknown_exclusions_are_said() -> None:
    with pytest.raises(ValueError, match="did you mean 'slide'"):
        candidates(model(), ["slid.damping"])


@pytest.fixture
def cubic() -> Iterator[type[Effect]]:
    """An effect of a user, in ten lines."""

    @register
    class CubicDrag(Effect):
        kind = "cubic_drag"
        place = "joint"
        parameters = (Parameter("c", "N·m·s³/rad³", lambda s: 0.03 * s.torque / s.velocity**3, lower=0.0),)
        equation = "-c qd^3"

        def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
            batch.force[:, self.dof] -= x[:, 0] * batch.qvel[:, self.dof] ** 3

    yield CubicDrag
    del LIBRARY["cubic_drag"]


def test_a_users_effect_is_offered_and_acts(cubic: type[Effect]) -> None:
    compiled = model('gravity="0 0 0"')
    assert {"cubic_drag(slide)", "cubic_drag(joint1)"} <= offered(compiled)
    sim = Simulation(compiled, [cubic("slide")], 1)
    qvel = np.tile([2.0, 0.0], (2, 1))
    v = sim.rollout(np.array([[0.0], [0.5]]), np.zeros((2, 2)), qvel, Drive(np.zeros((2, 1, 1))))[1][:, 1, 0]
    data = mujoco.MjData(compiled)
    data.qvel[:], data.qfrc_applied[0] = qvel[0], -0.5 * 2.0**3
    mujoco.mj_step(compiled, data)
    assert v.tolist() == pytest.approx([2.0, data.qvel[0]])
    assert from_json(cubic("slide", c=0.5).to_json()).values == [0.5]


@pytest.mark.parametrize(
    ("attribute", "wrong", "message"),
    [
        ("kind", "", "kind is ''; give a name"),
        ("place", "link", "place is 'link'; choose one of joint, actuator, body"),
        ("parameters", (), r"parameters is \(\); give a tuple of Parameter"),
        ("parameters", ("a",), "give a tuple of Parameter"),
        ("act", Effect.act, "Ticking does nothing; override one of write, act"),
        ("observe", lambda self, q, v, x: (q + x[..., 0], v), "observe and its inverse, unobserve, go together"),
        ("parameters", (Parameter("c", "", 0.1), Parameter("c", "", 0.1)), "have the names c, c; give each its own"),
        ("parameters", (Parameter("c", "", 0),), "size of c is 0; give a plausible small one"),
    ],
)
def test_a_class_that_would_fail_in_the_middle_of_a_trace_is_refused(
    cubic: type[Effect], attribute: str, wrong: object, message: str
) -> None:
    right = {**{name: vars(cubic)[name] for name in ("place", "parameters", "equation", "act")}, "kind": "ticking"}
    with pytest.raises(ValueError, match=message):
        register(type("Ticking", (Effect,), {**right, attribute: wrong}))
    assert "ticking" not in LIBRARY


@pytest.mark.parametrize("hook", ["act", "command", "observe", "late"])
def test_a_hook_that_fails_is_named_before_a_search(hook: str) -> None:
    def wrong(self, *arguments):
        raise IndexError("too many indices")

    place = {"act": "joint", "command": "actuator"}.get(hook, "sensor")
    strength = (Parameter("strength", "N·m", 0.1),)
    own = type("Wrong", (Effect,), dict(kind="wrong", place=place, parameters=strength, equation="", **{hook: wrong}))
    compiled = model()
    with pytest.raises(ValueError, match=rf"wrong\(\w+\): {hook} of Wrong fails on 3 .*IndexError: too many indices"):
        try_out(compiled, own(own.places(compiled)[0]))


def nothing_over_nothing(self: Effect, *arguments: Any) -> Any:
    """Any hook whose equation divides by a speed or a command, at rest."""
    if self.place == "joint":  # act(world, x)
        batch, x = arguments
        batch.force[:, self.dof] -= x[:, 0] * batch.qvel[:, self.dof] / np.abs(batch.qvel[:, self.dof])
        return None
    u = arguments[0]
    with np.errstate(invalid="ignore"):
        return u / u if self.place == "actuator" else (u / u, arguments[1])


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("hook", ["act", "command", "observe"])
def test_a_hook_that_makes_no_numbers_is_named_before_a_search(hook: str) -> None:
    place = {"act": "joint", "command": "actuator"}.get(hook, "sensor")
    own = {"kind": "no_number", "place": place, "parameters": (Parameter("strength", "N·m", 0.1),), "equation": ""}
    wrong = type("Wrong", (Effect,), {**own, hook: nothing_over_nothing})
    compiled = model()
    with pytest.raises(ValueError, match=rf"no_number\(\w+\): what {hook} of Wrong makes .* is not finite.*at rest"):
        try_out(compiled, wrong(wrong.places(compiled)[0]))


def first_row_alone(self: Effect, batch: Any, x: np.ndarray) -> None:
    batch.force[:, self.dof] -= x[0, 0] * batch.qvel[:, self.dof]


@pytest.mark.parametrize(
    ("hooks", "message"),
    [
        ({"act": first_row_alone}, r"act of Wrong makes something else of a simulation beside others than alone"),
        (
            {"observe": lambda self, q, v, x: (q + x[..., 0] * v + x[..., 0], v), "unobserve": Effect.unobserve},
            r"unobserve of Wrong does not take back what its observe does",
        ),
        (
            {
                "observe": lambda self, q, v, x: (q + x[..., 0] * v, v),
                "unobserve": lambda self, q, v, x: (q + x[..., 0] * v, v),
            },
            r"unobserve of Wrong does not take back what its observe does",
        ),
    ],
)
def test_simulations_that_are_mixed_and_inverses_that_are_none_are_named(hooks: dict[str, Any], message: str) -> None:
    place = "joint" if "act" in hooks else "sensor"
    own = {"kind": "wrong", "place": place, "parameters": (Parameter("strength", "N·m", 0.1),), "equation": ""}
    wrong, compiled = type("Wrong", (Effect,), {**own, **hooks}), model()
    with pytest.raises(ValueError, match=message):
        try_out(compiled, wrong(wrong.places(compiled)[0]))


def test_effects_of_the_library_pass() -> None:
    compiled = model()
    for effect in candidates(compiled):
        try_out(compiled, effect)


def test_registering_is_checked(cubic: type[Effect]) -> None:
    with pytest.raises(ValueError, match="Half needs a class attribute 'parameters'"):

        @register
        class Half(Effect):
            kind = "half"
            place = "joint"

    with pytest.raises(ValueError, match="there is an effect 'cubic_drag' already"):

        @register
        class Other(Effect):
            kind = "cubic_drag"
            place = "joint"
            parameters = ()
            equation = ""

    with pytest.raises(ValueError, match=r"there is an effect 'coulomb_friction' already \(sb3_rpto\."):

        @register
        class CoulombFriction(LIBRARY["coulomb_friction"]):
            """Of the same name, in another module."""

    assert LIBRARY["cubic_drag"] is cubic
    with pytest.raises(ValueError, match="no effect 'cubic_drg' is registered; did you mean 'cubic_drag'"):
        from_json({"kind": "cubic_drg", "on": "", "values": {}})
    kinds = ("coulomb_friction", "viscous_friction", "command_delay")
    assert near("friction", kinds) == "did you mean 'coulomb_friction' or 'viscous_friction'?"
