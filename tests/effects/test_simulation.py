"""Many simulations side by side are the same as MuJoCo one by one."""

from itertools import permutations, product

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_rpto.effects import LIBRARY, Drive, Effect, Simulation, declare
from sb3_rpto.effects.batch import MujocoBatch
from sb3_rpto.effects.simulation import alike, memory, names_of, settled

XML = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.1" frictionloss="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.02"/>
        <geom name="fist" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/>
      </body>
    </body>
    <geom name="wall" type="plane" pos="-0.2 0 0" zaxis="1 0 0" size="1 1 1"/>
  </worldbody>
  <actuator>ACTUATORS</actuator>
</mujoco>"""
MOTORS = '<motor name="m1" joint="shoulder" gear="6"/><position name="m2" joint="elbow" kp="8" kv="0.3"/>'
MODEL = mujoco.MjModel.from_xml_string(XML.replace("ACTUATORS", MOTORS))
FREE = mujoco.MjModel.from_xml_string(XML.replace("ACTUATORS", ""))


def start(n: int, steps: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    return rng.normal(size=(n, 2)), rng.normal(size=(n, 2)), rng.uniform(-1, 1, (n, steps, 2))


def loop(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, commands: np.ndarray, torque: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The plain way."""
    out = []
    for q, v, u in zip(qpos, qvel, commands):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q, v
        states = [(q, v)]
        for command in u:
            data.ctrl[:], data.qfrc_applied[1] = command[: model.nu], torque
            mujoco.mj_step(model, data)
            states.append((data.qpos.copy(), data.qvel.copy()))
        out.append(states)
    both = np.array(out)
    return both[:, :, 0], both[:, :, 1]


def equal(got: tuple[np.ndarray, np.ndarray], expected: tuple[np.ndarray, np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(got, expected))


def test_without_effects_it_is_mujoco_bit_for_bit() -> None:
    qpos, qvel, commands = start(5)
    sim = Simulation(MODEL, [], 2)
    got = sim.rollout(np.empty((5, 0)), qpos, qvel, Drive(commands))
    assert equal(got, loop(MODEL, qpos, qvel, commands))
    assert equal(got, sim.rollout(np.empty((5, 0)), qpos, qvel, Drive(commands))), "a second time"


def test_forces_are_mujocos_bit_for_bit() -> None:
    qpos, qvel, commands = start(3)
    sim = Simulation(MODEL, [LIBRARY["torque_offset"]("elbow", offset=0.3)], 1)
    stiff = sim.rollout(np.full((3, 1), 0.3), qpos, qvel, Drive(commands))
    # A joint with an effect in act has its dry friction made stiff; the other one has not.
    assert equal(stiff, loop(MODEL, qpos, qvel, commands, torque=0.3))


def test_declared_numbers_are_those_of_an_edited_model() -> None:
    qpos, qvel, commands = start(3)
    sim = Simulation(MODEL, declare(MODEL, ["elbow.damping", "m1.gear", "lower.mass"]), 1)
    values = sim.values()
    assert values[:2].tolist() == [0.02, 6.0]
    assert equal(sim.rollout(np.tile(values, (3, 1)), qpos, qvel, Drive(commands)), loop(MODEL, qpos, qvel, commands))
    other = MODEL.__copy__()
    body = other.body("lower").id
    other.dof_damping[1], other.actuator_gear[0, 0] = 0.3, 4.0
    other.body_mass[body] *= 2
    other.body_inertia[body] *= 2
    mujoco.mj_setConst(other, mujoco.MjData(other))
    got = sim.rollout(np.tile([0.3, 4.0, 2 * values[2]], (3, 1)), qpos, qvel, Drive(commands))
    for a, b in zip(got, loop(other, qpos, qvel, commands)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("known", "declared"),
    [
        *product(("m2.strength", "lower.inertia", "lower.mass"), ("m2.kp", "m2.kv", "m2.gain", "elbow.damping")),
        *product(("m2.strength", "lower.inertia"), ("lower.mass",)),
    ],
)
def test_a_setting_holds_whatever_else_is_declared(known: str, declared: str) -> None:
    qpos, qvel, commands = start(2)
    (number,) = declare(MODEL, [known])
    drive = Drive(commands, settings={known: number.nominal * np.array([0.5, 1.5])})
    alone = Simulation(MODEL, [], 1).rollout(np.empty((2, 0)), qpos, qvel, drive)
    sim = Simulation(MODEL, declare(MODEL, [declared]), 1)
    for got, expected in zip(sim.rollout(np.tile(sim.null, (2, 1)), qpos, qvel, drive), alone, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


def test_settings_differ_by_simulation() -> None:
    qpos, qvel, commands = start(2)
    damping = np.array([0.02, 0.5])
    got = Simulation(MODEL, [], 1).rollout(
        np.empty((2, 0)), qpos, qvel, Drive(commands, settings={"elbow.damping": damping})
    )
    for i, value in enumerate(damping):
        other = MODEL.__copy__()
        other.dof_damping[1] = value
        expected = loop(other, qpos[i : i + 1], qvel[i : i + 1], commands[i : i + 1])
        np.testing.assert_array_equal(got[0][i], expected[0][0])


def test_an_effect_at_rest_leaves_nothing_behind_to_copy_in_every_step() -> None:
    simulation = Simulation(MODEL, [LIBRARY["viscous_friction"]("shoulder"), LIBRARY["armature"]("elbow")], 1)
    qpos, qvel, commands = start(3, 5)
    expanded = []
    for viscous, armature in ((0.1, 0.0), (0.0, 0.01), (0.0, 0.0)):
        simulation.rollout(np.tile([viscous, armature], (3, 1)), qpos, qvel, Drive(commands))
        batch = list(simulation._batches.values())[-1].engine
        expanded.append([name for name in ("dof_damping", "dof_armature") if batch.expanded(name) is not None])
    assert expanded == [["dof_damping"], ["dof_armature"], []]


def test_what_is_written_once_for_many_simulations_is_what_is_written_for_each() -> None:
    """Rows of two kinds in an uneven order, and settings that part one of them."""
    lacks = [LIBRARY["coulomb_friction"]("elbow"), LIBRARY["gravity_scale"]()]
    sim = Simulation(MODEL, [*declare(MODEL, ["lower.length", "upper.mass", "m2.kp"]), *lacks], 1)
    kinds = sim.null + np.array([[0.05, 0.1, 1.0, 0.2, 0.1], [0.06, 0.1, 1.5, 0.3, 0.1]])
    values = kinds[[0, 0, 1, 1, 1, 0, 0, 1]]
    damping = np.array([0.02, 0.02, 0.02, 0.02, 0.02, 0.3, 0.3, 0.02])
    qpos, qvel, commands = start(8, 30)
    together = sim.rollout(values, qpos, qvel, Drive(commands, settings={"elbow.damping": damping}))
    for i in range(8):
        drive = Drive(commands[i : i + 1], settings={"elbow.damping": damping[i : i + 1]})
        alone = sim.rollout(values[i : i + 1], qpos[i : i + 1], qvel[i : i + 1], drive)
        for one, part in zip(alone, together, strict=True):
            np.testing.assert_allclose(one, part[i : i + 1], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("n", [4, 32])
def test_nothing_is_left_of_the_numbers_of_the_rollout_before(n: int) -> None:
    """Each simulation with another length, then all with the model's own."""
    effects = declare(MODEL, ["lower.length"])
    sim = Simulation(MODEL, effects, 1)
    qpos, qvel, commands = start(n, 60)
    sim.rollout(sim.null * np.linspace(0.7, 1.3, n)[:, None], qpos, qvel, Drive(commands))
    nominal = np.tile(sim.null, (n, 1))
    fresh = Simulation(MODEL, effects, 1).rollout(nominal, qpos, qvel, Drive(commands))
    assert equal(sim.rollout(nominal, qpos, qvel, Drive(commands)), fresh)


def test_effects_of_one_simulation_may_be_anothers_too() -> None:
    push = LIBRARY["torque_offset"]("elbow", offset=1.0)
    sim, (qpos, qvel, commands) = Simulation(MODEL, [push], 1), start(2, 20)
    before = sim.rollout(np.full((2, 1), 1.0), qpos, qvel, Drive(commands))
    alone = '<mujoco><worldbody><body><joint name="elbow"/><geom size="1"/></body></worldbody></mujoco>'
    Simulation(mujoco.MjModel.from_xml_string(alone), [push], 1)
    assert equal(sim.rollout(np.full((2, 1), 1.0), qpos, qvel, Drive(commands)), before)


@given(st.lists(st.integers(0, 3), min_size=1, max_size=12), st.lists(st.booleans(), min_size=12, max_size=12))
def test_simulations_are_alike_where_all_their_parameters_are(levels: list[int], offsets: list[bool]) -> None:
    n, effect = len(levels), LIBRARY["torque_offset"]("elbow")
    rows = list(zip(levels, offsets))
    active = [(effect, np.array(column, dtype=float)[:, None]) for column in zip(*rows)]
    first, kind = alike(active, n)
    assert [rows[i] for i in first[kind]] == rows
    assert len(first) == len(set(rows))
    assert all(rows.index(rows[i]) == i for i in first)
    assert [part.tolist() for part in alike([], n)] == [[0], [0] * n]


def test_actuators_that_are_off_do_nothing() -> None:
    qpos, qvel, commands = start(3, 80)
    sim = Simulation(MODEL, [], 1)
    off = Drive(commands, enabled=np.zeros(commands.shape))
    got = sim.rollout(np.empty((3, 0)), qpos, qvel, off)
    for a, b in zip(got, loop(FREE, qpos, qvel, commands)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    # Off until the middle, then on.
    enabled = np.ones(commands.shape)
    enabled[:, :40] = 0
    switched = sim.rollout(np.empty((3, 0)), qpos, qvel, Drive(commands, enabled=enabled))
    np.testing.assert_array_equal(switched[0][:, :41], got[0][:, :41])
    later = loop(MODEL, switched[0][:, 40], switched[1][:, 40], commands[:, 40:])
    np.testing.assert_allclose(switched[0][:, 40:], later[0], rtol=1e-4, atol=1e-5)  # another warm start
    # The next rollout has them on again.
    assert equal(sim.rollout(np.empty((3, 0)), qpos, qvel, Drive(commands)), loop(MODEL, qpos, qvel, commands))


def test_load_friction_ends_where_the_motor_is_off() -> None:
    qpos, qvel, commands = start(2, 30)
    sim = Simulation(
        MODEL, [LIBRARY["load_friction"]("elbow", mu=0.5), LIBRARY["dc_motor"]("m1", inverse_stall=1.0)], 1
    )
    drive = Drive(commands, enabled=np.zeros(commands.shape))
    values = np.tile(sim.values(), (2, 1))
    got = sim.rollout(values, qpos, qvel, drive)[0]
    plain = sim.rollout(np.tile(sim.null, (2, 1)), qpos, qvel, drive)[0]
    np.testing.assert_allclose(got, plain, rtol=1e-12)


def test_what_blows_up_is_nan_from_then_on_and_says_no_more(capfd: pytest.CaptureFixture[str]) -> None:
    qpos, qvel, commands = start(3)
    commands[1, 50:] = 1e9
    q, v = Simulation(MODEL, [], 1).rollout(np.empty((3, 0)), qpos, qvel, Drive(commands))
    assert capfd.readouterr() == ("", "")
    expected = loop(MODEL, qpos, qvel, commands)
    for i in (0, 2):
        np.testing.assert_array_equal(q[i], expected[0][i])
    bad = np.isnan(q[1]).any(axis=1)
    assert not bad[:51].any()
    assert bad[52:].all()
    np.testing.assert_array_equal(np.isnan(q[1]), np.isnan(v[1]))


def test_commands_before_the_start_fill_delays() -> None:
    qpos, qvel, commands = start(2)
    sim = Simulation(MODEL, [LIBRARY["command_delay"]("m1")], 1)
    delayed = commands.copy()
    delayed[:, 4:, 0] = commands[:, :-4, 0]
    got = sim.rollout(np.full((2, 1), 4 * 0.005), qpos, qvel, Drive(commands, before=10))
    np.testing.assert_allclose(got[0], loop(MODEL, qpos, qvel, delayed[:, 10:])[0], rtol=1e-9, atol=1e-12)
    assert got[0].shape == (2, 111, 2)


MUSCLES = "".join(
    f'<muscle name="{name}" joint="elbow" force="6" gear="{gear}" lengthrange="-2 2" timeconst="0.01 0.04"/>'
    for name, gear in (("flex", 1), ("extend", -1))
)


def test_muscles_remember_until_they_have_relaxed_and_hold_no_more_than_they_have() -> None:
    """Twice the time constant at most, as they relax from nothing on, or activate where they nearly are."""
    model = mujoco.MjModel.from_xml_string(XML.replace("ACTUATORS", MUSCLES))
    lead, steps = round(memory(model) / model.opt.timestep), 40
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-0.5, 1.5, (8, 20, 2)), 20, axis=1)
    _, nu = settled(model, commands[:, -1]).shape
    assert nu == 2
    data = mujoco.MjData(model)
    starts, truth = [], []
    for u in commands:
        mujoco.mj_resetData(model, data)
        for k, command in enumerate(u[: 200 + steps]):
            if k == 200:
                starts.append((data.qpos.copy(), data.qvel.copy()))
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
        truth.append(data.qpos.copy())
    qpos, qvel = (np.array(part) for part in zip(*starts))
    driven = Drive(commands[:, 200 - lead : 200 + steps], lead)
    reached, _ = Simulation(model, [], 1).rollout(np.zeros((8, 0)), qpos, qvel, driven)
    np.testing.assert_allclose(reached[:, -1], truth, atol=1e-5)
    data.ctrl[:] = -0.8, 3
    mujoco.mj_step(model, data, nstep=2000)
    np.testing.assert_allclose(settled(model, data.ctrl[None])[0], data.act, atol=1e-6)


@pytest.mark.parametrize("names", [("hinge", "hinge.001"), ("hinge.001", "hinge"), ("a.1", "a")])
def test_a_joint_may_be_called_as_another_with_a_number_behind(names: tuple) -> None:
    body = '<body><joint name="{}" axis="0 1 0"/><geom size=".1" pos="0 0 -.1"/></body>'
    ball = '<body><joint name="ball" type="ball"/><geom size=".1"/></body>'
    xml = f"<mujoco><worldbody>{ball}{''.join(map(body.format, names))}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    assert names_of(model, [*names[::-1], "ball.3"]).tolist() == [5, 4, 3]


def test_commands_pass_the_chain_in_its_order() -> None:
    """A saturation after a dead zone, whatever the order of the list."""
    qpos, qvel, commands = start(2)
    chain: list[Effect] = [
        LIBRARY["command_saturation"]("m1", inverse_limit=2.0),
        LIBRARY["command_deadband"]("m1", width=0.2),
    ]
    sent, u = commands.copy(), commands[..., 0]
    sent[..., 0] = np.clip(u - np.clip(u, -0.2, 0.2), -0.5, 0.5)
    for effects in (chain, chain[::-1]):
        sim = Simulation(MODEL, effects, 1)
        got = sim.rollout(np.tile(sim.values(), (2, 1)), qpos, qvel, Drive(commands))
        assert equal(got, loop(MODEL, qpos, qvel, sent))


def test_a_gain_comes_after_the_chain() -> None:
    qpos, qvel, commands = start(2)
    chain = [LIBRARY["command_gain"]("m1", change=0.5), LIBRARY["command_saturation"]("m1", inverse_limit=2.0)]
    sent = commands.copy()
    sent[..., 0] = 1.5 * np.clip(commands[..., 0], -0.5, 0.5)
    sim = Simulation(MODEL, chain, 1)
    got = sim.rollout(np.tile(sim.values(), (2, 1)), qpos, qvel, Drive(commands))
    for a, b in zip(got, loop(MODEL, qpos, qvel, sent)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_dry_friction_of_the_models_own_keeps_its_constraint() -> None:
    """What presses hardly changes hardly anything: no effect makes such a joint stiffer by merely being there."""
    qpos, qvel, commands = start(3)
    small = {
        "torque_offset": {"offset": 1e-9},
        "coulomb_friction": {"level": 1e-9},
        "stribeck_friction": {"extra": 1e-9, "level": 1e-9},
        "load_friction": {"mu": 1e-9},
    }
    expected = loop(MODEL, qpos, qvel, commands)
    for kind, values in small.items():
        sim = Simulation(MODEL, [LIBRARY[kind]("shoulder", **values)], 1)
        assert equal(sim.rollout(np.tile(sim.null, (3, 1)), qpos, qvel, Drive(commands)), expected)
        got = sim.rollout(np.tile(sim.values(), (3, 1)), qpos, qvel, Drive(commands))
        for a, b in zip(got, expected):
            assert 0 < np.abs(a - b).max() < 1e-6, kind


@pytest.mark.parametrize("kind", ["coulomb_friction", "stribeck_friction", "load_friction"])
def test_dry_friction_on_a_smooth_joint_is_the_stiff_one_from_nothing_on(kind: str) -> None:
    """The elbow has none of its own: as little as can be is as good as nothing, although its constraint is stiff."""
    qpos, qvel, commands = start(3)
    sim = Simulation(MODEL, [LIBRARY[kind]("elbow")], 1)
    values = np.tile(sim.null, (3, 1))
    plain = sim.rollout(values, qpos, qvel, Drive(commands))
    values[:, 0] = 1e-9
    for a, b in zip(sim.rollout(values, qpos, qvel, Drive(commands)), plain):
        assert 0 < np.abs(a - b).max() < 1e-6


@pytest.mark.parametrize("joint", [0, 1], ids=["shoulder", "elbow"])
def test_soft_friction_is_frictionloss_alone_bit_for_bit(joint: int) -> None:
    qpos, qvel, commands = start(3)
    model = MODEL.__copy__()
    model.dof_frictionloss[joint] += 0.25
    sim = Simulation(MODEL, [LIBRARY["soft_friction"](("shoulder", "elbow")[joint], level=0.25)], 1)
    assert equal(
        sim.rollout(np.tile(sim.values(), (3, 1)), qpos, qvel, Drive(commands)), loop(model, qpos, qvel, commands)
    )


def test_spring_adds_to_the_models_own() -> None:
    qpos, qvel, commands = start(2)
    model = MODEL.__copy__()
    model.jnt_stiffness[1], model.qpos_spring[1] = 2.0, 0.5
    sim = Simulation(model, [LIBRARY["spring"]("elbow")], 1)
    got = sim.rollout(np.array([[0.0, 9.0], [3.0, -0.5]]), qpos, qvel, Drive(commands))
    assert np.array_equal(got[0][0], loop(model, qpos[:1], qvel[:1], commands[:1])[0][0])
    both = model.__copy__()
    both.jnt_stiffness[1], both.qpos_spring[1] = 5.0, (2.0 * 0.5 + 3.0 * -0.5) / 5.0
    np.testing.assert_allclose(got[0][1], loop(both, qpos[1:], qvel[1:], commands[1:])[0][0], rtol=1e-9)


@pytest.mark.parametrize("kinds", list(permutations(["sensor_bias", "sensor_gain", "sensor_delay"])), ids=" ".join)
def test_what_several_sensor_effects_make_of_one_joint_is_undone_in_whatever_order_they_act(kinds: tuple) -> None:
    """A joint at a constant speed: 0.05 s ago it was at q - 0.05 v."""
    given = {"sensor_bias": 0.3, "sensor_gain": 0.2, "sensor_delay": 0.05}
    sim = Simulation(MODEL, [LIBRARY[kind]("elbow") for kind in kinds], 1)
    values = np.tile([given[kind] for kind in kinds], (4, 1))
    q, v, _ = start(4)
    shown, speed = q - [[0, 0.05]] * v, v.copy()
    for effect, x in sim.sensing(values):
        shown[:, 1], speed[:, 1] = effect.observe(shown[:, 1], speed[:, 1], x)
    sim.undo_sensors(values, shown, speed)
    np.testing.assert_allclose(shown, q, atol=1e-12)
    np.testing.assert_allclose(speed, v, atol=1e-12)


HELD = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
<joint name="elbow" axis="0 1 0" damping="0.3"/><geom size="0.02" fromto="0 0 0 0.3 0 0" type="capsule"/>
</body></worldbody>
<actuator>{}</actuator></mujoco>"""


@pytest.mark.parametrize("kinds", list(permutations(["sensor_bias", "sensor_gain"])), ids=" ".join)
def test_a_servo_regulates_what_its_encoder_shows(kinds: tuple) -> None:
    given = {"sensor_bias": 0.3, "sensor_gain": 0.2}
    model = mujoco.MjModel.from_xml_string(HELD.format('<position joint="elbow" kp="4" kv="0.2" gear="0.5"/>'))
    sim = Simulation(model, [LIBRARY[kind]("elbow") for kind in kinds], 1)
    values = np.array([[given[kind] for kind in kinds], [0.0, 0.0]])
    shown = sim.rollout(values, np.zeros((2, 1)), np.zeros((2, 1)), Drive(np.full((2, 5000, 1), 0.35)))[0][:, -1]
    assert shown[1] == pytest.approx(0.7)  # the joint itself, half a turn of which is one of the motor
    for effect, x in sim.sensing(values):
        shown = effect.observe(shown, shown, x)[0]
    np.testing.assert_allclose(shown, 0.7, rtol=1e-6)


@pytest.mark.parametrize(
    "actuator", ['<motor joint="elbow"/>', '<velocity joint="elbow" kv="3"/>', '<general joint="elbow" gainprm="3"/>']
)
def test_other_actuators_read_no_encoder(actuator: str) -> None:
    model = mujoco.MjModel.from_xml_string(HELD.format(actuator))
    sim = Simulation(model, [LIBRARY["sensor_bias"]("elbow"), LIBRARY["sensor_gain"]("elbow")], 1)
    qpos, drive = np.full((2, 1), 0.4), Drive(np.full((2, 50, 1), 0.1))
    wrong, right = sim.rollout(np.array([[0.3, 0.2], [0.0, 0.0]]), qpos, np.zeros((2, 1)), drive)[0]
    np.testing.assert_array_equal(wrong, right)


def test_a_place_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match="the model has no joint 'ellbow'; did you mean 'elbow'"):
        Simulation(MODEL, [LIBRARY["viscous_friction"]("ellbow")])


def test_constants_follow_from_the_fields_of_each_simulation_whatever_others_share_them() -> None:
    rng, n = np.random.default_rng(3), 9
    kinds = rng.integers(0, 4, n)
    mass, place = rng.uniform(0.5, 2.0, (4, MODEL.nbody)), rng.normal(size=(4, MODEL.nbody, 3))
    batch = MujocoBatch(MODEL, n, 1)
    for _ in range(2):  # what was derived before does not stay
        batch.restore()
        batch.field("body_mass")[:] *= mass[kinds]
        batch.field("body_pos")[:] += place[kinds]
        batch.settle()
        for i, kind in enumerate(kinds):
            model = MODEL.__copy__()
            model.body_mass[:] *= mass[kind]
            model.body_pos[:] += place[kind]
            mujoco.mj_setConst(model, mujoco.MjData(model))
            derived = batch.engine.get_model(i)
            for name in ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0"):
                np.testing.assert_array_equal(getattr(derived, name), getattr(model, name))
        mass, place = mass[::-1], place[::-1]
