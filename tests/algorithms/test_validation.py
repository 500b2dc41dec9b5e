"""A zip's policy that earns less in the source than the zip remembers, and those that do not."""

import random
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit, TransformReward
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from tracking import Tracking, solved, statistics, zipped

from sb3_rpto import RPO, RTO
from sb3_rpto.algorithms.validation import doubt_returns

LOST = r"source_model earns -\d+.* in env, where its zip remembers -\d+.*normalised"


def from_zip(path, env=None, cls=RPO, **kwargs):
    env = Tracking() if env is None else env
    return cls.from_source(path, env, Tracking(shift=0.1), device="cpu", **kwargs)


@pytest.mark.parametrize("cls", [RPO, RTO])
def test_a_policy_that_saw_normalised_observations_is_told_by_what_it_earns(cls, tmp_path):
    small = {"dynamics_kwargs": {"hidden": (8,), "n_members": 2, "n_elites": 1}} if cls is RTO else {}
    with pytest.warns(UserWarning, match=LOST):
        from_zip(zipped(tmp_path, normalised=True), cls=cls, **small)


def test_so_is_one_that_was_loaded_and_one_that_saw_raw_ones(tmp_path):
    with pytest.warns(UserWarning, match=LOST):
        from_zip(SAC.load(zipped(tmp_path / "normalised", normalised=True), device="cpu"))
    with pytest.warns(UserWarning, match=f"{LOST} by other statistics than those of env's VecNormalize"):
        from_zip(zipped(tmp_path / "raw", normalised=False), statistics())


@pytest.mark.parametrize(
    ("normalised", "env", "remembered", "steps"),
    [
        (False, Tracking, -30.0, 20),
        (True, statistics, -30.0, 20),
        (False, lambda: Tracking(steps=2), -3.0, 2),  # short episodes
        (False, lambda: Tracking(steps=80), -30.0, 20),  # four times as long as in training
        (True, lambda: TimeLimit(Tracking(), 4), -30.0, 20),  # a fifth
        (True, Tracking, -140.0, 20),  # random actions earn as much
        (True, Tracking, -190.0, 20),  # it was no better then
        (True, Tracking, None, 20),  # the zip remembers nothing
    ],
)
def test_other_policies_are_not_doubted(normalised, env, remembered, steps, tmp_path):
    path = zipped(tmp_path, normalised, remembered, steps=steps)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        from_zip(path, env())


@pytest.mark.parametrize("trained", [300, 900])
def test_a_policy_that_was_trained_briefly_is_not_doubted(trained, tmp_path):
    SAC("MlpPolicy", Tracking(), seed=0, policy_kwargs={"net_arch": [8]}, device="cpu", batch_size=16).learn(
        trained
    ).save(tmp_path / "model.zip")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        from_zip(tmp_path / "model.zip")


def test_returns_are_those_of_the_monitor():
    """What a wrapper outside makes of the rewards is no matter of it."""
    sac = solved(normalised=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not doubt_returns(sac, TransformReward(Monitor(Tracking()), lambda r: r - 10))
    with pytest.warns(UserWarning, match=LOST):
        assert doubt_returns(sac, TransformReward(Tracking(), lambda r: r - 10))


class Global(Tracking):
    """It draws from everybody's random numbers, too."""

    def _draw(self):
        np.random.random()
        random.random()
        return super()._draw()


def test_neither_the_source_nor_a_random_stream_moves(tmp_path):
    venv = DummyVecEnv([Global])
    venv.seed(3)
    venv.reset()
    base, sac = venv.envs[0].unwrapped, solved(normalised=True)
    before = base.hidden, base.taken, base.np_random.bit_generator.state
    drawn = random.getstate(), np.random.get_state()[1].copy(), th.get_rng_state()
    with pytest.warns(UserWarning, match=LOST):
        assert doubt_returns(sac, venv)
    assert (base.hidden, base.taken, base.np_random.bit_generator.state) == before
    assert random.getstate() == drawn[0]
    np.testing.assert_array_equal(np.random.get_state()[1], drawn[1])
    assert th.equal(th.get_rng_state(), drawn[2])
    with pytest.warns(UserWarning, match=LOST):
        assert from_zip(zipped(tmp_path, normalised=True)).source_timesteps == 0


class Broken(Tracking):
    """Its copies fail."""

    def __deepcopy__(self, memo):
        raise TypeError("one of a kind")


class Stops(Tracking):
    """It steps no more than its first owner wants."""

    def step(self, action):
        raise OSError("the machine is off")


@pytest.mark.parametrize("env", [Broken, Stops, lambda: gym.make("Pendulum-v1")])
def test_nothing_is_claimed_of_a_source_that_cannot_be_played(env):
    env = env()
    if isinstance(env, Broken):
        env.lock = (n for n in ())
    assert not doubt_returns(solved(normalised=True), env)
