"""The registered tasks: what they are, that gymnasium and SB3 accept them, and what is known of them."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch as th
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_for_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.effects.corrected_model_io import load_corrected, save_corrected
from sb3_rpto.effects.model import load_model
from sb3_rpto.effects.model_numbers import numbers
from sb3_rpto.envs import tasks
from sb3_rpto.envs.env_snapshot import restore_state, save_state
from sb3_rpto.envs.observations import state_map
from sb3_rpto.envs.shifts import EnvShift
from sb3_rpto.envs.task_rules import task_rules
from sb3_rpto.envs.tasks import TARGETS, TASKS, env_id, make_shift, shift_names

WALKERS = ["Ant", "HalfCheetah", "Hopper", "Walker2d"]
GYMNASIUMS = {**{name: f"{name}-v5" for name in WALKERS}, "InvertedDoublePendulum": "InvertedDoublePendulum-v5"}
pytestmark = pytest.mark.filterwarnings("ignore:.*(precision lowered|Box (low|high)).*:UserWarning")


def run(env, steps=30, seed=0):
    space = env.action_space
    rng = np.random.default_rng(seed)
    answers = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        answers.append(env.step(rng.uniform(space.low, space.high).astype(space.dtype)))
        if answers[-1][2]:
            break
    return answers


@pytest.mark.parametrize(("task", "theirs"), GYMNASIUMS.items())
def test_a_source_is_gymnasiums_task(task, theirs):
    more = {"include_cfrc_ext_in_observation": False} if task == "Ant" else {}
    np.testing.assert_equal(run(gym.make(env_id(task))), run(gym.make(theirs, **more)))


def test_sizes():
    envs = {name: gym.make(env_id(name)) for name in TASKS}
    sizes = {name: (env.observation_space.shape[0], env.action_space.shape[0]) for name, env in envs.items()}
    assert sizes == {
        "Ant": (27, 8),
        "HalfCheetah": (17, 6),
        "Hopper": (11, 3),
        "Walker2d": (17, 6),
        "Swimmer": (12, 4),
        "InvertedDoublePendulum": (9, 1),
        "ContinuousCartPole": (4, 1),
    }
    assert {gym.spec(env_id(name)).max_episode_steps for name in TASKS if name != "ContinuousCartPole"} == {1_000}


@pytest.mark.parametrize("shift", ["", "target1"])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasium_and_sb3_accept_it(task, shift):
    check_env(gym.make(env_id(task, shift)), skip_render_check=True)
    check_for_sb3(gym.make(env_id(task, shift)))


def test_every_id_is_registered_and_made_by_its_module_prefix():
    expected = {env_id(task, shift) for task in TASKS for shift in ("", *shift_names(task))}
    assert expected <= set(gym.registry)
    assert {f"rpto/Hopper-target{seed}-v0" for seed in TARGETS} <= expected
    assert "rpto/HalfCheetah-gravity-x0.5-v0" in expected
    code = "import gymnasium as gym; print(gym.make('sb3_rpto:rpto/Swimmer-target3-v0').unwrapped)"
    made = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert "Swimmer5Env" in made.stdout


def test_registering_imports_no_mujoco():
    code = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("tasks", {tasks.__file__!r})
module = sys.modules["tasks"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
module.register_tasks()
assert not {{"mujoco", "gymnasium.envs.mujoco", "torch"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize(
    "given", ["target2", "friction-x0.5", EnvShift("mine", {"*.damping": 2.0, "torso.length": 1.1})]
)
def test_a_target_is_made_by_id_by_shift_and_from_its_spec_again(given):
    env = gym.make("rpto/Hopper-v0", shift=given)
    first = run(env)
    copies = [gym.make(env.spec), gym.make(EnvSpec.from_json(env.spec.to_json()))]
    if isinstance(given, str):
        copies.append(gym.make(env_id("Hopper", given)))
        copies.append(make_shift("Hopper", given).wrap(gym.make("rpto/Hopper-v0")))
    for copy in copies:
        np.testing.assert_equal(run(copy), first)
    assert [spec.name for spec in env.spec.additional_wrappers] == ["ShiftedEnv"]


def test_a_target_of_the_cart_pole():
    env = gym.make("rpto/ContinuousCartPole-limb-x2-v0")
    assert env.unwrapped.parameters.pole_length == 2.0
    np.testing.assert_equal(run(env), run(gym.make("rpto/ContinuousCartPole-v0", pole_length=2.0)))
    np.testing.assert_equal(run(gym.make(EnvSpec.from_json(env.spec.to_json()))), run(env))
    assert (
        gym.make("rpto/ContinuousCartPole-v0", shift="limb-x3", pole_length=0.5).unwrapped.parameters.pole_length == 1.5
    )


def test_shifts_that_do_not_exist_are_named():
    with pytest.raises(
        ValueError, match=r"'gravity-x2' means nothing in Swimmer; registered are target0, .*friction-x0\.5"
    ):
        gym.make("rpto/Swimmer-v0", shift="gravity-x2")
    with pytest.raises(ValueError, match="'wind-x2' does not exist; registered for Ant are target0"):
        make_shift("Ant", "wind-x2")
    with pytest.raises(ValueError, match="task 'Humanoid' does not exist; choose from Ant, "):
        shift_names("Humanoid")


@pytest.mark.parametrize("task", ["Hopper", "ContinuousCartPole"])
def test_pictures(task):
    env = gym.make(env_id(task, "target0"), render_mode="rgb_array_list")
    env.reset(seed=0)
    (picture,) = env.render()
    assert picture.ndim == 3
    assert picture.std() > 1
    env.close()


# --- the five-link swimmer --------------------------------------------------------------------------------------------


def test_the_swimmer_is_gymnasiums_with_two_more_links_like_the_last():
    ours, theirs = gym.make("rpto/Swimmer-v0").unwrapped.model, gym.make("Swimmer-v5").unwrapped.model
    assert (ours.nbody, ours.nv, ours.nu) == (theirs.nbody + 2, theirs.nv + 2, theirs.nu + 2)
    mine, other = numbers(ours), numbers(theirs)
    for name in (
        "body_mass",
        "body_inertia",
        "body_ipos",
        "body_pos",
        "geom_size",
        "geom_pos",
        "geom_quat",
        "geom_contype",
    ):
        np.testing.assert_array_equal(mine[name][: len(other[name])], other[name], err_msg=name)
        for added in mine[name][len(other[name]) :]:
            np.testing.assert_array_equal(added, other[name][-1], err_msg=name)
    for name in (
        "jnt_range",
        "jnt_axis",
        "jnt_limited",
        "dof_armature",
        "dof_damping",
        "actuator_gear",
        "actuator_ctrlrange",
    ):
        np.testing.assert_array_equal(mine[name][: len(other[name])], other[name], err_msg=name)
        np.testing.assert_array_equal(mine[name][-2:], np.stack([other[name][-1]] * 2), err_msg=name)
    np.testing.assert_array_equal(ours.actuator_trnid[:, 0], [3, 4, 5, 6])
    assert (ours.opt.density, ours.opt.viscosity, ours.opt.timestep) == (4000, 0.1, 0.01)


def test_the_swimmer_is_traced_saved_and_simulated(tmp_path):
    target = gym.make("rpto/Swimmer-target0-v0")
    spec, model = load_model(target)
    assert spec is not None
    assert (
        model.body_mass[5]
        == target.unwrapped.model.body_mass[5]
        != gym.make("rpto/Swimmer-v0").unwrapped.model.body_mass[5]
    )
    save_corrected(tmp_path, target, [])
    np.testing.assert_equal(numbers(load_corrected(tmp_path).model)["body_inertia"], numbers(model)["body_inertia"])
    assert physical_config(target)["frame_skip"] == 4
    target.reset(seed=0)
    observation, *_ = target.step(target.action_space.sample())
    states = state_map(target)(observation[None])
    np.testing.assert_array_equal(states.qpos[0, 2:], target.unwrapped.data.qpos[2:])
    np.testing.assert_array_equal(states.qvel[0], target.unwrapped.data.qvel)


# --- what is known of them --------------------------------------------------------------------------------------------


def answers(env, steps=400):
    """Observations, next observations, rewards and terminations of random episodes."""
    rng = np.random.default_rng(0)
    found = []
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        following, reward, terminated, _, _ = env.step(action)
        found.append((observation, action, following, reward, terminated))
        observation = env.reset()[0] if terminated else following
    return [np.array(column) for column in zip(*found)]


@pytest.mark.parametrize("shift", ["", "target0", "limb-x2"])
@pytest.mark.parametrize("task", TASKS)
def test_rules_are_those_of_the_very_world(task, shift):
    env = gym.make(env_id(task, shift))
    rules = task_rules(env)
    observations, actions, following, rewards, ended = answers(env)
    arguments = [th.as_tensor(array) for array in (observations, actions, following)]
    np.testing.assert_array_equal(rules.termination_fn(*arguments).numpy(), ended)
    assert ended.any() or task in ("HalfCheetah", "Swimmer", "Ant")
    assert (rules.reward_fn is not None) == (task in ("InvertedDoublePendulum", "ContinuousCartPole"))
    if rules.reward_fn is not None:
        np.testing.assert_allclose(rules.reward_fn(*arguments).numpy(), rewards, atol=2e-2)


@pytest.mark.slow
def test_healthy_heights_of_a_target_in_another_process():
    remote = make_vec_env("sb3_rpto:rpto/Hopper-target1-v0", n_envs=1, vec_env_cls=SubprocVecEnv)
    try:
        ranges = task_rules(remote).termination_fn.keywords["ranges"]
    finally:
        remote.close()
    env = gym.make("rpto/Hopper-target1-v0")
    assert ranges == task_rules(env).termination_fn.keywords["ranges"]
    assert ranges[0][2] == env.unwrapped._healthy_z_range[0] != 0.7


def test_sensors_that_err_take_the_rules_with_them():
    bias = {"kind": "sensor_bias", "on": "rooty", "values": {"offset": 0.1}}
    env = gym.make("rpto/Hopper-v0", shift=EnvShift("biased", effects=[bias]))
    assert task_rules(env) == (None, None)


def test_a_saved_state_of_a_target_replays_exactly():
    def build():
        env = DummyVecEnv([lambda: gym.make("rpto/Walker2d-target0-v0")])
        env.seed(3)
        env.reset()
        return env

    env, other = build(), build()
    actions = np.random.default_rng(0).uniform(-1, 1, size=(20, 1, 6)).astype(np.float32)
    for action in actions[:8]:
        env.step(action)
    state = save_state(env)
    ahead = [env.step(action)[:3] for action in actions]
    restore_state(other, state)
    np.testing.assert_equal([other.step(action)[:3] for action in actions], ahead)


def test_twice_the_range_is_registered_where_every_joint_stays_within_half_a_turn():
    for task, known in TASKS.items():
        if known.ranges:
            model = gym.make(env_id(task), shift="joint-range-x2").unwrapped.model
            limited = (model.jnt_limited == 1) & (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
            assert (np.abs(model.jnt_range[limited]).max() <= np.pi) == (2.0 in known.levels["joint-range"]), task


# --- the docs ---------------------------------------------------------------------------------------------------------


def test_the_tables_of_the_docs_are_the_registry():
    lines = (Path(__file__).parents[2] / "docs" / "tasks.md").read_text().splitlines()
    kinds = ["gravity", "friction", "joint-range", "limb"]
    for name, known in TASKS.items():
        levels = [", ".join(f"x{factor:g}" for factor in known.levels.get(kind, ())) for kind in kinds]
        row = f"| `{name}` | target0 to target3 | {' | '.join(levels)} |"
        assert row.replace("|  |", "| |").replace("|  |", "| |") in lines
        env = gym.make(env_id(name))
        sizes = (env.observation_space.shape[0], env.action_space.shape[0], known.max_episode_steps)
        (line,) = [line for line in lines if line.startswith(f"| `{name}` | ") and line.endswith(f"| {sizes[2]:,} |")]
        assert line.endswith(f" | {sizes[0]} | {sizes[1]} | {sizes[2]:,} |")
