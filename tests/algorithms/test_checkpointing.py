"""A checkpoint is complete: resuming equals not having stopped."""

import base64
import contextlib
import io
import json
import os
import pickle
import tempfile
import threading
import warnings
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import OURS, PHI_0_STEPS, SMALL_ENSEMBLE, SMALL_POLICY, pendulum, small
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms import pretraining, rto
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.pdml import PDML
from sb3_rpto.baselines.ptp import PTP
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.buffers import chronological
from sb3_rpto.callbacks import KeepBest
from sb3_rpto.dynamics.ensemble import EnsembleDynamics
from sb3_rpto.effects import declare
from sb3_rpto.effects.model_numbers import numbers
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.task_rules import task_rules


def states(model):
    """Of all modules and optimizers."""
    own = {name: recursive_getattr(model, name).state_dict() for name in model.own_states()}
    return {**model.get_parameters(), **own}


def assert_same(a, b):
    assert states(a).keys() == states(b).keys()
    for name, value in states(a).items():
        flat_a, flat_b = _leaves(value), _leaves(states(b)[name])
        assert len(flat_a) == len(flat_b)
        for x, y in zip(flat_a, flat_b):
            assert x == y if not th.is_tensor(x) else th.equal(x, y), name
    for world in ("source", "target"):
        ours, theirs = (chronological(model.replay_buffer.side(world)) for model in (a, b))
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=f"{world} {name}")
    assert a.state == b.state
    for counter in ("num_timesteps", "_n_updates", "_episode_num"):
        assert getattr(a, counter) == getattr(b, counter), counter
    assert a.temperature() == b.temperature()


def _leaves(tree):
    if isinstance(tree, dict):
        return [leaf for key in sorted(tree, key=str) for leaf in _leaves(tree[key])]
    if isinstance(tree, list | tuple):
        return [leaf for item in tree for leaf in _leaves(item)]
    return [tree]


def cartpole(**constants):
    return gym.make("rpto/ContinuousCartPole-v0", **constants)


def double_pendulum():
    return gym.make("InvertedDoublePendulum-v5")


def long_pole():
    env = double_pendulum()
    return apply_effects(env, [d.with_values(1.2 * d.values) for d in declare(env.unwrapped.model, ["pole.length"])])


def hopper(gravity: float = -9.81):
    env = gym.make("Hopper-v5")
    env.unwrapped.model.opt.gravity[2] = gravity
    return env


CASES = {
    "rpo-pendulum": (RPO, pendulum, lambda: pendulum(12.0), {}),
    "rto-pendulum": (RTO, pendulum, lambda: pendulum(12.0), {}),
    "rpto-pendulum": (RPTO, pendulum, lambda: pendulum(12.0), {}),
    "rpo-mujoco": (RPO, hopper, lambda: hopper(-12.0), {}),
    "rpto-physical": (RPTO, cartpole, lambda: cartpole(pole_length=2.0), {"dynamics": "physical"}),
    "rpto-physical-mujoco": (
        RPTO,
        double_pendulum,
        long_pole,
        {
            **{"dynamics": "physical", "declared": ["pole.length"], "model_train_freq": 40},
            "dynamics_kwargs": {"randomise": 1.0, "threads": 1},
        },
    ),
    "rpto-residual": (
        RPTO,
        double_pendulum,
        long_pole,
        {
            **{"dynamics": "residual", "declared": ["cart.mass"], "model_train_freq": 40},
            "dynamics_kwargs": {"ensemble_kwargs": SMALL_ENSEMBLE, "threads": 1},
        },
    ),
    "rpto-gsde": (RPTO, pendulum, lambda: pendulum(12.0), {"use_sde": True}),
    "rpo-normalised": (
        RPO,
        lambda: VecNormalize(make_vec_env(pendulum, n_envs=2, seed=3)),
        lambda: make_vec_env(lambda: pendulum(12.0), n_envs=2, seed=4),
        {},
    ),
    "physical-normalised": (
        RPTO,
        lambda: VecNormalize(make_vec_env(cartpole, n_envs=2, seed=3)),
        lambda: cartpole(pole_length=2.0),
        {"dynamics": "physical"},
    ),
}


#: Others go through the same code.
SLOW_CASES = (
    "rpo-pendulum",
    "rto-pendulum",
    "rpto-physical",
    "rpto-physical-mujoco",
    "rpo-mujoco",
    "rpto-residual",
    "rpto-gsde",
    "physical-normalised",
    "rpo-normalised",
)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow if case in SLOW_CASES else ()) for case in CASES]
)
def test_resuming_equals_not_having_stopped(case, tmp_path):
    cls, source, target, kwargs = CASES[case]

    def fresh():
        return small(cls, source(), target(), **kwargs).learn(70, source_timesteps=40)

    unbroken = fresh()
    unbroken.learn(60, reset_num_timesteps=False)

    stopped = fresh()
    stopped.save(tmp_path / "model")
    stopped.save_replay_buffer(tmp_path / "buffer")
    if isinstance(stopped.env, VecNormalize):
        stopped.env.save(tmp_path / "statistics.pkl")
    del stopped
    env = source()
    if isinstance(env, VecNormalize):
        env = VecNormalize.load(tmp_path / "statistics.pkl", env.venv)
    resumed = cls.load(tmp_path / "model", env=env, target_env=target(), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    resumed.learn(60, reset_num_timesteps=False)
    assert resumed.num_timesteps in (130, 130 - 130 % 2)
    assert_same(unbroken, resumed)


def test_a_save_that_is_interrupted_leaves_the_model_as_it_was(tmp_path, monkeypatch):
    model = small(RPO).learn(20, source_timesteps=0)

    def interrupted(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(rto, "picklable", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.save(tmp_path / "model")
    model.learn(20, reset_num_timesteps=False)
    assert model.replay_buffer.target.size() == model.num_timesteps == 40


def test_the_weights_of_a_fit_do_not_hang_on_what_explored_last():
    model, weights = small(RPTO, use_sde=True).learn(30, source_timesteps=0), []
    for explored in (1, 2):
        th.manual_seed(explored)
        model.actor.reset_noise(3)
        th.manual_seed(0)
        weights.append(model.fit_weights(model.transitions("target")))
    assert th.equal(*weights)
    assert float(weights[0].std()) > 0


@pytest.mark.parametrize("with_buffers", [True, False])
def test_a_run_that_goes_on_without_its_buffers_is_told(with_buffers, tmp_path):
    model = small(RPO).learn(20, source_timesteps=0)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    resumed = RPO.load(tmp_path / "model", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    if with_buffers:
        resumed.load_replay_buffer(tmp_path / "buffer")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        resumed.learn(3, reset_num_timesteps=False)
    assert any("goes on without its replay buffers" in str(one.message) for one in told) == (not with_buffers)


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs CUDA")
def test_resuming_on_a_gpu_draws_the_numbers_that_were_next(tmp_path):
    model = small(RPTO, device="cuda").learn(30, source_timesteps=0)
    model.save(tmp_path / "model")
    expected = th.rand(5, device="cuda")
    resumed = RPTO.load(tmp_path / "model", env=pendulum(), target_env=pendulum(12.0), device="cuda")
    resumed.replay_buffer = model.replay_buffer
    drawn = []
    resumed.learn(1, NextNumbers(drawn), reset_num_timesteps=False)
    assert th.equal(drawn[0], expected)


class NextNumbers(BaseCallback):
    """What the GPU's stream gives as learning begins."""

    def __init__(self, drawn):
        super().__init__()
        self.drawn = drawn

    def _on_training_start(self):
        self.drawn.append(th.rand(5, device="cuda"))


@pytest.mark.parametrize("cls", OURS)
def test_saving_a_loaded_model_again_keeps_where_it_stood(cls, tmp_path):
    def resumed(name):
        model = cls.load(tmp_path / name, env=pendulum(), target_env=pendulum(12.0), device="cpu")
        model.load_replay_buffer(tmp_path / "buffer.pkl")
        return model

    model = small(cls).learn(50, source_timesteps=0)
    model.save(tmp_path / "first.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    again = resumed("first.zip")
    again.save(tmp_path / "second.zip")
    runs = [resumed("first.zip"), again, resumed("second.zip")]
    for run in runs:
        run.learn(30, reset_num_timesteps=False)
    assert_same(runs[0], runs[1])
    assert_same(runs[0], runs[2])


def test_a_world_that_is_built_otherwise_begins_a_new_episode(tmp_path):
    small(RPO).learn(30, source_timesteps=0).save(tmp_path / "model.zip")
    wrapped = gym.wrappers.RescaleAction(pendulum(12.0), -2.0, 2.0)
    model = RPO.load(tmp_path / "model.zip", env=pendulum(), target_env=wrapped)
    with pytest.warns(UserWarning, match="target environment cannot be restored"):
        model.learn(10, reset_num_timesteps=False)
    assert model.num_timesteps == 40


def test_a_model_that_is_saved_before_it_learns_resumes_all_the_same(tmp_path):
    SAC("MlpPolicy", pendulum(), seed=3, policy_kwargs=SMALL_POLICY, buffer_size=10).save(tmp_path / "sac")
    model = RPO.from_source(tmp_path / "sac", pendulum(), pendulum(12.0), seed=0, device="cpu", batch_size=32)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "m.pkl")
    model.learn(20)
    th.rand(7)  # whatever happens between
    again = RPO.load(tmp_path / "m", pendulum(), target_env=pendulum(12.0), device="cpu")
    again.load_replay_buffer(tmp_path / "m.pkl")
    np.random.seed(5)
    again.learn(20, reset_num_timesteps=False)
    assert_same(model, again)


def test_source_steps_count_as_they_are_taken(monkeypatch):
    model, step = small(RPO), PendulumEnv.step
    taken = []

    def interrupted(self, action):
        taken.append(action)
        if len(taken) == 30:
            raise KeyboardInterrupt
        return step(self, action)

    with monkeypatch.context() as patch:
        patch.setattr(PendulumEnv, "step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(20, source_timesteps=0)
    assert model.source_timesteps == model.replay_buffer.source.size() == 29
    model.learn(20, source_timesteps=0, reset_num_timesteps=False)
    assert model.source_timesteps == PHI_0_STEPS + 20 * 8


@pytest.mark.parametrize("cls", OURS)
def test_a_checkpoint_alone_can_predict(cls, tmp_path):
    model = small(cls).learn(60, source_timesteps=0)
    model.save(tmp_path / "model.zip")
    loaded = cls.load(tmp_path / "model.zip", device="cpu")
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_array_equal(
        model.predict(observations, deterministic=True)[0], loaded.predict(observations, deterministic=True)[0]
    )
    assert loaded.target_env is None
    with pytest.raises(ValueError, match="env="):
        loaded.learn(10)
    loaded.set_env(pendulum())
    with pytest.raises(ValueError, match="target"):
        loaded.learn(10)
    loaded.set_target_env(pendulum(12.0))
    loaded.learn(10, source_timesteps=0)


def test_the_dynamics_come_back_whole(tmp_path):
    model = small(RPTO).learn(120, source_timesteps=0)
    model.save(tmp_path / "model.zip")
    loaded = RPTO.load(tmp_path / "model.zip", device="cpu")
    before, after = model.dynamics.state_dict(), loaded.dynamics.state_dict()
    assert before.keys() == after.keys()
    for name in before:
        if th.is_tensor(before[name]):
            assert th.equal(before[name], after[name]), name
    assert loaded.dynamics.fitted
    assert any("std" in name for name in before)


def test_the_corrected_simulator_comes_back(tmp_path):
    model = small(RPTO, cartpole(), cartpole(pole_length=1.3), dynamics="physical", declared=["pole_length", "gravity"])
    model.learn(200, source_timesteps=50)
    assert model.dynamics.describe()["pole_length"] > 1.02
    model.save(tmp_path / "model.zip")
    assert RPTO.load(tmp_path / "model.zip").dynamics.constants == model.dynamics.constants


def test_an_untrained_model_is_still_untrained_after_loading(tmp_path):
    model = small(RPO)
    model.save(tmp_path / "fresh.zip")
    loaded = RPO.load(tmp_path / "fresh.zip", env=pendulum(), target_env=pendulum(12.0))
    loaded.learn(5, source_timesteps=60)
    assert loaded.state.pretraining_timesteps == 60


def test_a_killed_source_phase_goes_on_from_its_checkpoint(tmp_path):
    from stable_baselines3.common.logger import configure

    class Killed(gym.Wrapper):
        steps = 0

        def step(self, action):
            self.steps += 1
            if self.steps == 200:
                raise KeyboardInterrupt
            return super().step(action)

    model = small(RPO, Killed(pendulum()))
    model.set_logger(configure(str(tmp_path), []))
    with pytest.raises(KeyboardInterrupt):
        model.learn(5, source_timesteps=300)
    resumed = RPO.load(tmp_path / "pretrain.zip", env=pendulum(), target_env=pendulum(12.0))
    resumed.load_replay_buffer(tmp_path / "pretrain_replay_buffer.pkl")
    done = resumed.state.pretraining_timesteps
    assert 0 < done < 300
    assert resumed.replay_buffer.source.size() == done
    resumed.learn(5, source_timesteps=300)
    assert resumed.state.pretraining_timesteps == 300
    forgetful = RPO.load(tmp_path / "pretrain.zip", env=pendulum(), target_env=pendulum(12.0))
    held, train = [], forgetful.train
    forgetful.train = lambda *args: held.append(forgetful.replay_buffer.source.size()) or train(*args)
    with pytest.warns(UserWarning, match="the source phase goes on without its replay buffers"):
        forgetful.learn(5, source_timesteps=300)
    assert held[0] == forgetful.learning_starts + 1


def test_a_source_phase_leaves_nothing_where_no_folder_was_given(tmp_path, monkeypatch):
    monkeypatch.delenv("SB3_LOGDIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    model = small(RPO).learn(5, source_timesteps=60)
    assert model.logger.dir.startswith(str(tmp_path))  # SB3's own, for nobody
    assert not list(tmp_path.rglob("pretrain*"))


@pytest.mark.parametrize("how", ["set_random_seed", "load"])
def test_a_seed_that_is_given_after_loading_counts(how, tmp_path):
    model = small(RPO).learn(10, source_timesteps=60)
    model.save(tmp_path / "m.zip")
    model.save_replay_buffer(tmp_path / "m.pkl")

    def branch(seed):
        given = {"seed": seed} if how == "load" and seed is not None else {}
        loaded = RPO.load(tmp_path / "m.zip", pendulum(), target_env=pendulum(12.0), **given)
        loaded.load_replay_buffer(tmp_path / "m.pkl")
        if how != "load" and seed is not None:
            loaded.set_random_seed(seed)
        return loaded.learn(10, reset_num_timesteps=False)

    one, again, other, none, none_again = map(branch, (1, 1, 2, None, None))
    assert_same(one, again)
    assert_same(none, none_again)
    for different in (other, none):
        with pytest.raises(AssertionError):
            assert_same(one, different)


@pytest.mark.slow
def test_branches_of_a_checkpoint_see_other_resets(tmp_path):
    small(RPO, source_steps=2).learn(20, source_timesteps=60).save(tmp_path / "m")

    def branch(seed):
        loaded = RPO.load(tmp_path / "m", pendulum(), target_env=pendulum(12.0), seed=seed)
        loaded.learn(200, reset_num_timesteps=False)  # an episode of the target lasts 200 steps
        ends = np.flatnonzero(loaded.replay_buffer.target.dones[:199, 0])
        source_ends = np.flatnonzero(loaded.replay_buffer.source.dones[:399, 0])
        assert len(ends)
        assert len(source_ends)
        worlds = ((loaded.replay_buffer.target, ends), (loaded.replay_buffer.source, source_ends))
        return [buffer.observations[rows + 1, 0] for buffer, rows in worlds]

    for one, other in zip(branch(1), branch(2)):
        assert len(one) == len(other)
        assert (one != other).any(axis=1).all()


@pytest.mark.slow
def test_a_randomised_simulator_draws_anew_for_a_new_seed(tmp_path):
    cls, source, target, kwargs = CASES["rpto-physical-mujoco"]
    model = small(cls, source(), target(), **kwargs).learn(60, source_timesteps=40)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "m.pkl")

    def drawn(**seed):
        loaded = cls.load(tmp_path / "m", source(), target_env=target(), **seed)
        loaded.load_replay_buffer(tmp_path / "m.pkl")
        loaded.learn(1, reset_num_timesteps=False)
        return loaded.rollouts._rng.random()

    assert drawn() == drawn()
    assert len({drawn(), drawn(seed=1), drawn(seed=2)}) == 3


def test_a_seed_given_on_load_outlives_being_saved_anew(tmp_path):
    model = small(RPO).learn(10, source_timesteps=60)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "m.pkl")
    seeded = RPO.load(tmp_path / "m", pendulum(), target_env=pendulum(12.0), seed=2)
    seeded.save(tmp_path / "seeded")
    again = RPO.load(tmp_path / "seeded", pendulum(), target_env=pendulum(12.0))
    unseeded = RPO.load(tmp_path / "m", pendulum(), target_env=pendulum(12.0))
    for one in (unseeded, seeded, again):
        one.load_replay_buffer(tmp_path / "m.pkl")
        one.learn(10, reset_num_timesteps=False)
    assert_same(seeded, again)
    with pytest.raises(AssertionError):
        assert_same(unseeded, again)


def test_a_new_run_of_a_checkpoint_has_its_statistics(tmp_path):
    def source():
        return VecNormalize(make_vec_env(pendulum, seed=3))

    model = small(RPO, source()).learn(20, source_timesteps=100)
    model.save(tmp_path / "m")
    begun = RPO.load(tmp_path / "m", env=source(), target_env=pendulum(12.0)).learn(5)
    assert begun.num_timesteps == 5
    assert begun.env.obs_rms.count > model.env.obs_rms.count


def test_a_new_run_of_a_callbacks_checkpoint_keeps_its_last_step(tmp_path):
    callback = CheckpointCallback(15, str(tmp_path), "m", save_replay_buffer=True)
    whole = small(RPO).learn(20, callback, source_timesteps=60)
    loaded = RPO.load(tmp_path / "m_15_steps", pendulum(), target_env=pendulum(12.0))
    loaded.load_replay_buffer(tmp_path / "m_replay_buffer_15_steps.pkl")
    assert loaded.replay_buffer.target.size() == 14
    loaded.learn(5)
    assert loaded.replay_buffer.target.size() == 20
    for name in ("observations", "next_observations", "actions", "rewards"):
        kept, had = (getattr(m.replay_buffer.target, name)[:15] for m in (loaded, whole))
        np.testing.assert_array_equal(kept, had)


#: SLBO's model is no ensemble.
NETWORK = {SLBO: {"dynamics_kwargs": {"hidden": (16,)}}}
#: Settings of models whose zips SB3's SAC takes, by algorithm.
FOR_SAC = [
    (RPO, {}),
    (RTO, {}),
    (RPTO, {"replay_buffer_kwargs": {"target_size": 500}, "train_freq": (1, "episode"), "ent_coef": 0.2}),
    (RPTO, {"use_sde": True, "action_noise": NormalActionNoise(np.zeros(1), np.ones(1))}),
    (PTP, {}),
]


@pytest.mark.parametrize(("cls", "given"), FOR_SAC)
@pytest.mark.parametrize("by", ["load", "to_sac"])
def test_sb3s_sac_takes_the_zip_predicts_alike_and_learns_on(cls, given, by, tmp_path):
    model = small(cls, **given).learn(5, source_timesteps=60)
    model.save(tmp_path / "m")
    if by == "to_sac":
        model.to_sac().save(tmp_path / "m")
    sac = SAC.load(tmp_path / "m", env=pendulum(), device="cpu")
    assert type(sac) is SAC
    seen = np.stack([pendulum().reset(seed=i)[0] for i in range(9)])
    np.testing.assert_array_equal(*(m.predict(seen, deterministic=True)[0] for m in (model, sac)))
    for name, state in sac.get_parameters().items():
        for x, y in zip(_leaves(state), _leaves(model.get_parameters()[name]), strict=True):
            assert x == y if not th.is_tensor(x) else th.equal(x, y), name
    assert float(sac.ent_coef_tensor if sac.log_ent_coef is None else sac.log_ent_coef.exp()) == pytest.approx(
        float(model.temperature())
    )
    updates = sac._n_updates
    sac.learning_starts = 0
    sac.learn(sac.num_timesteps + 250)
    assert sac._n_updates > updates
    assert sac.replay_buffer.size() >= 200


def test_a_plain_sacs_zip_holds_nothing_of_this_package(tmp_path):
    model = small(RPTO).learn(5, source_timesteps=60)
    model.to_sac().save(tmp_path / "plain")
    with zipfile.ZipFile(tmp_path / "plain.zip") as archive:
        entries = json.loads(archive.read("data"))
    pickles = [
        base64.b64decode(v[":serialized:"]) for v in entries.values() if isinstance(v, dict) and ":serialized:" in v
    ]
    assert pickles
    assert not any(b"sb3_rpto" in text for text in pickles)


def test_what_sb3_leaves_alone_in_the_zip_comes_back(tmp_path):
    given = {"replay_buffer_kwargs": {"target_size": 500}}
    model = small(RPTO, **given).learn(5, source_timesteps=60)
    for place in (tmp_path / "m.zip", io.BytesIO()):
        model.save(place)
        if not isinstance(place, Path):
            place.seek(0)
        loaded = RPTO.load(place, device="cpu")
        assert loaded.replay_buffer.target.buffer_size == 500
        assert loaded.replay_buffer_kwargs == model.replay_buffer_kwargs == given["replay_buffer_kwargs"]
        for name in ("dynamics", "dynamics.optimizer"):
            for x, y in zip(_leaves(states(loaded)[name]), _leaves(states(model)[name]), strict=True):
                assert x == y if not th.is_tensor(x) else th.equal(x, y), name
    with (tmp_path / "written.zip").open("wb") as file:  # which cannot be read
        model.save(file)
    assert RPTO.load(tmp_path / "written.zip").dynamics.fitted
    other = small(RPTO, seed=1)
    other.set_parameters(tmp_path / "m.zip")
    assert th.equal(other.dynamics.input_mean, model.dynamics.input_mean)


class Runs:
    """A pickle of it makes a folder when it is read."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("ent_coef", ["auto", 0.3])
def test_a_strangers_weights_are_read_without_running_a_pickle(ent_coef, tmp_path):
    given = {"policy_kwargs": {"net_arch": [8, 4]}, "gamma": 0.9, "ent_coef": ent_coef, "device": "cpu"}
    sac = SAC("MlpPolicy", pendulum(), learning_starts=10, seed=0, **given).learn(30)
    sac.evil = Runs(tmp_path / "ran")
    sac.save(tmp_path / "sac")
    model = RPO.from_source(tmp_path / "sac.zip", pendulum(), pendulum(12.0), weights_only=True, device="cpu")
    assert not (tmp_path / "ran").exists()
    assert (model.gamma, model.policy_kwargs["net_arch"]) == (0.9, [8, 4])
    assert float(model.temperature()) == pytest.approx(
        float(sac.log_ent_coef.detach().exp() if ent_coef == "auto" else ent_coef)
    )
    for name, value in sac.policy.state_dict().items():
        assert th.equal(value, model.policy.state_dict()[name]), name
    assert model.actor.optimizer.state_dict()["state"][0]["step"] == sac._n_updates
    RPO.from_source(tmp_path / "sac.zip", pendulum(), pendulum(12.0), device="cpu")
    assert (tmp_path / "ran").exists()  # as one that reads the pickles does


def test_what_only_a_pickle_tells_of_a_policy_is_asked_for(tmp_path):
    kwargs = {"net_arch": [8], "activation_fn": th.nn.Tanh}
    SAC("MlpPolicy", pendulum(), policy_kwargs=kwargs, device="cpu").save(tmp_path / "sac")
    worlds = (pendulum(), pendulum(12.0))
    with pytest.raises(ValueError, match=r"policy_kwargs as a pickle.*pass policy_kwargs="):
        RPO.from_source(tmp_path / "sac.zip", *worlds, weights_only=True)
    with pytest.raises(ValueError, match=r"other networks than policy_kwargs=\{'net_arch': \[9\]\}"):
        RPO.from_source(tmp_path / "sac.zip", *worlds, weights_only=True, policy_kwargs={"net_arch": [9]})
    model = RPO.from_source(tmp_path / "sac.zip", *worlds, weights_only=True, policy_kwargs=kwargs)
    assert model.policy_kwargs["activation_fn"] is th.nn.Tanh
    TD3("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [8]}).save(tmp_path / "td3")
    with pytest.raises(ValueError, match=r"td3\.zip' is not the zip of a SAC"):
        RPO.from_source(tmp_path / "td3.zip", *worlds, weights_only=True)
    with pytest.raises(TypeError, match="must be the path of a zip where weights_only=True, not SAC"):
        RPO.from_source(SAC("MlpPolicy", pendulum()), *worlds, weights_only=True)


def test_a_zip_of_rpto_is_a_source_model_and_slbos_is_not(tmp_path):
    model = small(RPTO)
    model.save(tmp_path / "rpto")
    made = RPO.from_source(tmp_path / "rpto.zip", pendulum(), pendulum(12.0), device="cpu")
    seen = pendulum().reset(seed=0)[0]
    np.testing.assert_array_equal(*(m.predict(seen, deterministic=True)[0] for m in (model, made)))
    slbo = small(SLBO, **NETWORK[SLBO])
    slbo.save(tmp_path / "slbo")
    with pytest.raises(ValueError, match=r"not the zip of a SAC \(it is an SLBO's, which acts by TRPO's policy"):
        RPO.from_source(tmp_path / "slbo.zip", pendulum())
    with pytest.raises(NotImplementedError, match=r"SLBO acts by TRPO's policy.*SLBO\.load"):
        slbo.to_sac()


def test_files_and_arguments_that_load_cannot_take_are_named(tmp_path):
    model = small(RPO).learn(10, source_timesteps=60)
    model.save(tmp_path / "m.zip")
    with pytest.raises(ValueError, match="pass a target by name, as target_env="):
        RPO.load(tmp_path / "m", pendulum(), pendulum(12.0))
    kept = model.replay_buffer
    with pytest.raises(ValueError, match=r"m.zip is no replay buffer; pass what save_replay_buffer\(\) wrote"):
        model.load_replay_buffer(tmp_path / "m.zip")
    assert model.replay_buffer is kept
    (tmp_path / "statistics.pkl").write_bytes(pickle.dumps({"mean": 0.0}))
    (tmp_path / "torn.pkl").write_bytes(pickle.dumps([1.0] * 100)[:50])
    for name in ("statistics", "torn"):
        with pytest.raises(ValueError, match=rf"{name}.pkl is no replay buffer"):
            model.load_replay_buffer(tmp_path / f"{name}.pkl")
        assert model.replay_buffer is kept


@pytest.mark.parametrize("saves", [RPTO, MBPO, PTP, SLBO])
def test_a_checkpoint_goes_on_with_its_own_class(saves, tmp_path):
    class Mine(saves):
        """Of a user: a checkpoint of its parent is one of its own."""

    small(saves, **NETWORK.get(saves, {})).save(tmp_path / "m")
    for loads in (RPO, RTO, RPTO, MBPO, PTP, PDML, SLBO, Mine):
        if loads in (saves, Mine) or {loads, saves} == {RTO, RPTO}:
            assert isinstance(loads.load(tmp_path / "m"), loads)
        else:
            with pytest.raises(ValueError, match=f"was saved by .*{saves.__name__}, {loads.__name__} cannot"):
                loads.load(tmp_path / "m")


@pytest.mark.parametrize(
    ("cls", "given", "message"),
    [
        (PTP, {"n_candidates": 0}, "n_candidates must be a positive integer"),
        (PDML, {"newest_share": 1.0}, "newest_share must lie in"),
        (SLBO, {"iterations": 0}, "iterations must be a positive integer"),
        (SLBO, {"rollout_samples": 101}, "is no multiple of rollout_length"),
        (MBPO, {"weighting": "paper"}, r"MBPO does not use \['weighting'\]"),
    ],
)
def test_a_baselines_numbers_are_checked_when_it_is_loaded(cls, given, message, tmp_path):
    small(cls, **NETWORK.get(cls, {})).save(tmp_path / "m")
    with pytest.raises(ValueError, match=message):
        cls.load(tmp_path / "m", **given)


@pytest.mark.slow
def test_a_source_phase_goes_on_with_its_statistics(tmp_path, monkeypatch):
    def source():
        return VecNormalize(make_vec_env(pendulum, seed=3))

    model = small(RPO, source())
    model.set_logger(configure(str(tmp_path), []))
    train = pretraining.train_in_source
    monkeypatch.setattr(pretraining, "train_in_source", lambda model, steps, bar: train(model, steps // 2, bar))
    model.learn(5, source_timesteps=300)
    counted = model.env.obs_rms.count
    monkeypatch.undo()
    resumed = RPO.load(tmp_path / "pretrain.zip", env=source(), target_env=pendulum(12.0))
    resumed.load_replay_buffer(tmp_path / "pretrain_replay_buffer.pkl")
    assert resumed.state.pretraining_timesteps == 150
    resumed.learn(5, source_timesteps=300)
    assert resumed.env.obs_rms.count > counted + 140


class Unknown(gym.Wrapper):
    """What it holds nobody knows, so that its world begins anew."""


def normalised_unknown():
    return VecNormalize(make_vec_env(lambda: Unknown(pendulum()), seed=3))


def test_statistics_come_back_where_the_state_of_their_world_is_unknown(tmp_path):
    model = small(RPO, normalised_unknown(), pendulum(12.0)).learn(20, source_timesteps=100)
    model.save(tmp_path / "model")
    resumed = RPO.load(tmp_path / "model", env=normalised_unknown(), target_env=pendulum(12.0))
    resumed.learn(5, reset_num_timesteps=False)
    assert resumed.env.obs_rms.count > model.env.obs_rms.count
    assert resumed.env.ret_rms.count > model.env.ret_rms.count


@pytest.mark.slow
def test_a_source_phase_over_an_unknown_world_goes_on_with_its_statistics(tmp_path, monkeypatch):
    model = small(RPO, normalised_unknown())
    model.set_logger(configure(str(tmp_path), []))
    train = pretraining.train_in_source
    monkeypatch.setattr(pretraining, "train_in_source", lambda model, steps, bar: train(model, steps // 2, bar))
    model.learn(5, source_timesteps=300)
    counted = model.env.obs_rms.count
    monkeypatch.undo()
    resumed = RPO.load(tmp_path / "pretrain.zip", env=normalised_unknown(), target_env=pendulum(12.0))
    resumed.learn(5, source_timesteps=300)
    assert resumed.env.obs_rms.count > counted + 140


def test_the_buffer_of_other_environments_is_refused(tmp_path):
    small(RPO, cartpole(), cartpole(pole_length=1.3)).save_replay_buffer(tmp_path / "other")
    model = small(RPO)
    kept = model.replay_buffer
    with pytest.raises(ValueError, match=r"shapes \(\(4,\), \(1,\)\), the model's are \(\(3,\), \(1,\)\)"):
        model.load_replay_buffer(tmp_path / "other")
    assert model.replay_buffer is kept


class SaveAt(BaseCallback):
    """Save in a hook at a step."""

    def __init__(self, hook, step, path):
        super().__init__()
        self.hook, self.step, self.path = hook, step, path

    def _save(self, hook):
        if hook == self.hook and self.model.num_timesteps == self.step:
            self.model.save(self.path / "model")
            self.model.save_replay_buffer(self.path / "buffer")

    def _on_rollout_start(self):
        self._save("start")

    def _on_step(self):
        self._save("step")
        return True

    def _on_rollout_end(self):
        self._save("end")


@pytest.mark.parametrize("hook", ["start", "step", "end"])
def test_a_checkpoint_of_any_hook_resumes_as_if_never_stopped(hook, tmp_path):
    unbroken = small(RPO).learn(40, SaveAt(hook, 20, tmp_path), source_timesteps=0)
    resumed = RPO.load(tmp_path / "model", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert_same(unbroken, resumed.learn(20, reset_num_timesteps=False))


def test_a_checkpoint_of_a_run_on_recordings_resumes_as_if_never_stopped(tmp_path):
    recorded = SAC("MlpPolicy", pendulum(12.0), learning_starts=100, seed=0, device="cpu").learn(60).replay_buffer
    settings = {"policy_kwargs": SMALL_POLICY, "batch_size": 32, "source_steps": 8, "gradient_steps": 2, "seed": 0}
    few = {"dynamics_kwargs": SMALL_ENSEMBLE, "model_train_freq": 7, "device": "cpu"}
    unbroken = RPTO("MlpPolicy", pendulum(), target_data=recorded, **settings, **few)
    unbroken.learn(160, SaveAt("step", 80, tmp_path), source_timesteps=0)
    resumed = RPTO.load(tmp_path / "model", env=pendulum(), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert_same(unbroken, resumed.learn(80, reset_num_timesteps=False))


class Stop(BaseCallback):
    def __init__(self, step, error=None):
        super().__init__()
        self.step, self.error = step, error

    def _on_step(self):
        if self.num_timesteps == self.step and self.error is not None:
            raise self.error
        return self.num_timesteps != self.step


@pytest.mark.parametrize("error", [None, KeyboardInterrupt()], ids=["returns False", "raises"])
def test_a_run_that_a_callback_ended_goes_on_without_a_loss(error):
    unbroken = small(RPO).learn(40, source_timesteps=0)
    stopped = small(RPO)
    with pytest.raises(KeyboardInterrupt) if error else contextlib.nullcontext():
        stopped.learn(40, Stop(20, error), source_timesteps=0)
    stopped.learn(20, reset_num_timesteps=False)
    assert_same(unbroken, stopped)


class Opaque(gym.Wrapper):
    """Nobody knows how to save it."""

    secret = 0

    def __init__(self, env):
        super().__init__(env)
        self.secret = 1


def test_a_step_is_kept_where_the_target_cannot_be_put_back(tmp_path):
    small(RPO, target=Opaque(pendulum(12.0))).learn(30, SaveAt("step", 20, tmp_path), source_timesteps=0)
    resumed = RPO.load(tmp_path / "model", env=pendulum(), target_env=Opaque(pendulum(12.0)), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert resumed.replay_buffer.target.size() == 19
    with pytest.warns(UserWarning, match="target environment cannot be restored"):
        resumed.learn(10, reset_num_timesteps=False)
    assert resumed.replay_buffer.target.size() == resumed.num_timesteps == resumed._n_updates == 30
    side = resumed.replay_buffer.target
    assert not np.array_equal(side.next_observations[19], side.observations[20])  # a new episode


def test_another_target_knows_nothing_of_where_the_last_one_stood(tmp_path):
    small(RPO).learn(30, SaveAt("step", 20, tmp_path), source_timesteps=0)
    resumed = RPO.load(tmp_path / "model", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    resumed.set_target_env(pendulum(30.0))
    resumed.learn(5, reset_num_timesteps=False)
    side, twin = resumed.replay_buffer.target, pendulum(30.0).unwrapped
    twin.reset(seed=0)
    assert side.size() == 5
    for i in range(5):
        cosine, sine, speed = side.observations[i, 0]
        twin.state = np.array([np.arctan2(sine, cosine), speed])
        after, *_ = twin.step(2.0 * side.actions[i, 0])
        np.testing.assert_allclose(after, side.next_observations[i, 0], atol=1e-3)


@pytest.mark.slow
def test_a_world_that_cannot_restore_its_state_says_so(tmp_path):
    target = SubprocVecEnv([lambda: pendulum(12.0)])
    try:
        model = small(RPO, target=target).learn(30, source_timesteps=0)
        model.save(tmp_path / "model.zip")
        resumed = RPO.load(tmp_path / "model.zip", env=pendulum(), target_env=target)
        with pytest.warns(UserWarning, match="target environment cannot be restored"):
            resumed.learn(10, reset_num_timesteps=False)
        assert resumed.num_timesteps == 40
    finally:
        target.close()


@pytest.mark.slow
def test_a_source_of_branches_has_no_episode_to_restore(tmp_path):
    source = SubprocVecEnv([pendulum])
    try:
        small(RPTO, source, learning_starts=0).learn(30, source_timesteps=0).save(tmp_path / "model.zip")
        resumed = RPTO.load(tmp_path / "model.zip", env=source, target_env=pendulum(12.0))
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*cannot be restored")
            resumed.learn(10, reset_num_timesteps=False)
    finally:
        source.close()


@pytest.mark.parametrize("make", [cartpole, double_pendulum])
def test_another_number_of_episodes_side_by_side_begins_new_ones_and_loses_nothing(make, tmp_path):
    class SaveAt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 20:  # the step is taken and not yet stored
                self.model.save(tmp_path / "model")
                self.model.save_replay_buffer(tmp_path / "buffer")
            return self.num_timesteps < 20

    declared = ["pole_length"] if make is cartpole else ["pole.length"]
    settings = {"dynamics": "physical", "declared": declared, "policy_kwargs": SMALL_POLICY, "gradient_steps": 1}
    target = cartpole(pole_length=2.0) if make is cartpole else long_pole()
    RPTO("MlpPolicy", make(), target_env=target, source_steps=4, seed=0, **settings).learn(
        30, SaveAt(), source_timesteps=150
    )
    resumed = RPTO.load(tmp_path / "model", env=make(), target_env=target, source_steps=6, device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    with pytest.warns(UserWarning, match="the source environment cannot be restored"):
        resumed.learn(10, reset_num_timesteps=False)
    assert (resumed.num_timesteps, resumed.replay_buffer.target.size()) == (30, 30)


def test_files_are_written_whole_or_not_at_all(tmp_path):
    model = small(RPO).learn(10, source_timesteps=0)
    path = tmp_path / "model.zip"
    model.save(path)
    content = path.read_bytes()
    model.snapshots["unpicklable"] = {"policy": (i for i in range(3)), "temperature": 1.0}
    model.get_parameters = None  # type: ignore[method-assign]
    with pytest.raises(TypeError):
        model.save(path)
    assert path.read_bytes() == content
    assert [file.name for file in tmp_path.iterdir()] == ["model.zip"]


def test_a_folder_is_no_place_for_a_model(tmp_path):
    model = small(RPO)
    with pytest.raises(ValueError, match=r"is a folder; give the name of a file, such as .*model\.zip"):
        model.save(tmp_path)
    with pytest.raises(ValueError, match=r"is a folder; give the name of a file, such as .*model\.pkl"):
        model.save_replay_buffer(str(tmp_path))
    assert list(tmp_path.iterdir()) == []
    assert not tmp_path.with_name(f"{tmp_path.name}.zip").exists()


# ---------------------------------------------------------------------- warm start


@pytest.mark.parametrize(("passed", "steps"), [({"max_steps": 7}, 7), ({}, 40)])
def test_the_users_max_steps_bound_the_first_fit_too(passed, steps, monkeypatch):
    monkeypatch.setattr(pretraining, "PHI_0_UPDATES", 40)
    fitted = []
    fit = EnsembleDynamics.fit
    monkeypatch.setattr(
        EnsembleDynamics,
        "fit",
        lambda self, data, weights=None, max_steps=None: (
            fitted.append(max_steps or self.max_steps) or fit(self, data, weights, max_steps)
        ),
    )
    model = small(RPTO, dynamics_kwargs={"hidden": (8,), "n_members": 2, "n_elites": 1, **passed}, model_train_freq=5)
    model.learn(5, source_timesteps=0)
    assert fitted == [steps, passed.get("max_steps", 300)]  # the default preset's


def test_from_source_takes_everything_over(tmp_path):
    sac = SAC(
        "MlpPolicy", pendulum(), policy_kwargs=SMALL_POLICY, gamma=0.9, tau=0.02, learning_starts=20, seed=0
    ).learn(80)
    sac.save(tmp_path / "sac.zip")
    for origin in (sac, str(tmp_path / "sac.zip")):
        model = RPTO.from_source(origin, pendulum(), target_env=pendulum(12.0), gamma=0.8)
        for name, value in sac.policy.state_dict().items():
            assert th.equal(model.policy.state_dict()[name], value)
        assert model.temperature() == sac.log_ent_coef.exp()
        assert (model.gamma, model.tau) == (0.8, 0.02)
        ours, theirs = model.actor.optimizer.state_dict()["state"], sac.actor.optimizer.state_dict()["state"]
        assert all(th.equal(ours[i]["exp_avg"], theirs[i]["exp_avg"]) for i in theirs)
    model.learn(3)
    assert model.state.pretraining_timesteps == 0


@pytest.mark.parametrize("form", ["npz", "buffer", "pickle"])
def test_source_data_fit_phi_0_and_spare_the_source(form, tmp_path):
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs=SMALL_POLICY, learning_starts=200, seed=0).learn(200)
    data = sac.replay_buffer
    if form == "pickle":
        sac.save_replay_buffer(tmp_path / "data.pkl")
        data = tmp_path / "data.pkl"
    if form == "npz":
        arrays = chronological(sac.replay_buffer)
        names = {
            "obs": "observations",
            "act": "actions",
            "next_obs": "next_observations",
            "rew": "rewards",
            "done": "terminations",
        }
        np.savez(tmp_path / "data.npz", **{key: arrays[name] for key, name in names.items()})
        data = tmp_path / "data.npz"
    model = small_from(sac, source_data=data)
    assert model.replay_buffer.source.size() == 200
    model.learn(5)
    assert model.dynamics.fitted
    assert model.source_timesteps == 5 * 8


@pytest.mark.parametrize("done", [2.0, -1.0, 0.5])
def test_ends_that_are_neither_yes_nor_no_are_refused(done, tmp_path):
    rows = {"obs": np.zeros((5, 3)), "act": np.zeros((5, 1)), "next_obs": np.zeros((5, 3)), "rew": np.zeros(5)}
    np.savez(tmp_path / "data.npz", **rows, done=np.array([0, 0, 1, 0, done]))
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs=SMALL_POLICY)
    with pytest.raises(ValueError, match="source_data holds values of done other than 0 and 1"):
        small_from(sac, source_data=tmp_path / "data.npz")


def small_from(sac, **kwargs):
    settings = {"dynamics_kwargs": SMALL_ENSEMBLE, "source_steps": 8, "device": "cpu"}
    return RPTO.from_source(sac, pendulum(), pendulum(12.0), **settings, **kwargs)


def test_a_source_model_that_does_not_fit_is_refused():
    other = SAC("MlpPolicy", gym.make("MountainCarContinuous-v0"), policy_kwargs=SMALL_POLICY)
    with pytest.raises(ValueError, match="source_model has observation_space"):
        RPTO.from_source(other, pendulum(), pendulum(12.0))
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs=SMALL_POLICY)
    with pytest.raises(ValueError, match="policy_kwargs"):
        RPTO.from_source(sac, pendulum(), pendulum(12.0), policy_kwargs={"net_arch": [32]})
    short = SAC(
        "MlpPolicy", gym.make("MountainCarContinuous-v0"), policy_kwargs=SMALL_POLICY, learning_starts=20
    ).learn(20)
    with pytest.raises(ValueError, match="source_data holds observations"):
        RPTO.from_source(sac, pendulum(), pendulum(12.0), source_data=short.replay_buffer)


def test_a_source_model_of_other_observations_is_named_before_anything_is_built():
    class Split(gym.ObservationWrapper):
        observation_space = gym.spaces.Dict({"all": gym.spaces.Box(-9, 9, (3,))})

        def observation(self, observation):
            return {"all": observation}

    sac = SAC("MultiInputPolicy", Split(pendulum()), policy_kwargs=SMALL_POLICY)
    with pytest.raises(ValueError, match=r"source_model has observation_space Dict\("):
        RPTO.from_source(sac, pendulum(), pendulum(12.0))


def test_a_first_fit_that_was_interrupted_is_made_again(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    model = small(RPTO)
    with monkeypatch.context() as patch:
        patch.setattr(type(model.dynamics), "_train_epoch", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(5, source_timesteps=60)
    assert not model.dynamics.fitted
    model.save(tmp_path / "m.zip")
    assert not RPTO.load(tmp_path / "m.zip").dynamics.fitted
    model.learn(5, reset_num_timesteps=False, source_timesteps=60)
    assert model.dynamics.fitted


def test_a_rule_that_no_checkpoint_could_hold_is_refused():
    class Robot:
        def __reduce__(self):
            raise TypeError("a robot does not pickle")

        def ends(self, observations, actions, next_observations):
            return observations[:, 0] > 1

    settings = {**SMALL_ENSEMBLE, "termination_fn": Robot().ends}
    with pytest.raises(ValueError, match=r"dynamics_kwargs\['termination_fn'\] does not pickle \(a robot does not"):
        small(RPTO, dynamics_kwargs=settings)


def test_other_action_bounds_are_pointed_out():
    sac = SAC("MlpPolicy", gym.wrappers.RescaleAction(pendulum(), -1.0, 1.0), policy_kwargs=SMALL_POLICY)
    with pytest.warns(UserWarning, match="another action"):
        RPO.from_source(sac, pendulum(), target_env=pendulum(12.0))


@pytest.mark.parametrize(
    ("of_source", "passed", "expected"),
    [
        (0.1, {"ent_coef": 0.5}, 0.5),
        (0.1, {"ent_coef": "auto"}, 0.1),
        (0.1, {}, 0.1),
        (0.0, {"ent_coef": "auto_0.2"}, 0.2),
        ("auto_0.03", {"ent_coef": "auto_0.5"}, 0.5),
        ("auto_0.03", {"ent_coef": "auto"}, 0.03),
        ("auto_0.03", {"ent_coef": 0.2}, 0.2),
    ],
)
def test_the_temperature_is_the_sources_unless_another_is_asked_for(of_source, passed, expected):
    sac = SAC("MlpPolicy", pendulum(), ent_coef=of_source, policy_kwargs=SMALL_POLICY, buffer_size=10)
    assert float(small_from(sac, **passed).temperature()) == pytest.approx(expected)


def test_a_source_phases_checkpoint_is_not_in_the_source_phase_once_loaded(tmp_path):
    model = small(RTO, learning_starts=20)
    model.set_logger(configure(str(tmp_path), []))
    model.learn(10, source_timesteps=60)
    loaded = RTO.load(tmp_path / "pretrain.zip", env=pendulum(), target_env=pendulum(12.0))
    loaded.load_replay_buffer(tmp_path / "pretrain_replay_buffer.pkl")
    before = [p.clone() for p in loaded.actor.parameters()]
    loaded.learn(10, source_timesteps=0)
    assert not loaded.state.pretraining
    assert all(th.equal(a, b) for a, b in zip(before, loaded.actor.parameters()))  # RTO leaves the policy


def test_a_warm_start_after_loading_is_saved(tmp_path):
    small(RPO).save(tmp_path / "cold")
    model = RPO.load(tmp_path / "cold")
    model.set_parameters(model.get_parameters())
    model.save(tmp_path / "warm")
    assert RPO.load(tmp_path / "warm").state.knows_source


class WithDriver(gym.Wrapper):
    """Knows its reward, and holds what does not pickle, as the driver of a robot does."""

    def __init__(self, env, scale=1.0):
        super().__init__(env)
        self.lock, self.scale = threading.Lock(), scale

    def reward_fn(self, observations, actions, next_observations):
        return -self.scale * next_observations.square().sum(dim=1)

    def termination_fn(self, observations, actions, next_observations):
        return th.zeros(len(observations), dtype=th.bool)


def test_rules_of_environments_that_do_not_pickle_are_read_again_after_loading(tmp_path):
    def worlds():
        return WithDriver(pendulum()), WithDriver(pendulum(12.0), 2.0)

    source, target = worlds()
    model = small(RPTO, source, target, model_train_freq=10)
    model.save(tmp_path / "new")
    model.learn(30, source_timesteps=0, callback=CheckpointCallback(15, tmp_path))
    model.save(tmp_path / "learned")
    rows = th.ones(4, 3), th.ones(4, 1), th.ones(4, 3)
    assert (model.dynamics.reward_fn(*rows) == -6.0).all()
    for name, expected in (("new", -3.0), ("learned", -6.0)):
        source, target = worlds()
        with pytest.raises(RuntimeError, match="pass env= and target_env="):
            RPTO.load(tmp_path / name).dynamics.reward_fn(*rows)
        loaded = RPTO.load(tmp_path / name, env=source, target_env=target)
        assert (loaded.dynamics.reward_fn(*rows) == expected).all()


def test_rules_are_read_once_of_each_target(monkeypatch):
    read: list[object] = []
    monkeypatch.setattr(rto, "task_rules", lambda env: read.append(env) or task_rules(env))
    model = small(RPTO, WithDriver(pendulum()), WithDriver(pendulum(12.0), 2.0), model_train_freq=10)
    read.clear()
    model.learn(30, source_timesteps=0)
    assert len(read) == 1
    with pytest.warns(UserWarning, match="D_target loses"):
        model.set_target_env(WithDriver(pendulum(11.0), 3.0))
    model.learn(30, reset_num_timesteps=False)
    rows = th.ones(4, 3), th.ones(4, 1), th.ones(4, 3)
    assert (model.dynamics.reward_fn(*rows) == -9.0).all()


def test_a_mujoco_simulator_is_saved_as_text_and_comes_back_to_the_last_bit(tmp_path):
    env = hopper(-9.0)
    env.unwrapped.model.body_mass[1] *= 1.01
    model = small(RPTO, env, hopper(-12.0), dynamics="physical", declared=["option.gravity"], dynamics_kwargs={})
    model.save(tmp_path / "m")
    data, _, _ = load_from_zip_file(tmp_path / "m.zip")
    assert data["dynamics_config"]["mj_model"].text.startswith("<mujoco")
    ours, theirs = (numbers(m) for m in (env.unwrapped.model, RPTO.load(tmp_path / "m").dynamics.mj_model))
    for name in ours:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


@pytest.mark.slow
def test_another_target_begins_without_the_data_and_the_best_policy_of_the_last():
    model = small(RPO, stats_window_size=2)
    model.learn(500, source_timesteps=0)
    assert "best" in model.snapshots
    with pytest.warns(UserWarning, match="loses 500 transitions"):
        model.set_target_env(pendulum(14.0))
    assert model.replay_buffer.target.size() == 0
    assert (model.snapshots.best_mean_reward, "best" in model.snapshots) == (-np.inf, False)


def test_action_noise_survives_a_refused_run():
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))
    model = small(RPO, action_noise=noise)
    with pytest.raises(ValueError, match="EvalCallback"):
        model.learn(10, callback=KeepBest(), source_timesteps=0)
    assert model.action_noise is noise


def test_what_refills_the_source_of_a_corrected_simulator_is_that_simulator(tmp_path, monkeypatch):
    model = small(RPTO, cartpole(), cartpole(pole_length=2.0), dynamics="physical", dynamics_kwargs={})
    model.save(tmp_path / "m")
    loaded = RPTO.load(tmp_path / "m", env=cartpole(), target_env=cartpole(pole_length=2.0))
    loaded.rollouts = loaded.make_rollouts()
    seen = []
    monkeypatch.setattr(EpisodeSource, "interact", lambda world, *a, **k: seen.append(world.env) or 0)
    pretraining.collect_in_source(loaded, 10)
    assert seen == [loaded.rollouts.env]
    assert seen != [loaded.env]


def test_unseeded_models_have_streams_of_their_own():
    spaces = pendulum().observation_space, pendulum().action_space
    rule = {"termination_fn": lambda o, a, n: o[:, 0] > 9}
    first, second = (EnsembleDynamics(*spaces, **SMALL_ENSEMBLE, **rule) for _ in range(2))
    assert first.generator.initial_seed() != second.generator.initial_seed()


def test_parameters_set_by_hand_count_as_a_warm_start():
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs=SMALL_POLICY)
    model = small(RPO)
    model.set_parameters(sac.get_parameters())
    model.learn(3)
    assert model.state.pretraining_timesteps == 0


def test_action_noise_belongs_to_the_target():
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.1 * np.ones(1))
    model = small(RPO, make_vec_env(pendulum, n_envs=3), action_noise=noise)
    model.learn(20, source_timesteps=0)
    assert model.action_noise is noise
    model = small(RPO, target=make_vec_env(lambda: pendulum(12.0), n_envs=2), action_noise=noise)
    model.learn(20, source_timesteps=0)
    assert model.action_noise.n_envs == 2


def test_a_temperature_that_is_asked_for_is_where_a_loaded_model_begins(tmp_path):
    small(RPO, ent_coef="auto").save(tmp_path / "m")
    loaded = RPO.load(tmp_path / "m", ent_coef="auto_0.5")
    assert loaded.log_ent_coef.exp().item() == pytest.approx(0.5)
    with pytest.raises(ValueError, match="ent_coef: of the zip and what is asked for one fixes the temperature"):
        RPO.load(tmp_path / "m", ent_coef=0.1)


@pytest.mark.parametrize(("asked", "kept"), [(50, 12), (8, 8), (None, 12)], ids=["larger", "smaller", "as it was"])
def test_a_target_side_is_as_large_as_asked_for(asked, kept, tmp_path):
    model = small(RPO, replay_buffer_kwargs={"target_size": 20}).learn(12)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    given = {} if asked is None else {"replay_buffer_kwargs": {"target_size": asked}}
    loaded = RPO.load(tmp_path / "m", pendulum(), target_env=pendulum(12.0), device="cpu", **given)
    loaded.load_replay_buffer(tmp_path / "b")
    buffer = loaded.replay_buffer
    assert (buffer.buffer_size, buffer.target.buffer_size, buffer.size()) == (asked or 20, asked or 20, kept)
    assert buffer.target_added == 12
    for name, array in chronological(buffer.target).items():
        np.testing.assert_array_equal(array, chronological(model.replay_buffer.target)[name][-kept:], err_msg=name)
    loaded.learn(4, reset_num_timesteps=False)
