"""Shifted targets equal recompiled models, stand on their feet, differ from their source, and compose with effects."""

import copy
import pickle
from dataclasses import asdict
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from compared import fields
from stable_baselines3.common.env_util import make_vec_env

from sb3_rpto.effects import LIBRARY, Declared
from sb3_rpto.effects.inertia import matrices, to_tensor
from sb3_rpto.effects.model_numbers import numbers
from sb3_rpto.effects.wrapper import CorrectedEnv, corrections
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.shifts import EnvShift, ShiftedCartPole, differs
from sb3_rpto.envs.swimmer import swimmer_spec
from sb3_rpto.envs.tasks import TARGETS, TASKS, env_id, make_shift, shift_names
from sb3_rpto.sysid import Report

CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
TURNING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)
MUJOCO = [task for task in TASKS if task != "ContinuousCartPole"]
STANDING = ["HalfCheetah", "Hopper", "Walker2d"]
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")


def run(env, steps=25, seed=0):
    rng = np.random.default_rng(seed)
    space = env.action_space
    actions = rng.uniform(space.low, space.high, size=(steps, *space.shape)).astype(space.dtype)
    return [env.reset(seed=seed)[0], *(env.step(action) for action in actions)]


# --- exact references -------------------------------------------------------------------------------------------------


def recompiled(task: str, shift: EnvShift) -> mujoco.MjModel:
    """The target compiled by MuJoCo from a spec in which every link is stretched and every friction scaled."""
    path = gym.make(env_id(task)).unwrapped.fullpath
    spec = swimmer_spec(path) if task == "Swimmer" else mujoco.MjSpec.from_file(path)
    total = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1
    model = spec.compile()
    if total > 0:  # resolved once, on the source
        for geom in spec.geoms:
            geom.density *= total / model.body_mass.sum()
    stretch = {}
    for body in spec.bodies:
        factor = shift.factors.get(f"{body.name or f'body{body.id}'}.length", 1.0)
        capsules = [g for g in body.geoms if g.type == CAPSULE]
        axes = [matrices(model.geom_quat[g.id][None])[0, :, 2] for g in capsules]
        lengths = [model.geom_size[g.id, 1] for g in capsules]
        axis = axes[int(np.argmax(lengths))] if capsules else np.zeros(3)
        stretch[body.id] = np.eye(3) + (factor - 1) * np.outer(axis, axis)
        for geom, along, half in zip(capsules, axes, lengths):
            ends = [stretch[body.id] @ (model.geom_pos[geom.id] + sign * half * along) for sign in (-1, 1)]
            geom.fromto, geom.pos, geom.quat = np.concatenate(ends), [0, 0, 0], [1, 0, 0, 0]
    for body in spec.bodies[1:]:
        parent = int(model.body_parentid[body.id])
        turning = [joint.pos for joint in body.joints if joint.type in TURNING]
        rotation = matrices(model.body_quat[body.id][None])[0]
        anchor = turning[0] if turning else np.zeros(3)
        joined = stretch[parent] @ (model.body_pos[body.id] + rotation @ anchor)
        body.pos = joined - rotation @ stretch[body.id] @ anchor
        for thing in (*body.joints, *body.sites):
            thing.pos = stretch[body.id] @ thing.pos
    for geom in spec.geoms:
        friction = geom.friction.copy()
        friction[0] *= shift.factors.get(f"{geom.name}.friction", 1.0)
        geom.friction = friction
    for joint in spec.joints:
        joint.damping = joint.damping * shift.factors.get(f"{joint.name}.damping", 1.0)
    spec.option.viscosity *= shift.factors.get("option.viscosity", 1.0)
    spec.option.density *= shift.factors.get("option.density", 1.0)
    return spec.compile()


@pytest.mark.parametrize("seed", TARGETS[:2])
@pytest.mark.parametrize("task", MUJOCO)
def test_a_target_is_the_recompiled_model(task, seed):
    shift = make_shift(task, f"target{seed}")
    expected, model = recompiled(task, shift), gym.make(env_id(task, f"target{seed}")).unwrapped.model
    mine, theirs = numbers(model), numbers(expected)
    # A tensor has several principal frames, a capsule two; where frames coincide is for speed alone.
    frames = {"body_inertia", "body_iquat", "geom_quat", "body_sameframe", "geom_sameframe", "bvh_aabb"}
    for name in sorted(theirs.keys() - frames):
        if not name.startswith(("stat.", "cam_", "light_")):
            np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-8, atol=1e-9, err_msg=name)
    tensors = [to_tensor(m.body_inertia, m.body_iquat) for m in (model, expected)]
    np.testing.assert_allclose(*tensors, rtol=1e-8, atol=1e-10)
    axes = [matrices(m.geom_quat)[:, :, 2] for m in (model, expected)]
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", *axes)), 1)
    source = gym.make(env_id(task)).unwrapped.model
    assert not np.allclose(model.body_mass, source.body_mass, rtol=0.01)

    rng, one, other = np.random.default_rng(0), mujoco.MjData(model), mujoco.MjData(expected)
    for _ in range(5):
        for data in (one, other):
            mujoco.mj_resetData(model, data)
        one.qpos[:] += 0.3 * rng.normal(size=model.nq)
        one.qvel[:], one.ctrl[:] = rng.normal(size=model.nv), rng.uniform(-1, 1, size=model.nu)
        other.qpos[:], other.qvel[:], other.ctrl[:] = one.qpos, one.qvel, one.ctrl
        mujoco.mj_forward(model, one)
        mujoco.mj_forward(expected, other)
        assert one.ncon == other.ncon
        scale = np.abs(other.qacc).max()
        np.testing.assert_allclose(one.qacc, other.qacc, rtol=1e-4, atol=1e-6 * scale)  # contacts amplify rounding
        np.testing.assert_allclose(one.geom_xpos, other.geom_xpos, atol=1e-9)


def soles(env):
    """Height of the lowest point over the floor at the start, by the capsules' ends."""
    model, data = env.unwrapped.model, mujoco.MjData(env.unwrapped.model)
    data.qpos[:] = env.unwrapped.init_qpos
    mujoco.mj_kinematics(model, data)
    capsules = np.flatnonzero(model.geom_type == CAPSULE)
    ends = data.geom_xpos[capsules, 2] - np.abs(data.geom_xmat[capsules, 8]) * model.geom_size[capsules, 1]
    return float((ends - model.geom_size[capsules, 0]).min()), float(data.body("torso").xpos[2])


@pytest.mark.parametrize("task", STANDING)
def test_feet_are_on_the_ground_at_reset(task):
    gap, height = soles(gym.make(env_id(task)))
    assert 0 < gap < 0.1
    for name in shift_names(task):
        target = gym.make(env_id(task, name))
        assert soles(target)[0] == pytest.approx(gap, abs=1e-9), name
        target.reset(seed=0)
        noise = 0.11 if task == "HalfCheetah" else 0.01
        column = target.unwrapped.init_qpos[1]
        assert target.unwrapped.data.qpos[1] == pytest.approx(column, abs=noise)
    assert abs(soles(gym.make(env_id(task, "target0")))[1] - height) > 0.01


@pytest.mark.parametrize(("task", "healthy"), [("Hopper", (0.7, np.inf)), ("Walker2d", (0.8, 2.0))])
def test_healthy_heights_follow_the_body(task, healthy):
    gap, height = soles(gym.make(env_id(task)))
    for seed in TARGETS:
        target = gym.make(env_id(task, f"target{seed}"))
        ratio = (soles(target)[1] - gap) / (height - gap)
        np.testing.assert_allclose(target.unwrapped._healthy_z_range, np.array(healthy) * ratio)
        assert abs(ratio - 1) > 0.005
    assert gym.make(env_id(task, "friction-x2")).unwrapped._healthy_z_range == healthy


def test_the_ant_stands_as_before():
    source, target = gym.make("rpto/Ant-v0").unwrapped, gym.make("rpto/Ant-target0-v0").unwrapped
    np.testing.assert_array_equal(target.init_qpos, source.init_qpos)  # it starts in the air, on no legs
    assert target._healthy_z_range == source._healthy_z_range


def test_a_length_moves_no_other_mass():
    source = gym.make("rpto/HalfCheetah-v0")
    target = EnvShift("long", {"bthigh.length": 1.2}).apply(source)
    before, after = source.unwrapped.model.body_mass, target.unwrapped.model.body_mass
    thigh = source.unwrapped.model.body("bthigh").id
    others = np.arange(len(before)) != thigh
    np.testing.assert_array_equal(after[others], before[others])
    half, radius = 0.145, 0.046
    volume = [np.pi * radius**2 * (2 * half * s + 4 / 3 * radius) for s in (1.0, 1.2)]
    assert after[thigh] / before[thigh] == pytest.approx(volume[1] / volume[0])


def test_a_contact_has_the_larger_friction_of_its_two_geoms():
    for task, name in (("HalfCheetah", "friction-x0.5"), ("Hopper", "friction-x5"), ("Walker2d", "target1")):
        frictions = []
        for env in (gym.make(env_id(task)), gym.make(env_id(task, name))):
            model, data = env.unwrapped.model, env.unwrapped.data
            env.reset(seed=0)
            data.qpos[1] -= 0.1
            mujoco.mj_forward(model, data)
            contact = next(c for c in data.contact if "foot" in model.geom(c.geom[1]).name and c.geom[0] == 0)
            assert contact.friction[0] == model.geom_friction[contact.geom, 0].max()
            frictions.append(contact.friction[0])
        if name != "target1":
            assert frictions[1] == pytest.approx(float(name.partition("x")[2]) * frictions[0])


# --- drawing, printing, comparing -------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_equal_seeds_draw_equal_targets_within_20_percent(task):
    drawn = [make_shift(task, f"target{seed}") for seed in TARGETS]
    assert drawn == [make_shift(task, f"target{seed}") for seed in TARGETS]
    assert [shift.seed for shift in drawn] == list(TARGETS)
    for shift in drawn:
        assert all(0.8 <= factor <= 1.2 for factor in shift.factors.values())
        assert shift.factors.keys() == drawn[0].factors.keys()
    assert len({tuple(shift.factors.values()) for shift in drawn}) == len(TARGETS)
    assert drawn[0].factors != make_shift("Ant", "target0").factors or task == "Ant"


def test_every_link_and_every_friction_has_its_own_factor():
    counts = {}
    for task in MUJOCO:
        factors = make_shift(task, "target0").factors
        assert len(set(factors.values())) == len(factors)
        counts[task] = [sum(name.endswith(end) for name in factors) for end in (".length", ".friction", ".damping")]
    assert counts == {
        "Ant": [12, 14, 0],
        "HalfCheetah": [7, 9, 0],
        "Hopper": [4, 5, 0],
        "Walker2d": [7, 8, 0],
        "Swimmer": [5, 0, 0],
        "InvertedDoublePendulum": [2, 0, 3],
    }
    assert {"option.viscosity", "option.density"} <= make_shift("Swimmer", "target0").factors.keys()
    assert "floor.friction" in make_shift("Hopper", "target0").factors


def test_the_drawn_targets_stay_what_they_are():
    """Results name targets by their ids."""
    assert make_shift("Hopper", "target0").factors == {
        "torso.length": 1.0091,
        "thigh.length": 0.9225,
        "leg.length": 1.1042,
        "foot.length": 1.1588,
        "floor.friction": 0.9382,
        "torso_geom.friction": 0.9079,
        "thigh_geom.friction": 0.805,
        "leg_geom.friction": 0.8488,
        "foot_geom.friction": 0.8941,
    }


def test_it_prints_pickles_and_compares():
    delay = LIBRARY["command_delay"]("thigh_joint", delay=0.01)
    shift = EnvShift("late", {"leg.length": 1.1, "*.friction": 0.5}, [delay], seed=3)
    assert (
        str(shift) == "late (seed 3)\n  leg.length × 1.1\n  *.friction × 0.5\n  command_delay(thigh_joint): delay=0.01"
    )
    assert pickle.loads(pickle.dumps(shift)) == shift == copy.deepcopy(shift) == EnvShift(**asdict(shift))
    assert shift != EnvShift("late", {"leg.length": 1.1, "*.friction": 0.6}, [delay], seed=3)


def test_bad_shifts_are_refused():
    hopper = gym.make("rpto/Hopper-v0")
    with pytest.raises(ValueError, match=r"x: the factor of a\.mass must be positive and finite, not -1"):
        EnvShift("x", {"a.mass": -1})
    with pytest.raises(ValueError, match=r"torso\.mass is a number of the model: give its factor"):
        EnvShift("x", effects=[Declared(hopper.unwrapped.model, "torso.mass")])
    with pytest.raises(ValueError, match=r"no object 'thig'; did you mean 'thigh'"):
        EnvShift("x", {"thig.length": 2}).apply(hopper)
    with pytest.raises(ValueError, match=r"x: rootx\.damping is 0 in the model"):
        EnvShift("x", {"rootx.damping": 2}).apply(hopper)
    with pytest.raises(ValueError, match="neither a gymnasium MuJoCo environment nor a cart-pole"):
        EnvShift("x").apply(gym.make("Pendulum-v1"))
    with pytest.raises(TypeError, match="not DummyVecEnv"):
        EnvShift("x").apply(make_vec_env("rpto/Hopper-v0"))
    with pytest.raises(ValueError, match="low and high"):
        EnvShift.draw(hopper, ["*.length"], 0, low=1.2, high=0.8)
    cartpole = gym.make("rpto/ContinuousCartPole-v0")
    with pytest.raises(ValueError, match="the cart-pole has no pole_size; it has gravity, "):
        EnvShift("x", {"pole_size": 2}).apply(cartpole)
    with pytest.raises(ValueError, match="effects act in MuJoCo's simulations"):
        EnvShift("x", effects=[LIBRARY["command_delay"]("thigh_joint")]).apply(cartpole)


# --- applying and composing -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["Hopper", "ContinuousCartPole"])
def test_the_source_is_left_alone(task):
    source, reference = gym.make(env_id(task)), gym.make(env_id(task))
    target = make_shift(task, "target0").apply(source)
    np.testing.assert_equal(run(target), run(gym.make(env_id(task, "target0"))))
    np.testing.assert_equal(run(source), run(reference))
    np.testing.assert_equal(run(pickle.loads(pickle.dumps(target))), run(target))
    np.testing.assert_equal(run(copy_env(target), seed=4), run(copy.deepcopy(target), seed=4))


def test_a_factor_beyond_the_usual_bounds_is_taken_as_it_is():
    source, target = gym.make("rpto/Hopper-v0"), gym.make("rpto/Hopper-v0", shift="limb-x5")
    foot = [env.unwrapped.model.geom("foot_geom").size[1] for env in (source, target)]
    assert foot[1] == pytest.approx(5 * foot[0])
    twice = EnvShift("x", {"foot_geom.friction": 2, "*.friction": 3}).apply(source).unwrapped.model
    assert twice.geom("foot_geom").friction[0] == pytest.approx(12)
    assert twice.geom("floor").friction[0] == pytest.approx(3)


def test_a_shifted_environment_is_shifted_again():
    source, target = gym.make("rpto/Hopper-v0"), gym.make("rpto/Hopper-target0-v0")
    more = EnvShift("more", {"leg.length": 1.1, "floor.friction": 2.0})
    both = dict(make_shift("Hopper", "target0").factors)
    for name, factor in more.factors.items():
        both[name] *= factor
    stacked, once = more.apply(target), EnvShift("both", both).apply(source)
    assert stacked.unwrapped.init_qpos == pytest.approx(once.unwrapped.init_qpos)
    assert stacked.unwrapped._healthy_z_range == pytest.approx(once.unwrapped._healthy_z_range)
    for name in ("body_pos", "body_mass", "geom_size", "geom_friction"):
        np.testing.assert_allclose(fields(stacked)[name], fields(once)[name], rtol=1e-9, atol=1e-12)
    back = EnvShift("back", {name: 1 / factor for name, factor in both.items()}).apply(once)
    np.testing.assert_allclose(back.unwrapped.init_qpos, source.unwrapped.init_qpos, atol=1e-9)
    np.testing.assert_allclose(fields(back)["body_pos"], fields(source)["body_pos"], atol=1e-9)


def test_a_shift_and_a_correction_compose_in_either_order():
    source = gym.make("rpto/HalfCheetah-v0")
    friction, delay = LIBRARY["coulomb_friction"]("bthigh", level=5.0), LIBRARY["command_delay"]("fshin", delay=0.02)
    shift = EnvShift("heavy", {"option.gravity": 1.3, "ffoot.length": 1.1, "torso.mass": 1.2}, [delay])
    report = SimpleNamespace(correction=[friction])
    one = Report.apply(report, shift.apply(source))
    other = shift.apply(Report.apply(report, source))
    np.testing.assert_equal(run(one), run(other))
    assert [type(layer).__name__ for layer in corrections(one)] == ["StandingEnv", "ShiftedEnv"]
    assert differs(one, shift.apply(source)).effects == ()  # dry friction is a number
    assert differs(one, apply_effects(source, [friction])).effects == ("command_delay(fshin)",)


def test_a_target_can_be_corrected_back_to_its_source():
    """What a tracer would find is the inverse of the shift, in the model's own names."""
    source, target = gym.make("rpto/Walker2d-v0"), gym.make("rpto/Walker2d-target3-v0")
    model = source.unwrapped.model
    known = [Declared(model, name) for name in make_shift("Walker2d", "target3").factors]
    corrected = apply_effects(target, known)
    for name in ("body_mass", "body_pos", "geom_size", "geom_friction", "dof_invweight0"):
        np.testing.assert_allclose(fields(corrected)[name], fields(source)[name], rtol=1e-9, atol=1e-12)
    assert isinstance(corrected, CorrectedEnv)


# --- the null-shift check ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_every_registered_target_differs_in_numbers_and_in_motion(task):
    source = gym.make(env_id(task))
    for name in shift_names(task):
        found = differs(source, env_id(task, name))
        assert found, name
        assert found.step is not None, name
        assert found.numbers, name
        assert bool(found.task) == found.start, name


@pytest.mark.parametrize("task", TASKS)
def test_a_source_does_not_differ_from_itself(task):
    same = differs(env_id(task), env_id(task), steps=300)
    assert not same
    assert str(same) == "no step of 300 differs from the same state under the same actions"
    assert (same.numbers, same.task, same.effects) == ({}, (), ())
    ones = EnvShift("ones", dict.fromkeys(make_shift(task, "target0").factors, 1.0))
    assert not differs(env_id(task), ones.apply(gym.make(env_id(task))), steps=300)


def test_a_difference_says_what_differs():
    hopper = gym.make("rpto/Hopper-v0")
    found = differs(hopper, EnvShift("x", {"leg.length": 1.1, "foot_geom.friction": 0.5}).apply(hopper))
    assert found.numbers["body_mass"] == ("leg",)
    assert found.numbers["geom_friction"] == ("foot_geom",)
    assert found.task == ("init_qpos", "_healthy_z_range")
    assert "geom_friction: foot_geom\n" in str(found)
    assert str(found).endswith("the start differs\nstep 1 differs from the same state under the same actions")
    ranges = differs(hopper, EnvShift("x", {"foot_joint.range": 0.5, "leg_joint.damping": 1.1}).apply(hopper))
    assert ranges.numbers == {"jnt_range": ("foot_joint",), "dof_damping": ("leg_joint",)}
    cartpole = differs("rpto/ContinuousCartPole-v0", "rpto/ContinuousCartPole-gravity-x2-v0")
    assert (cartpole.numbers, cartpole.step) == ({"gravity": ()}, 1)


def test_a_body_that_only_one_of_them_has_is_a_difference(tmp_path):
    source = gym.make("InvertedPendulum-v5")
    spec = mujoco.MjSpec.from_file(source.unwrapped.fullpath)
    load = spec.body("pole").add_body(name="load", pos=[0, 0, 0.5])
    load.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.03, 0, 0], mass=0.5)
    spec.compile()
    (tmp_path / "loaded.xml").write_text(spec.to_xml())
    found = differs(source, gym.make("InvertedPendulum-v5", xml_file=str(tmp_path / "loaded.xml")))
    assert found
    assert found.numbers["body_mass"] == ()


def test_one_number_under_two_names_is_scaled_by_both():
    pendulum = gym.make("InvertedPendulum-v5")
    (nominal,) = pendulum.unwrapped.model.dof_damping[[1]]
    for other in ("hinge.damping", "joint:hinge.damping"):
        shifted = EnvShift("x", {"*.damping": 2.0, other: 3.0}).apply(pendulum)
        assert shifted.unwrapped.model.dof_damping[1] == pytest.approx(6 * nominal)


def test_a_number_that_shows_nowhere_is_no_difference():
    """Swimmer's geoms touch nothing, so that their friction may be anything."""
    source = gym.make("rpto/Swimmer-v0")
    found = differs(source, EnvShift("x", {"geom2.friction": 5.0}).apply(source), steps=200)
    assert not found
    assert str(found) == "geom_friction: geom2\nno step of 200 differs from the same state under the same actions"


def test_worlds_with_other_spaces_are_refused():
    with pytest.raises(ValueError, match="different spaces"):
        differs("rpto/Hopper-v0", "rpto/Ant-v0")


def test_the_check_touches_neither_environment():
    one, other = gym.make("rpto/Hopper-v0"), gym.make("rpto/Hopper-target0-v0")
    run(one), run(other)
    states = [env.unwrapped.state_vector() for env in (one, other)]
    differs(one, other)
    np.testing.assert_equal([env.unwrapped.state_vector() for env in (one, other)], states)


def test_the_cart_pole_is_shifted_in_place_and_its_episode_goes_on():
    env = gym.make("rpto/ContinuousCartPole-v0")
    env.reset(seed=0)
    shifted = make_shift("ContinuousCartPole", "limb-x2").wrap(env)
    assert isinstance(shifted, ShiftedCartPole)
    assert env.unwrapped.parameters.pole_length == 2.0
    shifted.step(np.zeros(1))
