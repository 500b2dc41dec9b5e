"""Snapshots continue bit for bit; trial copies leave the original alone."""

import pickle
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecMonitor, VecNormalize

from sb3_rpto.envs.cartpole import ContinuousCartPoleEnv
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.env_snapshot import accepts_seed, restore_state, save_state

MUJOCO = [
    *("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "InvertedDoublePendulum-v5", "InvertedPendulum-v5", "Pusher-v5"),
    *("Reacher-v5", "Swimmer-v5", "Walker2d-v5", "Humanoid-v5"),
]
OTHERS = ["Pendulum-v1", "MountainCarContinuous-v0"]


def need(name):
    if name in MUJOCO:
        pytest.importorskip("gymnasium.envs.mujoco.hopper_v5", exc_type=ImportError)


def build(name, n_envs=2, seed=0):
    need(name)
    # short episodes, so that the continuation crosses resets as well
    kwargs = {"max_episode_steps": 40}
    env = make_vec_env(name, n_envs=n_envs, seed=seed, env_kwargs=kwargs)
    env.action_space.seed(0)
    return env


def actions_for(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    space = env.unwrapped.envs[0].unwrapped.action_space  # ClipAction makes the outer one infinite
    low, high = space.low, space.high
    return rng.uniform(low, high, size=(steps, env.num_envs, *low.shape)).astype(np.float32)


def without_clock(info):
    info = dict(info)
    if "episode" in info:
        info["episode"] = {key: value for key, value in info["episode"].items() if key != "t"}
    return info


def run(env, actions):
    return [
        (obs, rewards, dones, list(map(without_clock, infos))) for obs, rewards, dones, infos in map(env.step, actions)
    ]


def assert_same(one, other):
    for (obs, rewards, dones, infos), (obs_, rewards_, dones_, infos_) in zip(one, other, strict=True):
        np.testing.assert_array_equal(obs, obs_, strict=True)
        np.testing.assert_array_equal(rewards, rewards_, strict=True)
        np.testing.assert_array_equal(dones, dones_, strict=True)
        np.testing.assert_equal(infos, infos_)


@pytest.mark.parametrize("name", MUJOCO + OTHERS)
def test_a_restored_environment_continues_bit_for_bit(name):
    env = build(name)
    env.reset()
    actions = actions_for(env, 100)
    run(env, actions[:27])
    state = pickle.loads(pickle.dumps(save_state(env)))
    expected = run(env, actions[27:])
    other = build(name, seed=99)
    other.reset()
    run(other, actions[:5])
    for _ in range(2):  # the snapshot survives its use
        restore_state(other, state)
        assert_same(run(other, actions[27:]), expected)


def test_saving_does_not_disturb_the_run():
    one, other = build("Hopper-v5"), build("Hopper-v5")
    one.reset(), other.reset()
    for action in actions_for(one, 30):
        save_state(one)
        assert_same(run(one, [action]), run(other, [action]))


def test_an_environment_that_was_never_reset_continues_without_a_reset():
    env = build("Pendulum-v1")
    env.reset()
    actions = actions_for(env, 60)
    run(env, actions[:10])
    state = save_state(env)
    fresh = build("Pendulum-v1", seed=5)
    restore_state(fresh, state)
    assert_same(run(fresh, actions[10:]), run(env, actions[10:]))


def test_the_state_right_after_seeding_holds_the_seeds():
    env = build("Pendulum-v1", seed=3)
    env.seed(7)
    state = save_state(env)
    first = env.reset()
    other = build("Pendulum-v1", seed=4)
    restore_state(other, state)
    np.testing.assert_array_equal(other.reset(), first)


def test_running_statistics_and_wrappers_of_the_vec_env():
    def make():
        return VecNormalize(VecMonitor(DummyVecEnv([lambda: gym.make("Pendulum-v1", max_episode_steps=17)] * 2)))

    env = make()
    env.seed(0)
    env.reset()
    actions = actions_for(env, 90)
    run(env, actions[:30])
    state = pickle.loads(pickle.dumps(save_state(env)))
    expected = run(env, actions[30:])
    other = make()
    other.reset()
    shared = other.obs_rms, other.ret_rms
    restore_state(other, state)
    assert (other.obs_rms, other.ret_rms) == shared  # the very objects: the target's wrapper shares them
    np.testing.assert_array_equal(other.get_original_reward(), state["vec_wrappers"][0]["values"]["old_reward"])
    assert_same(run(other, actions[30:]), expected)
    np.testing.assert_array_equal(other.returns, env.returns)
    np.testing.assert_array_equal(other.obs_rms.mean, env.obs_rms.mean)


def test_wrappers_with_a_known_state():
    def make():
        env = gym.make("Pendulum-v1", max_episode_steps=17)
        env = wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        env = wrappers.RecordEpisodeStatistics(wrappers.ClipAction(env), stats_key="statistics")
        return DummyVecEnv([lambda: Monitor(env)])

    env, other = make(), make()
    env.seed(0)
    env.reset(), other.reset()
    actions = actions_for(env, 90)
    run(env, actions[:25])
    state = save_state(env)

    def outcome(vec_env):
        steps = run(vec_env, actions[25:])
        for *_, infos in steps:
            infos[0].pop("statistics", None)  # it holds a clock
        monitor = vec_env.envs[0]
        return steps, monitor.episode_returns, monitor.total_steps, list(monitor.env.return_queue)

    expected = outcome(env)
    restore_state(other, state)
    found = outcome(other)
    assert_same(found[0], expected[0])
    assert found[1:] == expected[1:]


def test_environments_that_offer_their_state():
    def make(seed):
        env = DummyVecEnv([lambda: wrappers.TimeLimit(ContinuousCartPoleEnv(), 20)] * 1)
        env.seed(seed)
        env.reset()
        return env

    env, other = make(0), make(1)
    actions = actions_for(env, 100)
    run(env, actions[:30])
    state = pickle.loads(pickle.dumps(save_state(env)))
    restore_state(other, state)
    assert_same(run(other, actions[30:]), run(env, actions[30:]))


class Counting(gym.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.count = 0


class Stateless(gym.Wrapper):
    pass


class Custom(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.normal(size=1).astype(np.float32)
        return self.position, {}

    def step(self, action):
        self.position = self.position + action
        return self.position, 0.0, False, False, {}


def test_anything_unknown_has_no_snapshot():
    def pendulum():
        return gym.make("Pendulum-v1")

    unknown = [
        DummyVecEnv([Custom]),
        DummyVecEnv([lambda: Counting(pendulum())]),
        DummyVecEnv([pendulum, lambda: Counting(pendulum())]),
        DummyVecEnv([lambda: wrappers.NormalizeObservation(pendulum())]),
        VecCheckNan(DummyVecEnv([pendulum])),
        type("Subclass", (DummyVecEnv,), {})([pendulum]),
    ]
    for env in unknown:
        env.reset()
        assert save_state(env) is None
    assert save_state(DummyVecEnv([lambda: Stateless(pendulum())])) is not None
    remote = SubprocVecEnv([pendulum], start_method="fork")
    assert save_state(remote) is None
    assert copy_env(remote) is None
    remote.close()


def test_a_state_of_another_build_is_refused_and_changes_nothing():
    env = build("Pendulum-v1")
    env.reset()
    state = save_state(env)
    others = [build("Pendulum-v1", n_envs=1), build("MountainCarContinuous-v0"), VecNormalize(build("Pendulum-v1"))]
    others.append(DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2))
    for other in others:
        other.reset()
        before = pickle.dumps(save_state(other))
        with pytest.raises(ValueError, match="not built like"):
            restore_state(other, state)
        assert pickle.dumps(save_state(other)) == before


def test_another_mujoco_model_is_refused(tmp_path):
    need("Hopper-v5")
    env = build("Hopper-v5")
    path = tmp_path / "hopper.xml"
    source = gym.make("Hopper-v5").unwrapped.fullpath
    path.write_text(
        Path(source)
        .read_text()
        .replace("</worldbody>", '<body><joint type="hinge" range="-1 1"/><geom size=".1"/></body></worldbody>')
    )
    other = make_vec_env("Hopper-v5", n_envs=2, env_kwargs={"xml_file": str(path), "max_episode_steps": 40})
    with pytest.raises(ValueError, match="kind of simulation"):
        restore_state(other, save_state(env))


# --- trial copies -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Hopper-v5", "InvertedDoublePendulum-v5", "Ant-v5", "Pendulum-v1"])
def test_a_copy_steps_like_the_original_and_apart_from_it(name, tmp_path):
    need(name)
    env = DummyVecEnv([lambda: Monitor(gym.make(name), str(tmp_path / "log"))])
    if name in MUJOCO:  # a change that the constructor's arguments do not tell
        env.envs[0].unwrapped.model.body_mass[1] *= 1.7
    env.seed(0)
    env.reset()
    actions = actions_for(env, 30)
    run(env, actions[:3])
    before = pickle.dumps(save_state(env))
    copies = copy_env(env), copy_env(VecNormalize(env))
    for copy in copies:
        copy.reset()
        for action in actions[10:]:
            *_, terminated, truncated, _ = copy.step(action[0])
            if terminated or truncated:
                copy.reset()
    assert pickle.dumps(save_state(env)) == before
    if name in MUJOCO:
        assert copies[0].unwrapped.model is not env.envs[0].unwrapped.model
    copies = copy_env(env), copy_env(env)
    log = (tmp_path / "log.monitor.csv").read_text()
    answers = [[copy.step(action[0])[:4] for action in actions[10:12]] for copy in copies]
    assert (tmp_path / "log.monitor.csv").read_text() == log
    expected = [env.envs[0].step(action[0])[:4] for action in actions[10:12]]
    np.testing.assert_equal(answers, [expected, expected])


def test_what_cannot_be_copied_gives_none():
    env = DummyVecEnv([Custom])
    env.envs[0].stream = (number for number in range(3))
    assert copy_env(env) is None


class OldReset(gym.Env):
    observation_space, action_space = Custom.observation_space, Custom.action_space

    def reset(self):
        return np.zeros(1, np.float32), {}


class Keywords(gym.Wrapper):
    def reset(self, **kwargs):
        return self.env.reset(**kwargs)


class OwnSeed(gym.Wrapper):
    def reset(self, *, seed=None, options=None):
        return self.env.reset()


def test_whether_reset_takes_a_seed():
    assert accepts_seed(gym.make("Pendulum-v1"))
    assert accepts_seed(Monitor(Keywords(gym.make("Pendulum-v1"))))
    assert accepts_seed(OwnSeed(OldReset()))
    assert not accepts_seed(OldReset())
    assert not accepts_seed(Monitor(Keywords(OldReset())))
    assert not accepts_seed(wrappers.TimeLimit(OldReset(), 5))


class Moved(InvertedPendulumEnv):
    """Its own state beside the simulation's; its class's ``set_state`` takes positions and velocities."""

    goal = 0.0

    def step(self, action):
        observation, _, *rest = super().step(action)
        self.goal += 1.0
        return observation, self.goal, *rest

    def save_state(self):
        return self.goal, self.data.qpos.copy(), self.data.qvel.copy(), self.np_random.bit_generator.state

    def restore_state(self, state):
        self.goal = state[0]
        self.set_state(state[1], state[2])
        self.np_random.bit_generator.state = state[3]


def test_a_mujoco_environment_of_ones_own_saves_its_state_by_names_that_mujocoenv_has_not():
    def make():
        env = make_vec_env(lambda: wrappers.TimeLimit(Moved(), 30), 1, seed=3)
        env.reset()
        return env

    one, other, actions = make(), make(), np.full((40, 1, 1), 0.1, dtype=np.float32)
    run(one, actions[:10])
    state = pickle.loads(pickle.dumps(save_state(one)))
    expected = run(one, actions)
    restore_state(other, state)
    assert_same(run(other, actions), expected)
