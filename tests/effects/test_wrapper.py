"""Environments with effects step exactly as the batch does, and without effects exactly as before."""

import copy
import pickle
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from compared import assert_same, fields
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils.env_checker import check_env
from queued import Queue
from stable_baselines3 import SAC

from sb3_rpto.effects import LIBRARY, Declared, Drive, Effect, Parameter, Scales, Simulation
from sb3_rpto.effects.commands import CommandDelay
from sb3_rpto.effects.effect import from_json
from sb3_rpto.effects.friction import CoulombFriction, StribeckFriction
from sb3_rpto.effects.model import load_model
from sb3_rpto.effects.names import object_names
from sb3_rpto.effects.wrapper import CorrectedEnv, beyond_model, corrections
from sb3_rpto.envs.env_copy import copy_env

POLE = "InvertedDoublePendulum-v5"
#: other test modules may register effects of their own while all are collected
SHIPPED = sorted(kind for kind, effect in LIBRARY.items() if effect.__module__.startswith("sb3_rpto."))


class Lag(Effect):
    """A command filter with memory."""

    kind, place, equation = "test_lag", "actuator", "y' = (u - y)/T"
    parameters = (Parameter("time", "s", 0.1, lower=0.0),)

    def command(self, u, x, memory, dt):
        memory["y"] = memory.get("y", np.zeros_like(u)) * np.exp(-dt / x[:, 0]) + u * (1 - np.exp(-dt / x[:, 0]))
        return memory["y"]


class Double(Effect):
    """A gain on the command; nearer the actuator than the lag, though it may be listed before."""

    kind, place, equation, order = "test_gain", "actuator", "(1 + g) u - 0.1", 1
    parameters = (Parameter("g", "", 0.1),)

    def command(self, u, x, memory, dt):
        return (1 + x[:, 0]) * u - 0.1


class Clock(Effect):
    """A force that knows the time, so that one that acts once a control step shows."""

    kind, place, equation = "test_clock", "joint", "a sin(500 t)"
    parameters = (Parameter("a", "N", 0.1),)

    def act(self, batch, x):
        batch.force[:, self.dof] += x[:, 0] * np.sin(500 * batch.time)


class Bias(Effect):
    kind, place, equation = "test_bias", "sensor", "q + b"
    parameters = (Parameter("b", "rad", 0.1),)

    def observe(self, q, v, x):
        return q + x[:, 0], 2 * v


def effects(model):
    return [
        Declared(model, "hinge.damping").with_values(np.array([0.3])),
        Declared(model, "cart.mass").with_values(np.array([7.0])),
        Declared(model, "option.density").with_values(np.array([500.0])),
        CoulombFriction("slider", level=0.4),
        StribeckFriction("hinge2", extra=0.2, level=0.05, speed=0.4),
        Clock("hinge", a=3.0),
        Double("slide", g=0.4),
        Lag("slide", time=0.02),
    ]


def actions_for(env, steps, seed=1):
    space = env.action_space
    return np.random.default_rng(seed).uniform(space.low, space.high, size=(steps, *space.shape)).astype(np.float32)


def run(env, actions, seed=0):
    first, _ = env.reset(seed=seed)
    return [(first,), *(env.step(action) for action in actions)]


@pytest.mark.parametrize("name", [POLE, "HalfCheetah-v5", "Hopper-v5"])
def test_no_effects_change_nothing(name):
    bare, wrapped = gym.make(name), CorrectedEnv(gym.make(name), [])
    actions = actions_for(bare, 40)
    assert_same(run(wrapped, actions), run(bare, actions))


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "Hopper-v5"])
def test_the_substeps_are_gymnasiums(name):
    """The loop that effects run in is MujocoEnv's own when what they add is nothing."""

    class Nothing(Clock):
        kind, place = "test_nothing", "world"  # on a joint it would make the dry friction there stiffer

        def act(self, batch, x):
            batch.force[:] += 0.0

    bare, wrapped = gym.make(name), CorrectedEnv(gym.make(name), [Nothing(a=1.0)])
    actions = actions_for(bare, 40)
    assert_same(run(wrapped, actions), run(bare, actions))


def test_effects_at_their_null_change_nothing():
    bare = gym.make(POLE)
    actions = actions_for(bare, 30)
    names = ("slider", "hinge2", "hinge", "slide", "slide", "hinge")
    kinds = (CoulombFriction, StribeckFriction, Clock, Double, Lag, Bias)
    wrapped = CorrectedEnv(gym.make(POLE), [kind(on) for kind, on in zip(kinds, names)])
    assert_same(run(wrapped, actions), run(bare, actions))


def from_library(kind, model):
    cls = LIBRARY[kind]
    values = {p.name: np.clip(p.null + p.size_for(Scales()) / 3, p.lower, p.upper) for p in cls.parameters}
    return [cls(cls.places(model)[-1], **values)]


def in_touch(name):
    """With a medium, and the last geom colliding with others."""
    env = gym.make(name)
    model = env.unwrapped.model
    model.opt.density, model.geom_contype[-1] = 1.2, 1
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return env


@pytest.mark.parametrize("kind", ["", *SHIPPED])
def test_it_steps_as_the_batch_does(kind):
    env = in_touch(POLE)
    if kind and not LIBRARY[kind].places(env.unwrapped.model):
        env = in_touch("Reacher-v5")  # its target moves in two ways
        model = env.unwrapped.model  # and its motors shall be servos
        back = (0, -1) if kind.startswith("velocity") else (-1, -0.1)
        model.actuator_biastype[:], model.actuator_biasprm[:, 1:3] = mujoco.mjtBias.mjBIAS_AFFINE, back
        model.actuator_gear[:, 0] = 4
    base = env.unwrapped
    nominal = copy.copy(base.model)
    chosen = from_library(kind, nominal) if kind else effects(nominal)
    wrapped = CorrectedEnv(env, chosen)
    wrapped.reset(seed=0)
    qpos, qvel = np.array([0.1, 0.3, -0.4, 0.1])[: base.model.nq], np.array([0.5, -1.0, 2.0, 0.1])[: base.model.nv]
    mujoco.mj_resetData(base.model, base.data)
    base.data.qpos[:], base.data.qvel[:] = qpos, qvel
    actions = actions_for(env, 60)
    states = [np.concatenate([qpos, qvel])]
    for action in actions:
        base.do_simulation(action, base.frame_skip)
        states.append(base.state_vector())
    simulation = Simulation(nominal, chosen, nthread=1)
    drive = Drive(np.repeat(actions, base.frame_skip, axis=0)[None].astype(float), hold=base.frame_skip)
    q, v = simulation.rollout(simulation.values()[None], qpos[None], qvel[None], drive)
    np.testing.assert_array_equal(np.array(states), np.hstack([q[0], v[0]])[:: base.frame_skip])


class Written(gym.Wrapper):
    """Forces as a user's wrapper puts them on the hinges: once a step, for all of its substeps."""

    def __init__(self, env, force):
        super().__init__(env)
        self.force = force

    def step(self, action):
        data = self.unwrapped.data
        data.qfrc_applied[1:] = [self.force(v) for v in data.qvel[1:]]
        return self.env.step(action)


@pytest.mark.parametrize(
    ("kind", "values", "force"),
    [
        ("held_friction", {"level": 0.2}, lambda v: -0.2 * np.sign(v)),
        ("held_damping", {"coefficient": 0.1}, lambda v: -0.1 * v),
        ("held_drag", {"coefficient": 0.05}, lambda v: -0.05 * abs(v) * v),
    ],
)
@pytest.mark.parametrize("beside", [False, True])
def test_held_forces_are_those_of_a_wrapper_that_writes_them(kind, values, force, beside):
    bare = gym.make(POLE)
    others = effects(bare.unwrapped.model) if beside else []  # forces in every substep among them
    held = [LIBRARY[kind](hinge, **values) for hinge in ("hinge", "hinge2")]
    actions = actions_for(bare, 40)
    wrapped = CorrectedEnv(gym.make(POLE), [*others, *held])
    written = Written(CorrectedEnv(gym.make(POLE), others), force)
    for one, other in zip(run(wrapped, actions), run(written, actions)):
        np.testing.assert_allclose(one[0], other[0], rtol=0, atol=1e-9)


def test_an_external_force_is_xfrc_applied_at_the_centre_of_mass():
    class Pulled(gym.Wrapper):
        def step(self, action):
            self.unwrapped.data.xfrc_applied[1, :3] = (5.0, 0.0, -2.0)
            return self.env.step(action)

    force = LIBRARY["external_force"]("torso", x=5.0, z=-2.0)
    friction = LIBRARY["load_friction"]("foot_joint", mu=0.1)  # acts in every substep, too
    actions = actions_for(gym.make("Hopper-v5"), 30)
    effect = run(CorrectedEnv(gym.make("Hopper-v5"), [force, friction]), actions)
    written = run(Pulled(CorrectedEnv(gym.make("Hopper-v5"), [friction])), actions)
    beside = run(Pulled(CorrectedEnv(gym.make("Hopper-v5"), [force.with_values(-force.values), friction])), actions)
    neither = run(CorrectedEnv(gym.make("Hopper-v5"), [friction]), actions)
    for one, other in [*zip(effect, written), *zip(beside, neither)]:
        np.testing.assert_allclose(one[0], other[0], rtol=0, atol=1e-9)
    assert not np.allclose(effect[-1][0], neither[-1][0], atol=1e-3)


def test_each_effect_shows():
    bare = gym.make(POLE)
    actions = actions_for(bare, 20)
    reference = run(bare, actions)
    for effect in [*effects(bare.unwrapped.model), Bias("hinge", b=0.2)]:
        episode = run(CorrectedEnv(gym.make(POLE), [effect]), actions)
        assert not np.allclose(episode[-1][0], reference[-1][0], rtol=1e-9), effect


def test_the_state_stays_where_it_was():
    env = gym.make(POLE)
    env.reset(seed=3)
    before = env.unwrapped.state_vector()
    CorrectedEnv(env, effects(env.unwrapped.model))
    np.testing.assert_array_equal(env.unwrapped.state_vector(), before)


def test_a_reset_forgets_everything():
    env = gym.make(POLE)
    wrapped = CorrectedEnv(env, effects(env.unwrapped.model))
    actions = actions_for(env, 25)
    first = run(wrapped, actions)
    run(wrapped, actions_for(env, 7, seed=2), seed=5)
    assert_same(run(wrapped, actions), first)


def test_a_reset_by_a_wrapper_beneath_is_one():
    late = [
        CommandDelay("slide", delay=0.03),
        LIBRARY["sensor_delay"]("hinge", delay=0.03),
        LIBRARY["torque_offset"]("hinge", offset=0.4),
    ]
    beneath = CorrectedEnv(gym.wrappers.Autoreset(gym.make(POLE)), late)
    above = gym.wrappers.Autoreset(CorrectedEnv(gym.make(POLE), late))
    actions = actions_for(beneath, 40)
    ends = [run(env, actions) for env in (beneath, above)]
    assert sum(step[2] for step in ends[0][1:]) > 1
    for one, other in zip(*ends, strict=True):
        np.testing.assert_array_equal(one[0], other[0])


def test_the_effects_given_are_left_alone():
    given = CoulombFriction("slider", level=0.4)
    wrapped = CorrectedEnv(gym.make(POLE), [given])
    assert not hasattr(given, "dof")
    assert wrapped.effects[0].dof == 0


def test_a_declared_value_is_the_environments_whatever_model_it_was_declared_for():
    other, env = gym.make(POLE).unwrapped.model, gym.make(POLE)
    other.body_mass[1] = 3.0
    CorrectedEnv(env, [Declared(other, "cart.mass").with_values(np.array([7.0]))])
    assert env.unwrapped.model.body_mass[1] == pytest.approx(7.0, rel=1e-15)


def test_sensors_shift_the_observation_and_not_the_state():
    bare = gym.make("HalfCheetah-v5")
    wrapped = CorrectedEnv(gym.make("HalfCheetah-v5"), [Bias("bthigh", b=0.25)])
    actions = actions_for(bare, 10)
    for (true, *rest), (seen, *others) in zip(run(bare, actions), run(wrapped, actions), strict=True):
        shift = seen - true
        np.testing.assert_allclose(shift[2], 0.25, rtol=1e-12)  # the second joint behind the root's three, x left out
        np.testing.assert_array_equal(seen[11], 2 * true[11])
        shift[[2, 11]] = 0
        np.testing.assert_array_equal(shift, 0)
        assert rest == others
    np.testing.assert_array_equal(bare.unwrapped.state_vector(), wrapped.unwrapped.state_vector())


def test_observations_that_are_views_of_the_state_keep_what_the_sensor_shows():
    env = gym.make(POLE).unwrapped
    type_ = type("Views", (type(env),), {"_get_obs": lambda self: self.data.qpos})
    wrapped = CorrectedEnv(type_(), [Bias("hinge", b=0.25)])
    obs, _ = wrapped.reset(seed=0)
    assert obs[1] == wrapped.unwrapped.data.qpos[1] + 0.25


# --- other effects afterwards -----------------------------------------------------------------------------------------


def hopper_effects(model):
    """By every hook, and numbers of every owner."""
    changed = {"thigh.length": 0.5, "torso.mass": 5.0, "leg_joint.damping": 1.5, "foot_geom.friction": 1.2}
    changed |= {"option.gravity": 8.0, "option.density": 30.0, "foot_joint.frictionloss": 2.0}
    return [
        *(Declared(model, name).with_values(np.array([value])) for name, value in changed.items()),
        CoulombFriction("thigh_joint", level=3.0),
        StribeckFriction("leg_joint", extra=2.0, level=1.0, speed=0.4),
        Clock("rootx", a=20.0),
        Double(object_names(model, "actuator")[2], g=0.3),
        Lag(object_names(model, "actuator")[0], time=0.03),
        Bias("rootz", b=0.02),
    ]


def cheetah_effects(model):
    return [
        Declared(model, "joint:bthigh.damping").with_values(np.array([9.0])),
        Declared(model, "torso.mass").with_values(np.array([8.0])),
        StribeckFriction("bshin", extra=2.0, level=1.0, speed=0.4),
        Lag("ffoot", time=0.03),
        Bias("bfoot", b=0.02),
    ]


TASKS = {"Hopper-v5": hopper_effects, "HalfCheetah-v5": cheetah_effects, POLE: effects}


@pytest.mark.parametrize("name", TASKS)
def test_taking_all_effects_away_leaves_the_bare_environment(name):
    bare, env = gym.make(name), gym.make(name)
    env.reset(seed=0)
    before, names = fields(env), set(vars(env.unwrapped))
    wrapped = CorrectedEnv(env, TASKS[name](env.unwrapped.model))
    actions = actions_for(bare, 40)
    assert not np.array_equal(run(wrapped, actions)[-1][0], run(bare, actions)[-1][0])
    wrapped.set_effects([])
    assert wrapped.effects == []
    np.testing.assert_equal(fields(env), before)
    assert set(vars(env.unwrapped)) == names
    assert_same(run(wrapped, actions), run(bare, actions))


@pytest.mark.parametrize("name", TASKS)
def test_effects_set_later_are_those_set_at_first(name):
    env, other = gym.make(name), gym.make(name)
    chosen = TASKS[name](env.unwrapped.model)
    wrapped, reference = CorrectedEnv(env, chosen[: len(chosen) // 2]), CorrectedEnv(other, chosen)
    actions = actions_for(env, 25)
    run(wrapped, actions_for(env, 7, seed=2), seed=5)
    expected = run(reference, actions)
    wrapped.set_effects(chosen)
    assert_same(run(wrapped, actions), expected)
    wrapped.set_effects([chosen[0].with_values(chosen[0].values * 1.1), *chosen[1:]])
    wrapped.set_effects(chosen)  # values do not pile up
    assert_same(run(wrapped, actions), expected)
    assert_same(run(copy_env(wrapped), actions), expected)
    assert_same(run(copy.deepcopy(wrapped), actions), expected)


def test_a_declared_value_starts_from_the_models_own_again():
    env = gym.make(POLE)
    model = env.unwrapped.model
    nominal, inertia, mass = float(model.body_mass[1]), model.body_inertia[1].copy(), Declared(model, "cart.mass")
    wrapped = CorrectedEnv(env, [mass.with_values(np.array([7.0]))])
    wrapped.set_effects([mass.with_values(np.array([3.0]))])
    assert model.body_mass[1] == pytest.approx(3.0, rel=1e-15)
    np.testing.assert_allclose(model.body_inertia[1], inertia * 3.0 / nominal, rtol=1e-12)
    wrapped.set_effects([Declared(model, "hinge.damping")])
    assert model.body_mass[1] == nominal


def test_a_servos_gain_is_set_again_where_it_is_none_any_more(tmp_path):
    xml = Path(gym.make(POLE).unwrapped.fullpath).read_text().replace("<motor", '<position kp="20"')
    (tmp_path / "servo.xml").write_text(xml.replace('gear="500"', ""))
    env = gym.make(POLE, xml_file=str(tmp_path / "servo.xml"))
    model = env.unwrapped.model
    kp = Declared(model, "slide.kp").with_values(np.array([25.0]))
    wrapped = CorrectedEnv(env, [kp, LIBRARY["command_gain"]("slide", change=0.1)])
    wrapped.set_effects([kp])
    assert model.actuator_gainprm[0, 0] == -model.actuator_biasprm[0, 1] == 25.0


def go_on(wrapped, reference, actions):
    """Step both from the state of the first; the reference keeps its own model and memories."""
    base, other = wrapped.unwrapped, reference.unwrapped
    mujoco.mj_copyData(other.data, other.model, base.data)
    for action in actions:
        assert_same(wrapped.step(action), reference.step(action))


def test_effects_change_in_the_middle_of_an_episode():
    env, other = gym.make("Hopper-v5"), gym.make("Hopper-v5")
    every = hopper_effects(env.unwrapped.model)
    then = [Clock("rootz", a=9.0), Bias("rooty", b=0.1), Double(every[-3].on, g=0.1), *every[1:4]]
    wrapped, reference = CorrectedEnv(env, [*every[::2], Lag(every[-3].on, time=0.03)]), CorrectedEnv(other, then)
    actions = actions_for(env, 20)
    run(wrapped, actions[:8])
    state = env.unwrapped.state_vector()
    wrapped.set_effects(then)
    np.testing.assert_array_equal(env.unwrapped.state_vector(), state)
    reference.reset(seed=1)
    go_on(wrapped, reference, actions[8:])


@pytest.mark.parametrize("delay", [0.03, 0.17])
@pytest.mark.parametrize("more", [[], [Double("slide", g=0.4)]], ids=["alone", "beside another"])
def test_commands_are_remembered_by_effects_that_stay(delay, more):
    """As if the effects had been so from the start, and only the state were another."""
    env, other = gym.make(POLE), gym.make(POLE)
    later = [*more, CommandDelay("slide", delay=delay)]
    wrapped, reference = CorrectedEnv(env, [CommandDelay("slide", delay=0.05)]), CorrectedEnv(other, later)
    actions = actions_for(env, 9)
    run(wrapped, actions[:4]), run(reference, actions[:4])
    wrapped.set_effects(later)
    go_on(wrapped, reference, actions[4:])


def test_memories_go_with_their_effects():
    """Of two that take turns, what one remembers is nothing to the other."""
    env, other = gym.make(POLE), gym.make(POLE)
    lag = [Lag("slide", time=0.02), CommandDelay("slide")]
    delay = [Lag("slide"), CommandDelay("slide", delay=0.02)]
    wrapped, reference = CorrectedEnv(env, lag), CorrectedEnv(other, delay)
    actions = actions_for(env, 9)
    run(wrapped, actions[:4])
    wrapped.set_effects(delay)
    reference.reset(seed=0)
    go_on(wrapped, reference, actions[4:])


def test_effects_that_cannot_be_change_nothing():
    env = gym.make("Hopper-v5")
    wrapped = CorrectedEnv(env, hopper_effects(env.unwrapped.model))
    actions = actions_for(env, 15)
    first, before = run(wrapped, actions), fields(env)
    with pytest.raises(ValueError, match="no joint 'elbow'"):
        wrapped.set_effects([CoulombFriction("thigh_joint", level=1.0), CoulombFriction("elbow", level=1.0)])
    np.testing.assert_equal(fields(env), before)
    assert_same(run(wrapped, actions), first)


def test_sensors_that_are_read_elsewhere_are_refused():
    base = type(gym.make(POLE).unwrapped)
    env = type("Elsewhere", (base,), {"reset_model": lambda self: np.zeros(9), "_get_obs": None})()
    wrapped = CorrectedEnv(env, [Declared(env.model, "cart.mass").with_values(np.array([7.0]))])
    with pytest.raises(ValueError, match=r"test_bias\(hinge\): Elsewhere has no _get_obs"):
        wrapped.set_effects([Bias("hinge", b=0.1)])
    assert env.model.body_mass[1] == pytest.approx(7.0)


def test_a_copy_has_effects_of_its_own():
    env = gym.make(POLE)
    wrapped = CorrectedEnv(env, effects(env.unwrapped.model))
    actions = actions_for(env, 15)
    first = run(wrapped, actions)
    twin = copy_env(wrapped)
    twin.set_effects([])
    assert_same(run(wrapped, actions), first)
    assert_same(run(twin, actions), run(gym.make(POLE), actions))


def test_a_copy_says_that_it_draws_no_pictures():
    original = CorrectedEnv(gym.make(POLE, render_mode="rgb_array"), [])
    with pytest.raises(RuntimeError, match=r"a corrected copy draws no pictures.*render_mode='rgb_array'"):
        copy_env(original).render()


# --- effects on top of effects ----------------------------------------------------------------------------------------


def test_effects_on_top_of_effects_are_all_of_them_at_once():
    env, other = gym.make(POLE), gym.make(POLE)
    every = [*effects(env.unwrapped.model), Bias("hinge", b=0.1)]
    one = CorrectedEnv(env, every)
    stacked = CorrectedEnv(CorrectedEnv(gym.wrappers.ClipAction(other), [*every[0:6:2], every[6], every[8]]), [])
    stacked = CorrectedEnv(stacked, [*every[1:6:2], every[7]])
    np.testing.assert_equal(fields(stacked), fields(one))
    actions = actions_for(env, 40)
    assert_same(run(stacked, actions), run(one, actions))
    assert_same(run(copy_env(stacked), actions), run(one, actions))
    assert_same(run(copy.deepcopy(stacked), actions), run(one, actions))
    assert [len(layer.effects) for layer in corrections(stacked)] == [4, 0, 5]


def test_upper_effects_go_and_come_over_those_beneath():
    env, other = gym.make(POLE), gym.make(POLE)
    lower, upper = effects(env.unwrapped.model)[::2], [*effects(env.unwrapped.model)[1::2], Bias("hinge", b=0.1)]
    beneath = CorrectedEnv(env, lower)
    only = fields(beneath)
    top = CorrectedEnv(beneath, upper)
    first = run(top, actions_for(env, 15))
    top.set_effects([])
    np.testing.assert_equal(fields(top), only)
    assert_same(run(top, actions_for(env, 15)), run(CorrectedEnv(other, lower), actions_for(env, 15)))
    top.set_effects(upper)
    assert_same(run(top, actions_for(env, 15)), first)


def test_numbers_are_changed_from_where_the_effects_beneath_left_them():
    env = gym.make(POLE)
    model, mass = env.unwrapped.model, env.unwrapped.model.body_mass.copy()
    beneath = CorrectedEnv(env, [Declared(model, "pole.mass").with_values(np.array([2 * mass[2]]))])
    inertia = model.body_inertia[2].copy()
    CorrectedEnv(CorrectedEnv(beneath, [CoulombFriction("hinge", level=0.2)]), [CoulombFriction("hinge", level=0.3)])
    assert model.dof_frictionloss[1] == pytest.approx(0.5)
    on_top = CorrectedEnv(gym.wrappers.ClipAction(beneath), [Declared(model, "pole.mass").with_values(mass[2:3])])
    assert model.body_mass[2] == pytest.approx(mass[2])
    np.testing.assert_allclose(model.body_inertia[2], inertia / 2)
    on_top.set_effects([])
    assert model.body_mass[2] == 2 * mass[2]


def test_sensors_and_commands_go_through_one_after_the_other():
    """What is on top is nearer the agent: it commands first and observes last."""
    env = gym.make(POLE)
    beneath = CorrectedEnv(env, [Double("slide", g=1.0), Bias("hinge", b=0.1)])  # 2 u - 0.1; q + 0.1, 2 v
    top = CorrectedEnv(beneath, [Double("slide", g=0.5), LIBRARY["sensor_gain"]("hinge", change=1.0)])  # 1.5 u - 0.1
    top.reset(seed=0)
    observation, *_ = top.step(np.array([0.2]))
    base = env.unwrapped
    assert base.data.ctrl[0] == pytest.approx(2 * (1.5 * 0.2 - 0.1) - 0.1)
    assert observation[1] == pytest.approx(np.sin(2 * (base.data.qpos[1] + 0.1)))


def test_what_a_servo_feeds_back_of_its_sensor_is_of_one_list(tmp_path):
    xml = Path(gym.make("InvertedPendulum-v5").unwrapped.fullpath).read_text()
    (tmp_path / "servo.xml").write_text(xml.replace("<motor ", '<position kp="1" '))
    env = gym.make("InvertedPendulum-v5", xml_file=str(tmp_path / "servo.xml"))
    bias, gain = LIBRARY["sensor_bias"]("slider", offset=0.1), LIBRARY["sensor_gain"]("slider", change=0.2)
    for beneath, top in ((bias, gain), (gain, bias)):
        with pytest.raises(ValueError, match=rf"{top.kind}\(slider\): .*{beneath.kind}\(slider\) beneath .* one list"):
            CorrectedEnv(CorrectedEnv(copy_env(env), [beneath]), [top])
    CorrectedEnv(CorrectedEnv(copy_env(env), [bias]), [bias])
    CorrectedEnv(CorrectedEnv(copy_env(env), [bias]), [LIBRARY["sensor_gain"]("hinge", change=0.2)])


def test_a_late_sensor_shows_what_was_there_before():
    """0.026 s are two and three fifths of this task's substeps of 0.01 s, and half a step of the agent's."""
    env, bare = gym.make(POLE), gym.make(POLE)
    late = CorrectedEnv(env, [Bias("hinge2", b=0.1), LIBRARY["sensor_delay"]("hinge2", delay=0.026)])
    first, _ = late.reset(seed=3)
    bare.reset(seed=3)
    base, substep = bare.unwrapped, bare.unwrapped.model.opt.timestep
    states = [base.state_vector()]
    assert first[2] == pytest.approx(np.sin(states[0][2] + 0.1)), "at first it shows the first state"
    for action in actions_for(bare, 4):
        shown, *_ = late.step(action)
        for _ in range(base.frame_skip):
            base.do_simulation(action, 1)
            states.append(base.state_vector())
        time = substep * np.arange(len(states))
        angle, speed = (np.interp(time[-1] - 0.026, time, np.array(states)[:, i]) for i in (2, 5))
        assert shown[2] == pytest.approx(np.sin(angle + 0.1))
        assert shown[7] == pytest.approx(np.clip(2 * speed, -10, 10))
        assert shown[1] == pytest.approx(np.sin(states[-1][1])), "the other sensors are in time"
    again, _ = late.reset(seed=3)
    np.testing.assert_array_equal(again, first)


def test_what_is_covered_cannot_be_set_and_what_no_number_says_is_named():
    env = gym.make(POLE)
    beneath = CorrectedEnv(env, effects(env.unwrapped.model)[:4])
    assert beyond_model(beneath) == []
    top = CorrectedEnv(beneath, [Clock("hinge", a=1.0), Lag("slide", time=0.1), Bias("hinge", b=0.1), Clock("hinge2")])
    assert beyond_model(top) == ["test_bias(hinge)", "test_clock(hinge)", "test_lag(slide)"]
    with pytest.raises(ValueError, match="other effects came on top"):
        beneath.set_effects([])
    with pytest.raises(ValueError, match=r"no numbers of its model \(test_bias\(hinge\), test_clock"):
        load_model(top)
    assert load_model(beneath)[1].body_mass[1] == pytest.approx(7.0)


# --- errors and the rest ----------------------------------------------------------------------------------------------


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match="PendulumEnv is no gymnasium MuJoCo environment"):
        CorrectedEnv(gym.make("Pendulum-v1"), [])
    with pytest.raises(ValueError, match="no joint 'elbow'"):
        CorrectedEnv(gym.make(POLE), [CoulombFriction("elbow", level=1.0)])


def test_an_environment_that_goes_round_the_seam_is_found_out():
    class Around(type(gym.make(POLE).unwrapped)):
        def do_simulation(self, ctrl, n_frames):
            MujocoEnv._step_mujoco_simulation(self, ctrl, n_frames)

    wrapped = CorrectedEnv(Around(), [Clock("hinge", a=1.0)])
    wrapped.reset(seed=0)
    with pytest.raises(ValueError, match="do_simulation"):
        wrapped.step(np.zeros(1))


def test_an_environment_that_reads_its_state_by_itself_in_steps_alone_is_found_out():
    class Composing(type(gym.make(POLE).unwrapped)):
        def step(self, action):
            self.do_simulation(action, self.frame_skip)
            return np.concatenate([self.data.qpos, self.data.qvel]), 0.0, False, False, {}

    wrapped = CorrectedEnv(CorrectedEnv(Composing(), [CoulombFriction("slider", level=0.4)]), [Bias("slider", b=0.5)])
    assert wrapped.reset(seed=0)[0][0] > 0.4
    with pytest.raises(ValueError, match="does not use _get_obs"):
        wrapped.step(np.zeros(1))


def test_physics_that_a_task_steps_by_itself_are_not_replaced_in_silence():
    class Windy(type(gym.make(POLE).unwrapped)):
        def _step_mujoco_simulation(self, ctrl, n_frames):
            self.data.xfrc_applied[2, 0] = 5.0
            super()._step_mujoco_simulation(ctrl, n_frames)

    wrapped = CorrectedEnv(Windy(), [CoulombFriction("slider", level=0.4)])  # a number of the model
    wrapped.reset(seed=0)
    wrapped.step(np.zeros(1))
    assert wrapped.unwrapped.data.xfrc_applied[2, 0] == 5.0
    with pytest.raises(ValueError, match=r"test_clock\(hinge\): Windy has a _step_mujoco_simulation\(\) of its own"):
        wrapped.set_effects([Clock("hinge", a=1.0)])
    assert [effect.label for effect in wrapped.effects] == ["coulomb_friction(slider)"]


def test_pickle_and_deepcopy_make_a_fresh_one_with_the_same_effects():
    env = gym.make(POLE)
    wrapped = CorrectedEnv(env, effects(env.unwrapped.model))
    actions = actions_for(env, 20)
    assert_same(run(copy.deepcopy(wrapped), actions), run(wrapped, actions))
    friction = CorrectedEnv(gym.make(POLE), [CoulombFriction("slider", level=0.4)])
    assert_same(run(pickle.loads(pickle.dumps(friction)), actions), run(friction, actions))


@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")
def test_it_is_a_gymnasium_environment_and_trains():
    env = gym.make(POLE)
    wrapped = CorrectedEnv(env, [*effects(env.unwrapped.model), Bias("hinge", b=0.1)])
    check_env(wrapped, skip_render_check=True)
    assert wrapped.spec.additional_wrappers[-1].name == "CorrectedEnv"
    assert len(wrapped.spec.additional_wrappers[-1].kwargs["effects"]) == 9
    agent = SAC("MlpPolicy", wrapped, learning_starts=10, batch_size=16, policy_kwargs={"net_arch": [16]}, seed=0)
    agent.learn(50)
    assert agent.num_timesteps == 50


class Pushed(MujocoEnv):
    """A cart-pole whose environment applies a force of its own."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 50}  # noqa: RUF012

    def __init__(self):
        super().__init__("inverted_pendulum.xml", 1, gym.spaces.Box(-np.inf, np.inf, (4,)))

    def step(self, action):
        self.data.qfrc_applied[0] = 3.0
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), 0.0, False, False, {}

    def reset_model(self):
        self.set_state(self.init_qpos, self.init_qvel)
        return self._get_obs()

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel])


def test_forces_of_the_environments_own_stay():
    offset = LIBRARY["torque_offset"]("slider", offset=2.0)
    plain, corrected = Pushed(), CorrectedEnv(Pushed(), [offset])
    plain.reset(seed=0)
    corrected.reset(seed=0)
    for _ in range(10):
        plain.data.qfrc_applied[0] = 5.0
        plain.do_simulation(np.zeros(1), 1)
        seen = corrected.step(np.zeros(1))[0]
    np.testing.assert_allclose(seen, plain._get_obs(), rtol=1e-12)
    assert corrected.unwrapped.data.qfrc_applied[0] == 3.0


SENSED = """
<mujoco><option timestep="0.02"/><worldbody><body><joint name="hinge" axis="0 1 0"/><geom type="capsule" size=".02"
fromto="0 0 0 0 0 -.5"/></body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator>
<sensor><jointpos joint="hinge"/><jointvel joint="hinge"/></sensor></mujoco>"""


class Sensed(Pushed):
    """A pendulum that is observed by the sensors of its model."""

    def __init__(self, path):
        MujocoEnv.__init__(self, path, 1, gym.spaces.Box(-np.inf, np.inf, (2,)))

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), 0.0, False, False, {}

    def _get_obs(self):
        return self.data.sensordata.copy()


def test_the_models_own_sensors_err_as_well(tmp_path):
    (tmp_path / "model.xml").write_text(SENSED)
    true = Sensed(str(tmp_path / "model.xml"))
    biased = CorrectedEnv(Sensed(str(tmp_path / "model.xml")), [LIBRARY["sensor_bias"]("hinge", offset=0.3)])
    true.reset(seed=0)
    biased.reset(seed=0)
    for _ in range(5):
        seen, expected = biased.step(np.ones(1))[0], true.step(np.ones(1))[0]
        np.testing.assert_allclose(seen, np.array([0.3, 0.0]) + expected, atol=1e-12)
    np.testing.assert_array_equal(biased.unwrapped.data.qpos, true.data.qpos)
    np.testing.assert_array_equal(biased.unwrapped.data.sensordata, true.data.sensordata)


def test_an_idle_delay_is_a_queue_of_actions_that_is_empty_at_a_reset():
    env = gym.make(POLE)
    late = CommandDelay("slide", delay=env.unwrapped.dt)
    late.idle = True
    envs = [Queue(gym.make(POLE)), CorrectedEnv(env, [late])]
    action = np.array([0.4])
    for seed in (0, 1):
        assert np.array_equal(*(e.reset(seed=seed)[0] for e in envs))
        for _ in range(4):
            first, second = (e.step(action)[0] for e in envs)
            np.testing.assert_allclose(first, second, rtol=0, atol=1e-12)
    envs[1].reset(seed=0)
    envs[1].forget_commands()
    plain = gym.make(POLE)
    plain.reset(seed=0)
    np.testing.assert_allclose(envs[1].step(action)[0], plain.step(action)[0], rtol=0, atol=1e-12)


def test_what_is_idle_stays_so_with_other_values_and_as_json():
    late = CommandDelay("slide", delay=0.05)
    assert "idle" not in late.to_json()
    late.idle = True
    for made in (late.with_values(np.array([0.1])), late.as_known(), from_json(late.to_json()), copy.deepcopy(late)):
        assert made.idle


@pytest.mark.parametrize("kinds", [("soft_friction", "coulomb_friction"), ("coulomb_friction", "soft_friction")])
def test_friction_of_two_sorts_holds_in_any_order_in_the_environment_as_in_the_batch(kinds):
    effects = [LIBRARY[kind]("slider", level=0.2) for kind in kinds]
    env, sim = CorrectedEnv(gym.make(POLE), effects), Simulation(gym.make(POLE).unwrapped.model, effects, 1)
    env.reset(seed=0)
    base = env.unwrapped
    start, command = (base.data.qpos.copy(), base.data.qvel.copy()), np.full((1, base.frame_skip, 1), 0.1)
    env.step(np.array([0.1]))
    qpos, qvel = sim.rollout(sim.values()[None], *(x[None] for x in start), Drive(command))
    np.testing.assert_array_equal(qpos[0, -1], base.data.qpos)
    np.testing.assert_array_equal(qvel[0, -1], base.data.qvel)


@pytest.mark.parametrize("level", [0.0, 0.4])
def test_friction_that_gives_way_does_so_beside_friction_that_acts_in_the_environment_as_in_the_batch(level):
    """A gear's friction holds where it is alone, and beside MuJoCo's own acts in its constraint."""
    effects = [LIBRARY["soft_friction"]("slider", level=level), LIBRARY["load_friction"]("slider", mu=0.2)]
    env = CorrectedEnv(gym.make(POLE), effects)
    env.reset(seed=0)
    base = env.unwrapped
    start, command = (base.data.qpos.copy(), base.data.qvel.copy()), np.full((1, 4 * base.frame_skip, 1), 0.01)
    for _ in range(4):
        env.step(np.array([0.01]))
    sim = Simulation(gym.make(POLE).unwrapped.model, effects, 1)
    values = np.stack([sim.values(), sim.null, [0.0, 0.3], [0.2, 0.0]])
    qpos, qvel = sim.rollout(values, *(np.tile(x, (4, 1)) for x in start), Drive(np.tile(command, (4, 1, 1))))
    np.testing.assert_allclose(qpos[0, -1], base.data.qpos, rtol=0, atol=1e-12)
    np.testing.assert_allclose(qvel[0, -1], base.data.qvel, rtol=0, atol=1e-12)
