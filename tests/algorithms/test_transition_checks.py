"""What a world answers in mid-run: errors say which world and what."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from conftest import SMALL_ENSEMBLE, pendulum, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_rpto import RPO, RPTO
from sb3_rpto.algorithms.transition_checks import NotFiniteError


class Odd(gym.Wrapper):
    """Answers as it is told at its 12th step and from there on."""

    def __init__(self, env, change, at=12):
        super().__init__(env)
        self.change, self.at, self.count = change, at, 0

    def step(self, action):
        self.count += 1
        answer = super().step(action)
        return self.change(*answer) if self.count >= self.at else answer


def rewarded(reward):
    return lambda obs, _, *rest: (obs, reward, *rest)


#: What an environment may return, and what is said of it.
ODD = {
    "no reward": (rewarded(None), "as reward, what its VecEnv cannot store"),
    "two rewards": (rewarded(np.ones(2)), "as reward, what its VecEnv cannot store"),
    "a text": (rewarded("much"), "as reward, what its VecEnv cannot store"),
    "a longer observation": (lambda obs, *rest: (np.append(obs, 0.0), *rest), "as observation, what its VecEnv cannot"),
    "a shorter observation": (lambda obs, *rest: (obs[:2], *rest), "as observation, what its VecEnv cannot store"),
    "no observation": (lambda obs, *rest: (None, *rest), "as observation, what is not finite"),
    "ends of two": (lambda o, r, t, *rest: (o, r, np.ones(2), *rest), "as the end of the episode, what its VecEnv"),
    "an infinite reward": (rewarded(np.inf), "as reward, what is not finite"),
    "a reward of 1e30": (rewarded(1e30), r"returned a reward of 1e\+30 in size.*scale the rewards"),
}


@pytest.mark.parametrize("world", ["source", "target"])
@pytest.mark.parametrize("odd", ODD)
def test_an_odd_answer_is_told_with_its_world(world, odd):
    change, said = ODD[odd]
    worlds = {"source": pendulum(), "target": pendulum(12.0)}
    worlds[world] = Odd(worlds[world], change)
    model = small(RPO, worlds["source"], worlds["target"])
    with pytest.raises(ValueError, match=rf"^the {world} environment returned.*{said.removeprefix('returned')}"):
        model.learn(20, source_timesteps=0)


@pytest.mark.parametrize("world", ["source", "target"])
def test_an_odd_reset_is_told_with_its_world(world):
    class Reset(gym.Wrapper):
        def reset(self, **kwargs):
            obs, info = super().reset(**kwargs)
            return np.append(obs, 0.0), info

    worlds = {"source": pendulum(), "target": pendulum(12.0)}
    worlds[world] = Reset(worlds[world])
    with pytest.raises(ValueError, match=rf"^the {world} environment returned, as observation"):
        small(RPO, worlds["source"], worlds["target"]).learn(5, source_timesteps=0)


def test_an_error_of_the_environments_own_stays_as_it_is():
    def fails(*answer):
        raise ValueError("no connection to the robot")

    with pytest.raises(ValueError, match=r"^no connection to the robot"):
        small(RPO, pendulum(), Odd(pendulum(12.0), fails)).learn(20, source_timesteps=0)


def test_what_a_worker_returns_of_another_shape_is_told():
    def make():
        return Odd(pendulum(12.0), lambda obs, *rest: (obs[:2], *rest), at=3)

    target = SubprocVecEnv([make])
    try:
        with pytest.raises(
            ValueError, match=r"the target environment returned, as observation, an array of shape \(2,\)"
        ):
            small(RPO, pendulum(), target).learn(20, source_timesteps=0)
    finally:
        target.close()


@pytest.mark.parametrize("world", ["source", "target"])
def test_large_rewards_are_told_once_a_phase(world):
    worlds = {"source": pendulum(), "target": pendulum(12.0)}
    worlds[world] = Odd(worlds[world], rewarded(1e12), at=1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        small(RPO, worlds["source"], worlds["target"]).learn(20, source_timesteps=0)
    said = [str(w.message) for w in caught if "a reward of" in str(w.message)]
    assert len(said) == {"source": 2, "target": 1}[world]  # once before the first target step, and once beside them
    assert said[0].startswith(f"the {world} environment returned a reward of 1e+12 in size")


def test_rewards_that_are_normalised_may_be_large():
    source = VecNormalize(make_vec_env(lambda: Odd(pendulum(), rewarded(1e12), at=1)))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*a reward of")
        small(RPO, source, Odd(pendulum(12.0), rewarded(1e12), at=1)).learn(10, source_timesteps=0)


def test_a_log_of_absurd_rewards_is_named(tmp_path):
    n = 60
    rows = np.random.default_rng(0).uniform(-1, 1, (n + 1, 3)).astype(np.float32)
    arrays = {"obs": rows[:-1], "next_obs": rows[1:], "act": np.zeros((n, 1), np.float32)}
    arrays |= {"rew": np.full(n, 1e30, np.float32), "done": np.zeros(n)}
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(NotFiniteError, match=r"target_data holds a reward of 1e\+30"):
        RPTO("MlpPolicy", pendulum(), target_data=tmp_path / "log.npz", dynamics_kwargs=SMALL_ENSEMBLE)
