"""Where effects may sit, and that they act there and nowhere else."""

import copy
import pickle
from collections.abc import Sequence

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_rpto.effects import LIBRARY, Drive, Effect, Simulation, candidates, declare, parameter_names
from sb3_rpto.effects.names import object_names
from sb3_rpto.effects.simulation import settled
from sb3_rpto.envs.corrected import apply_effects

ARM = """
<mujoco><option timestep="{dt}" gravity="0 0 0"/><worldbody>{bodies}</worldbody>
  <tendon><fixed name="t"><joint joint="{last}" coef="1"/></fixed></tendon>
  <actuator>{actuators}</actuator></mujoco>"""
LINK = """<body pos="0 {y} 0"><joint name="{name}" axis="0 1 0" {joint}/>
  <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1"/></body>"""


def arms(
    actuators: str, joints: Sequence[str] = "h", joint: str = "", dt: float = 0.002, option: str = ""
) -> mujoco.MjModel:
    """Links side by side on hinges in the plane, without gravity."""
    bodies = "".join(LINK.format(y=y, name=name, joint=joint) for y, name in enumerate(joints))
    xml = ARM.format(dt=dt, bodies=bodies, last=joints[-1], actuators=actuators)
    return mujoco.MjModel.from_xml_string(xml.replace("<option", f"<option {option}", 1))


def speed(model: mujoco.MjModel, effects: list[Effect], command: list[float], steps: int = 100) -> float:
    """Of the first joint after so many steps from rest."""
    simulation = Simulation(model, effects, 1)
    drive = Drive(np.tile(np.array(command), (1, steps, 1)))
    _, v = simulation.rollout(simulation.values()[None], model.qpos0[None], np.zeros((1, model.nv)), drive)
    return float(v[0, -1, 0])


ONE = '<motor name="m" joint="h"/>'


def test_load_friction_is_of_the_torque_that_a_weak_motor_gives() -> None:
    strong = arms('<motor name="m" joint="h" gear="10"/>')
    weak, friction = LIBRARY["dc_motor"]("m", inverse_stall=1.0), LIBRARY["load_friction"]("h", mu=0.2)
    right = speed(arms(ONE), [friction], [1.0])
    assert speed(strong, [weak, friction], [1.0]) == pytest.approx(right, rel=1e-9)
    assert speed(strong, [friction, weak], [1.0]) == pytest.approx(right, rel=1e-9)


@pytest.mark.parametrize("other", ['<motor tendon="t"/>', '<general joint="h" dyntype="filter" dynprm="0.01"/>'])
def test_where_the_simulator_tells_the_load_a_weak_motor_is_one_with_a_forcerange(other: str) -> None:
    text = '<motor name="m" joint="h" gear="10" {}/>' + other
    limited, strong = (arms(text.format(ends)) for ends in ('forcerange="-.1 .1"', ""))
    friction = LIBRARY["load_friction"]("h", mu=0.2)
    weak = LIBRARY["dc_motor"]("m", inverse_stall=1.0)
    assert speed(strong, [weak, friction], [1.0, 0.0], 20) == pytest.approx(
        speed(limited, [friction], [1.0, 0.0], 20), rel=1e-9
    )


def test_two_weak_motors_lose_their_torques_together_within_the_joints_range() -> None:
    model = arms(f'{ONE}<motor name="n" joint="h"/>', joint='actuatorfrcrange="-1.5 1.5"')
    weak = [LIBRARY["dc_motor"](name, inverse_stall=1 / 0.6) for name in "mn"]
    assert speed(model, weak, [1.0, 1.0]) == pytest.approx(speed(model, [], [0.6, 0.6]), rel=1e-9)


@pytest.mark.parametrize("other", ['<motor tendon="t"/>', '<general joint="h" dyntype="filter" dynprm="0.01"/>'])
def test_a_load_that_holds_holds_from_the_first_substep_on(other: str) -> None:
    friction = [LIBRARY["load_friction"]("h", mu=1.0)]
    held = speed(arms(ONE, joints="hg", dt=0.01), friction, [1.0], 20)
    assert speed(arms(ONE + other, joints="hg", dt=0.01), friction, [1.0, 0.0], 20) == pytest.approx(held, rel=1e-6)


def test_a_joint_on_a_tendon_has_load_friction_too() -> None:
    through = arms('<motor tendon="t"/>')
    assert LIBRARY["load_friction"].places(through) == ["h"]
    friction = [LIBRARY["load_friction"]("h", mu=0.2)]
    assert speed(through, friction, [1.0]) == pytest.approx(speed(arms(ONE), friction, [1.0]), rel=1e-9)


@pytest.mark.parametrize(
    ("actuators", "options", "commands"),
    [
        (f'{ONE}<motor joint="h" gear="100" group="1"/>', 'actuatorgroupdisable="1"', [1.0, 1.0]),
        ('<general name="m" joint="h" gainprm="1 1 1"/>', "", [1.0]),  # the terms of an affine gain, which it is not
    ],
)
def test_torque_is_what_mujoco_makes_of_a_command(actuators: str, options: str, commands: list[float]) -> None:
    friction = [LIBRARY["load_friction"]("h", mu=0.05)]
    found = speed(arms(actuators, option=options), friction, commands)
    assert found == pytest.approx(speed(arms(ONE), friction, [1.0]), rel=1e-9)


def test_commands_are_not_clamped_where_the_model_says_so() -> None:
    limited = '<motor name="m" joint="h" ctrlrange="-1 1" ctrllimited="true"/>'
    model = arms(limited, option="")
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    friction = [LIBRARY["load_friction"]("h", mu=0.05)]
    assert speed(model, friction, [3.0]) == pytest.approx(speed(arms(ONE), friction, [3.0]), rel=1e-9)
    weak = [LIBRARY["dc_motor"]("m", inverse_stall=1.0)]
    assert speed(model, weak, [3.0]) == pytest.approx(speed(arms(ONE), [], [1.0]), rel=1e-9)


def test_balanced_gravity_is_part_of_the_load() -> None:
    body = LINK.format(y=0, name="h", joint='actuatorgravcomp="true"').replace("<body", '<body gravcomp="1"')
    model = mujoco.MjModel.from_xml_string(ARM.format(dt=0.002, bodies=body, last="h", actuators=ONE))
    model.opt.gravity[2] = -9.81
    # Balanced by its motors the arm rests; dry friction of all that they give holds it against a small push.
    assert abs(speed(model, [LIBRARY["load_friction"]("h", mu=1.0)], [0.5])) < 0.05
    assert speed(model, [], [0.5]) > 1.0


TWO = '<pid name="o" joint="h" kp="10"/><motor name="m" joint="g"/>'


def test_a_command_is_the_actuators_own_where_another_takes_two() -> None:
    model = arms(TWO, joints="hg")
    assert (model.nu, model.nactuator) == (3, 2)
    dead = LIBRARY["command_deadband"]("m", width=10.0)

    def last(effects: list[Effect]) -> np.ndarray:
        simulation = Simulation(model, effects, 1)
        drive = Drive(np.tile([0.0, 1.0, 1.0], (1, 20, 1)))
        return simulation.rollout(simulation.values()[None], np.zeros((1, 2)), np.zeros((1, 2)), drive)[1][0, -1]

    plain, held = last([]), last([dead])
    assert plain[1] > 0.1
    assert held[1] == 0.0
    assert held[0] == plain[0]
    assert {e.on for e in candidates(model) if e.place == "actuator"} == {"m"}
    assert "m.gear" in parameter_names(model)
    with pytest.raises(ValueError, match="command_deadband cannot sit on actuator 'o': it can on m"):
        Simulation(model, [LIBRARY["command_deadband"]("o", width=0.1)], 1)


def test_a_commands_limits_are_its_own_where_another_actuator_takes_two() -> None:
    """Of three commands the last is the motor's, the second actuator."""
    limited = '<motor name="m" joint="g" ctrlrange="-.5 .5" ctrllimited="true"/>'
    weak = LIBRARY["dc_motor"]("m", inverse_stall=1.0)
    for before, command in (("", [3.0]), ('<pid name="o" joint="h" kp="10"/>', [0.0, 0.0, 3.0])):
        model = arms(before + limited, joints="gh")
        assert speed(model, [weak], command) == speed(model, [], command) > 0.01, "at half its stall nothing is lost"


def test_a_filter_settles_at_its_own_command_where_another_actuator_takes_two() -> None:
    model = arms(TWO + '<general joint="g" dyntype="filter" dynprm="0.1"/>', joints="hg")
    assert settled(model, np.array([[0.1, 0.2, 0.3, 0.4]])).tolist() == [[0.4]]


def test_nameless_objects_never_take_the_name_of_another() -> None:
    model = arms(ONE, joints=["joint1", "", "h"])  # an empty name is none
    assert object_names(model, "joint") == ["joint1", "joint1_", "h"]
    labels = [effect.label for effect in candidates(model)]
    assert len(set(labels)) == len(labels)
    assert [d.label for d in declare(model, ["joint*.damping"])] == ["joint1.damping", "joint1_.damping"]


def test_a_servo_in_the_parent_regulates_what_its_sensor_shows_too() -> None:
    bias = LIBRARY["sensor_bias"]("h", offset=0.2)
    reached = [
        speed(arms(f'<position {where}="h" kp="10"/>'), [bias], [0.3], 60) for where in ("joint", "jointinparent")
    ]
    assert reached[0] == reached[1] != speed(arms('<position joint="h" kp="10"/>'), [], [0.3], 60)


MUSCLE = """<mujoco><worldbody><body><freejoint name="root"/><geom size=".1"/>
  <body><joint name="h" stiffness="1 2 3"/><geom size=".1" pos=".2 0 0"/></body>
  <body><joint name="s" type="slide"/><geom size=".1" pos="-.2 0 0"/></body></body></worldbody>
  <actuator><muscle name="m" joint="h" lengthrange="0 1"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("kind", "on", "said"),
    [
        ("viscous_friction", "root", "joint 'root': it can on h, s"),
        ("sensor_bias", "root", "sensor 'root': it can on h, s"),
        ("spring", "h", "joint 'h': it can on s"),
        ("command_gain", "m", "actuator 'm': it can on none"),
        ("torque_ripple", "s", "joint 's': it can on h"),
        ("payload", "world", "body 'world': it can on"),
        ("com_offset", "world", "body 'world': it can on"),
    ],
)
def test_an_effect_where_it_makes_no_sense_is_refused(kind: str, on: str, said: str) -> None:
    model = mujoco.MjModel.from_xml_string(MUSCLE)
    with pytest.raises(ValueError, match=f"{kind} cannot sit on {said}"):
        Simulation(model, [LIBRARY[kind](on)], 1)


def test_the_centre_of_mass_of_a_body_that_mujoco_simplifies_is_refused() -> None:
    model = gym.make("Reacher-v5").unwrapped.model
    assert "target" not in {effect.on for effect in candidates(model, kinds={"com_offset"})}
    with pytest.raises(ValueError, match="com_offset cannot sit on body 'target': MuJoCo holds it in a form"):
        Simulation(model, [LIBRARY["com_offset"]("target", x=0.1)], 1)


def test_softness_is_offered_at_what_stands_still_and_has_a_time_constant() -> None:
    def model(solref: str, flag: str = "enable") -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(f"""<mujoco><option><flag contact="{flag}"/></option><worldbody>
        <geom name="floor" type="plane" size="1 1 1" solref="{solref}"/>
        <geom name="seen" size="1" contype="0" conaffinity="0"/>
        <body><joint type="slide"/><geom name="foot" size=".1"/></body></worldbody></mujoco>""")

    def offered(model: mujoco.MjModel) -> list[str]:
        return [effect.label for effect in candidates(model, kinds={"contact_softness"})]

    assert offered(model(".02 1")) == ["contact_softness(floor)"]
    assert offered(model(".02 1", "disable")) == offered(model("-900 -40")) == []
    with pytest.raises(ValueError, match="solref holds stiffness and damping; give it a time constant"):
        declare(model("-900 -40"), ["floor.timeconst"])


def test_delays_of_one_sensor_add_up() -> None:
    def shown(*layers: list[float]) -> np.ndarray:
        env = gym.make("InvertedPendulum-v5")
        for delays in layers:
            env = apply_effects(env, [LIBRARY["sensor_delay"]("slider", delay=d) for d in delays])
        env.reset(seed=0)
        return np.array([env.step(np.array([np.sin(k)], np.float32))[0][0] for k in range(8)])

    np.testing.assert_allclose(shown([0.04], [0.04]), shown([0.08]), atol=1e-12)
    assert np.abs(shown([0.04], [0.04]) - shown([0.04])).max() > 1e-3


def test_a_known_effect_acts_in_an_environment_and_pickles() -> None:
    dead = LIBRARY["command_deadband"]("slide", width=0.9)

    def moved(effects: list[Effect]) -> np.ndarray:
        env = apply_effects(gym.make("InvertedPendulum-v5"), effects)
        env.reset(seed=0)
        return np.array([env.step(np.array([0.8], np.float32))[0] for _ in range(4)])

    known = dead.as_known()
    assert np.abs(moved([dead]) - moved([])).max() > 1e-3
    np.testing.assert_array_equal(moved([known]), moved([dead]))
    for twin in (pickle.loads(pickle.dumps(known)), copy.deepcopy(known), copy.copy(known)):
        assert twin.known
        assert [p.null for p in twin.parameters] == [p.null for p in known.parameters] == [0.9]
        assert twin.parameters[0].size is known.parameters[0].size
        np.testing.assert_array_equal(twin.values, known.values)
    plain = pickle.loads(pickle.dumps(dead))
    assert "parameters" not in vars(plain)
    assert not plain.known
