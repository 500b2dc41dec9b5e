"""Facts about SB3 that the algorithms are built on: an SB3 release that breaks one fails here, by name."""

import importlib.metadata
import inspect
import io
import warnings
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import OURS, pendulum
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common import logger as sb3_logger
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_pkl, load_from_zip_file
from stable_baselines3.common.type_aliases import ReplayBufferSamples, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from sb3_rpto import RPO, RPTO, DualReplayBuffer, DynamicsEnv
from sb3_rpto.algorithms import pretraining
from sb3_rpto.algorithms.transfer import TransferAlgorithm

SAC_DEFAULTS = {
    "learning_rate": 3e-4,
    "buffer_size": 1_000_000,
    "learning_starts": 100,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "action_noise": None,
    "replay_buffer_class": None,
    "replay_buffer_kwargs": None,
    "optimize_memory_usage": False,
    "n_steps": 1,
    "ent_coef": "auto",
    "target_update_interval": 1,
    "target_entropy": "auto",
    "use_sde": False,
    "sde_sample_freq": -1,
    "use_sde_at_warmup": False,
    "stats_window_size": 100,
    "tensorboard_log": None,
    "policy_kwargs": None,
    "verbose": 0,
    "seed": None,
    "device": "auto",
    "_init_setup_model": True,
}
SAC_ARGUMENTS = ["policy", "env", *SAC_DEFAULTS]

ours = pytest.mark.parametrize("cls", OURS)


@pytest.fixture(autouse=True)
def _shortest_source_phase(_short_source_phase, monkeypatch):
    monkeypatch.setattr(pretraining, "PHI_0_STEPS", 20)
    monkeypatch.setattr(pretraining, "PHI_0_UPDATES", 3)
    monkeypatch.setattr(pretraining, "FIRST_SOURCE_STEPS", 20)


def sac(env=None, **kwargs):
    settings = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "learning_starts": 5, "buffer_size": 500}
    return SAC("MlpPolicy", pendulum() if env is None else env, **{**settings, "device": "cpu", "seed": 0, **kwargs})


def build(cls, env=None, target=None, **kwargs):
    settings = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "buffer_size": 500, "source_steps": 2}
    if cls.updates_dynamics:
        settings["dynamics_kwargs"] = {"hidden": (8,), "n_members": 2, "n_elites": 1, "max_steps": 3}
    env, target = pendulum() if env is None else env, pendulum(12.0) if target is None else target
    return cls("MlpPolicy", env, target_env=target, **{**settings, "device": "cpu", "seed": 0, **kwargs})


class Each(BaseCallback):
    """Calls ``look(callback)`` at each step and keeps the answers."""

    def __init__(self, look):
        super().__init__()
        self.look, self.seen = look, []

    def _on_step(self):
        self.seen.append(self.look(self))
        return True


# ---------------------------------------------------------------------- load


@ours
def test_load_runs_setup_model_without_an_env(cls, tmp_path, monkeypatch):
    build(cls).save(tmp_path / "model")
    seen = []
    setup = cls._setup_model
    monkeypatch.setattr(cls, "_setup_model", lambda self: (seen.append((self.env, self.target_env)), setup(self)))
    loaded = cls.load(tmp_path / "model")
    assert seen == [(None, None)]
    assert isinstance(loaded.replay_buffer, DualReplayBuffer)
    assert (loaded.dynamics is not None) == cls.updates_dynamics
    with pytest.raises(ValueError, match="env="):
        loaded.learn(5)


def test_load_constructs_with_policy_env_device_alone(tmp_path, monkeypatch):
    sac().save(tmp_path / "model")
    seen = []
    construct = SAC.__init__
    monkeypatch.setattr(
        SAC, "__init__", lambda self, **kwargs: (seen.append(set(kwargs)), construct(self, **kwargs))[1]
    )
    SAC.load(tmp_path / "model")
    assert seen == [{"policy", "env", "device", "_init_setup_model"}]


def test_arguments_of_sb3s_load_land_in_the_model_raw(tmp_path):
    sac().save(tmp_path / "model")
    assert SAC.load(tmp_path / "model", target_env="anything").target_env == "anything"
    build(RPO).save(tmp_path / "ours")
    loaded = RPO.load(tmp_path / "ours", env=pendulum(), target_env=pendulum(12.0))
    assert loaded.target_env.num_envs == 1  # set_target_env has wrapped it


def test_load_forgets_the_last_observation_when_it_gets_an_env(tmp_path):
    model = sac().learn(10)
    model.save(tmp_path / "model")
    assert SAC.load(tmp_path / "model", env=pendulum())._last_obs is None
    assert SAC.load(tmp_path / "model")._last_obs is not None


def test_load_ends_by_set_parameters_with_exact_match(tmp_path, monkeypatch):
    """TransferAlgorithm.set_parameters marks the model as warm; load() therefore puts back what was saved."""
    build(RPO).save(tmp_path / "model")
    calls = []
    put = BaseAlgorithm.set_parameters
    monkeypatch.setattr(
        BaseAlgorithm,
        "set_parameters",
        lambda self, params, exact_match=True, device="auto": (calls.append(exact_match), put(self, params)),
    )
    assert RPO.load(tmp_path / "model").state.knows_source is False
    assert calls == [True]


# ---------------------------------------------------------------------- constructor


def test_sac_has_28_arguments_and_these_defaults():
    parameters = inspect.signature(SAC.__init__).parameters
    assert list(parameters)[1:] == SAC_ARGUMENTS
    assert len(SAC_ARGUMENTS) == 28
    assert {name: parameters[name].default for name in SAC_DEFAULTS} == SAC_DEFAULTS


@ours
def test_our_arguments_come_after_sacs_keyword_only(cls):
    parameters = inspect.signature(cls.__init__).parameters
    assert list(parameters)[1:29] == SAC_ARGUMENTS
    theirs = inspect.signature(SAC.__init__).parameters
    assert all(parameters[name].default == theirs[name].default for name in SAC_ARGUMENTS)
    assert all(parameters[name].kind is inspect.Parameter.KEYWORD_ONLY for name in list(parameters)[29:])
    assert "__init__" not in vars(cls)  # listed once, in transfer.py


@ours
def test_arguments_by_position_are_sacs(cls):
    model = cls("MlpPolicy", pendulum(), 1e-3, 400, 7, 16, 0.01, 0.9, target_env=pendulum(12.0), device="cpu")
    values = (model.learning_rate, model.buffer_size, model.learning_starts, model.batch_size, model.tau, model.gamma)
    assert values == (1e-3, 400, 7, 16, 0.01, 0.9)


def test_learn_has_these_arguments():
    expected = ["self", "total_timesteps", "callback", "log_interval", "tb_log_name"]
    expected += ["reset_num_timesteps", "progress_bar"]
    assert list(inspect.signature(SAC.learn).parameters) == expected
    assert list(inspect.signature(RPTO.learn).parameters) == [*expected, "source_timesteps"]


# ---------------------------------------------------------------------- saving


@ours
def test_everything_left_in_dict_is_saved(cls, tmp_path):
    model = build(cls, make_vec_env(pendulum)).learn(5, source_timesteps=0)
    model.of_the_user = [1, 2]
    model.save(tmp_path / "model")
    data, parameters, variables = load_from_zip_file(tmp_path / "model")
    assert data["of_the_user"] == [1, 2]
    assert set(model.__dict__) - set(data) == set(model._excluded_save_params()) & set(model.__dict__) | (
        {"log_ent_coef", "ent_coef_optimizer"} - set(data)
    )
    for value in data.values():
        assert not isinstance(value, gym.Env | VecEnvWrapper | ReplayBuffer | th.nn.Module | th.optim.Optimizer)
    assert set(parameters) == {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"}  # SAC's
    assert set(variables) == {"log_ent_coef"}


@ours
def test_sb3_leaves_out_what_cannot_be_pickled(cls):
    excluded = set(BaseAlgorithm._excluded_save_params(build(cls)))
    assert excluded >= {"policy", "device", "env", "replay_buffer", "_vec_normalize_env", "_logger"}
    ours_too = set(build(cls)._excluded_save_params())
    assert ours_too >= excluded | {"actor", "critic", "critic_target", "target", "dynamics", "_last_obs"}


def test_sb3_reads_what_ends_in_pth_and_leaves_other_entries_alone(tmp_path):
    """The dynamics lie in the zip as entries that ``SAC.load`` does not see."""
    build(RPTO).save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert {"dynamics.pt", "dynamics.optimizer.pt"} <= set(archive.namelist())
    _, parameters, _ = load_from_zip_file(tmp_path / "model")
    assert set(parameters) == set(build(RPO).get_parameters())


def test_the_dynamics_are_one_module_with_scaler_and_elites_registered():
    model = build(RPTO)
    assert isinstance(model.dynamics, th.nn.Module)
    registered = " ".join(model.dynamics.state_dict())
    for name in ("elites", "mean", "std"):
        assert name in registered


def test_a_physical_model_is_saved_as_what_rebuilds_it(tmp_path):
    env, target = (gym.make("rpto/ContinuousCartPole-v0", pole_length=length) for length in (1.0, 1.2))
    model = RPTO("MlpPolicy", env, target_env=target, dynamics="physical", policy_kwargs={"net_arch": [8]})
    model.save(tmp_path / "model")
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert data["dynamics_config"]["backend"] == "physical"
    assert all(isinstance(value, float) for value in data["dynamics_config"]["constants"].values())
    assert "dynamics.pt" in zipfile.ZipFile(tmp_path / "model.zip").namelist()


# ---------------------------------------------------------------------- the update


def test_sac_draws_one_batch_for_critic_and_actor(monkeypatch):
    model = sac().learn(10)
    sizes = []
    sample = model.replay_buffer.sample
    monkeypatch.setattr(
        model.replay_buffer, "sample", lambda n, env=None: (sizes.append((n, env)), sample(n, env=env))[1]
    )
    model.train(gradient_steps=3, batch_size=8)
    assert sizes == [(8, None)] * 3


def test_our_update_draws_one_for_each_gathered_at_once(monkeypatch):
    model = build(RPO).learn(10, source_timesteps=0)
    worlds = []
    sample = model.replay_buffer.sample
    monkeypatch.setattr(
        model.replay_buffer,
        "sample",
        lambda n, env=None, world="target": (worlds.append((n, world)), sample(n, env=env, world=world))[1],
    )
    model.state.actor_updates = 3
    model.real_ratio = 0.25
    model.train(gradient_steps=2, batch_size=8)
    assert sorted(worlds) == [(4, "target"), (8, "source"), (8, "target"), (12, "source")]


def test_samples_have_these_fields():
    assert ReplayBufferSamples._fields[:5] == ("observations", "actions", "next_observations", "dones", "rewards")


def test_these_attributes_are_what_the_update_uses():
    model = sac(ent_coef="auto_0.5")
    assert model.log_ent_coef.exp().item() == pytest.approx(0.5)
    assert model.ent_coef_optimizer.param_groups[0]["params"][0] is model.log_ent_coef
    assert model.target_entropy == -1.0
    assert model.batch_norm_stats == model.batch_norm_stats_target == []
    assert not model.critic_target.training
    assert sac(ent_coef=0.3).ent_coef_tensor.item() == pytest.approx(0.3)
    assert model.policy.actor is model.actor
    for network in (model.critic, model.critic_target):
        assert len(network(th.zeros(4, 3), th.zeros(4, 1))) == 2


def test_critic_target_has_no_optimizer_and_stays_in_evaluation_mode():
    model = sac()
    model.policy.set_training_mode(True)
    assert model.critic.training
    assert model.actor.training
    assert not model.critic_target.training


# ---------------------------------------------------------------------- collecting


def test_collect_rollouts_calls_back_before_it_stores():
    watch = Each(lambda callback: callback.model.num_timesteps - callback.model.replay_buffer.size())
    sac().learn(8, callback=watch)
    assert set(watch.seen) == {1}
    watch.seen.clear()
    build(RPO).learn(8, callback=watch, source_timesteps=0)
    assert set(watch.seen) == {1}


def test_collect_rollouts_drops_the_step_after_which_a_callback_stops():
    """Ours stores it (``store_step``); if SB3 does too one day, ours would store it twice."""
    model = sac().learn(50, callback=lambda local, _: local["self"].num_timesteps < 7)
    assert (model.num_timesteps, model.replay_buffer.size()) == (7, 6)
    model = build(RPO).learn(50, callback=lambda local, _: local["self"].num_timesteps < 7, source_timesteps=0)
    assert (model.num_timesteps, model.replay_buffer.size()) == (7, 7)


def test_collect_rollouts_shows_these_locals():
    names = {"buffer_actions", "new_obs", "rewards", "dones", "infos", "env", "self"}
    watch = Each(lambda callback: names <= callback.locals.keys())
    build(RPO).learn(3, callback=watch, source_timesteps=0)
    assert all(watch.seen)


def test_collect_rollouts_works_on_the_env_that_it_is_given():
    """It steps its argument, not ``self.env``, and reads the target's observation from ``_last_obs``."""
    parameters = list(inspect.signature(OffPolicyAlgorithm.collect_rollouts).parameters)
    assert parameters[1:] == [
        *("env", "callback", "train_freq", "replay_buffer", "action_noise", "learning_starts", "log_interval")
    ]
    model = build(RPO, pendulum(0.001), pendulum(20.0))
    watch = Each(lambda callback: (callback.locals["env"] is model.target_env, model._last_obs.copy()))
    model.learn(6, callback=watch, source_timesteps=0)
    assert all(is_target for is_target, _ in watch.seen)
    stored = model.replay_buffer.target.observations[:6, 0]
    np.testing.assert_array_equal(np.concatenate([obs for _, obs in watch.seen]), stored)


def test_collect_rollouts_takes_no_random_action_without_learning_starts():
    assert inspect.signature(OffPolicyAlgorithm.collect_rollouts).parameters["learning_starts"].default == 0


@ours
def test_callbacks_fire_once_per_target_step(cls):
    watch = Each(lambda callback: callback.num_timesteps)
    build(cls).learn(9, callback=watch, source_timesteps=30)
    assert watch.seen == list(range(1, 10))


@ours
def test_num_timesteps_counts_target_steps(cls):
    model = build(cls, make_vec_env(pendulum, n_envs=3), make_vec_env(lambda: pendulum(12.0), n_envs=2))
    model.learn(10, source_timesteps=30)
    assert model.num_timesteps == 10
    assert model.source_timesteps > 30


def test_setup_learn_resets_env_only_to_begin():
    """SB3 resets ``self.env`` when the count starts anew or there is no last observation; ours resets both worlds."""

    class Resets(gym.Wrapper):
        count = 0

        def reset(self, **kwargs):
            self.count += 1
            return super().reset(**kwargs)

    env = Resets(pendulum())
    model = sac(env)
    counts = []
    for keep in (True, False, False, True):
        model.learn(3, reset_num_timesteps=keep)
        counts.append(env.count)
    assert counts == [1, 1, 1, 2]
    env, target = Resets(pendulum()), Resets(pendulum(12.0))
    model = build(RPO, env, target)
    counts = []
    for keep in (True, False, False, True):
        model.learn(3, reset_num_timesteps=keep, source_timesteps=0)
        counts.append(target.count)
    assert counts == [1, 1, 1, 2]


@ours
def test_the_last_observation_is_the_targets(cls):
    target = pendulum(12.0)
    model = build(cls, make_vec_env(pendulum, n_envs=3), target)
    model.learn(5, source_timesteps=0)
    assert model._last_obs.shape == (1, 3)
    theta, speed = target.unwrapped.state
    np.testing.assert_allclose(model._last_obs[0], [np.cos(theta), np.sin(theta), speed], rtol=1e-5)


@ours
def test_get_env_stays_the_source(cls):
    env = make_vec_env(pendulum, n_envs=2)
    model = build(cls, env)
    watch = Each(lambda callback: model.get_env() is env and callback.training_env is env)
    model.learn(5, callback=watch, source_timesteps=10)
    assert all(watch.seen)
    assert model.get_env() is env


def test_the_progress_bar_and_the_episode_limit_read_the_sources_num_envs():
    """SB3's do; ours are put right in ``_init_callback``."""
    assert "self.training_env.num_envs" in inspect.getsource(ProgressBarCallback._on_step)
    stop = StopTrainingOnMaxEpisodes(2)
    stop.init_callback(sac(make_vec_env(pendulum, n_envs=3)))
    assert stop._total_max_episodes == 6
    model = build(RPO, make_vec_env(pendulum, n_envs=3))
    model._setup_learn(10, stop)
    assert stop._total_max_episodes == 2


def test_vectorised_noise_would_be_sized_by_the_source():
    model = sac(make_vec_env(pendulum, n_envs=3), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))
    model._setup_learn(10)
    assert isinstance(model.action_noise, VectorizedActionNoise)
    model = build(RPO, make_vec_env(pendulum, n_envs=3), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))
    model._setup_learn(10)
    assert not isinstance(model.action_noise, VectorizedActionNoise)


def test_set_env_forgets_the_last_observation():
    model = sac().learn(3)
    model.set_env(pendulum())
    assert model._last_obs is None
    model = build(RPO).learn(3, source_timesteps=0)
    model.set_env(pendulum())
    assert model._last_obs is not None  # it is the target's


def test_train_freq_is_a_pair_after_setup():
    assert sac(train_freq=(3, "step")).train_freq == TrainFreq(3, TrainFrequencyUnit.STEP)
    assert build(RPO, train_freq=(1, "episode")).train_freq == TrainFreq(1, TrainFrequencyUnit.EPISODE)


# ---------------------------------------------------------------------- buffers


def test_one_buffer_keeps_both_sides(tmp_path):
    model = build(RPTO)
    checkpoint = CheckpointCallback(5, str(tmp_path), save_replay_buffer=True)
    model.learn(10, callback=checkpoint, source_timesteps=0)
    saved = load_from_pkl(tmp_path / "rl_model_replay_buffer_10_steps.pkl")
    assert isinstance(saved, DualReplayBuffer)
    assert saved.target.size() == 9
    assert saved.source.size() == 20 + 10 * 2


def test_load_replay_buffer_sets_the_device():
    model = build(RPO).learn(5, source_timesteps=0)
    file = io.BytesIO()
    model.save_replay_buffer(file)
    file.seek(0)
    buffer = model.replay_buffer
    model.load_replay_buffer(file)
    assert model.replay_buffer is not buffer
    assert model.replay_buffer.device == model.replay_buffer.source.device == model.device
    before = model.replay_buffer.source.observations
    model.replay_buffer.device = th.device("meta")  # settable without allocating
    assert model.replay_buffer.source.observations is before
    assert model.replay_buffer.source.device == th.device("meta")


def test_setup_model_builds_the_buffer_with_these_arguments():
    names = list(inspect.signature(ReplayBuffer.__init__).parameters)[1:]
    assert names == [
        *("buffer_size", "observation_space", "action_space", "device", "n_envs"),
        *("optimize_memory_usage", "handle_timeout_termination"),
    ]
    seen = {}

    class Spy(ReplayBuffer):
        def __init__(self, *args, **kwargs):
            seen.update(kwargs, n_positional=len(args))
            super().__init__(*args, **kwargs)

    sac(replay_buffer_class=Spy)
    assert seen["n_positional"] == 3
    assert set(seen) == {"n_positional", "device", "n_envs", "optimize_memory_usage"}


def test_a_replay_buffer_is_these_arrays():
    buffer = sac().learn(5).replay_buffer
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        assert getattr(buffer, name).shape[:2] == (500, 1)
    assert (buffer.pos, buffer.full, buffer.size()) == (5, False, 5)


def test_the_target_side_has_its_own_size():
    buffer = build(RPO, replay_buffer_kwargs={"target_size": 40}).replay_buffer
    assert (buffer.source.buffer_size, buffer.target.buffer_size, buffer.buffer_size) == (500, 40, 40)


def test_mujoco_observations_are_float64():
    env = gym.make("InvertedDoublePendulum-v5")
    assert env.observation_space.dtype == np.float64
    target = gym.make("InvertedDoublePendulum-v5")
    target.unwrapped.model.opt.gravity[2] = -12
    model = build(RPTO, env, target).learn(5, source_timesteps=0)
    assert model.replay_buffer.source.observations.dtype == model.replay_buffer.observations.dtype == np.float64


# ---------------------------------------------------------------------- seeds


@ours
def test_the_seed_reaches_target_and_model(cls):
    def first_observations(seed):
        model = build(cls, seed=seed)
        stream = None if model.dynamics is None else model.dynamics.generator.initial_seed()
        return model.env.reset(), model.target_env.reset(), stream

    source, target, stream = first_observations(3)
    again = first_observations(3)
    np.testing.assert_array_equal(target, again[1])
    assert stream == again[2]
    assert not np.array_equal(source, target)  # another stream
    assert not np.array_equal(target, first_observations(4)[1])


@ours
def test_without_a_seed_nothing_is_seeded(cls, monkeypatch):
    """The same global state before, the same after: no generator is seeded."""
    seeded = []
    monkeypatch.setattr("stable_baselines3.common.base_class.set_random_seed", lambda *args, **kw: seeded.append(args))
    monkeypatch.setattr(VecEnvWrapper, "seed", lambda self, seed=None: seeded.append(seed))
    build(cls, seed=None)
    assert seeded == []
    build(cls, seed=1)
    assert len(seeded) >= 2


def test_a_zip_that_was_trained_with_a_seed_seeds_nothing(tmp_path, monkeypatch):
    SAC("MlpPolicy", pendulum(), seed=1, policy_kwargs={"net_arch": [8]}, buffer_size=10).save(tmp_path / "sac")
    seeded = []
    monkeypatch.setattr("stable_baselines3.common.base_class.set_random_seed", lambda *args, **kw: seeded.append(args))
    model = RPO.from_source(tmp_path / "sac", pendulum(), pendulum(12.0))
    assert seeded == []
    assert model.seed is None


def test_counts_of_numpy_are_counts():
    build(RPO, batch_size=np.int64(8), gradient_steps=np.int64(1)).learn(10, source_timesteps=0)


def test_a_vec_env_wrapper_hands_the_seed_on():
    venv = make_vec_env(pendulum, n_envs=2)
    assert VecEnvWrapper.seed is not type(venv).seed
    wrapped = VecNormalize(venv)
    wrapped.seed(7)
    assert venv._seeds == [7, 8]


# ---------------------------------------------------------------------- VecNormalize


@ours
def test_the_statistics_are_the_sources(cls):
    env = VecNormalize(make_vec_env(pendulum))
    model = build(cls, env)
    assert isinstance(model.target_env, VecNormalize)
    assert model.target_env.obs_rms is env.obs_rms
    assert model.target_env.ret_rms is env.ret_rms
    assert env.training
    assert not model.target_env.training
    count = env.obs_rms.count
    for _ in range(3):
        model.target_env.reset()
        model.target_env.step(np.zeros((1, 1), np.float32))
    assert env.obs_rms.count == count


@ours
def test_while_sb3_collects_the_normaliser_is_the_targets(cls):
    """``_store_transition`` reads original observations and rewards from ``_vec_normalize_env``."""
    env = VecNormalize(make_vec_env(pendulum))
    model = build(cls, env)
    watch = Each(lambda callback: callback.model._vec_normalize_env is model.target_env)
    model.learn(5, callback=watch, source_timesteps=0)
    assert all(watch.seen)
    assert model._vec_normalize_env is model.get_vec_normalize_env() is env


def test_store_transition_reads_the_normaliser():
    model = build(RPO, VecNormalize(make_vec_env(pendulum)))
    model.learn(20, source_timesteps=0)
    stored = model.replay_buffer.target.observations[:20, 0]
    np.testing.assert_allclose((stored[:, :2] ** 2).sum(axis=1), 1.0, atol=1e-5)  # cos and sin: raw
    seen = model.replay_buffer.sample(50, env=model.get_vec_normalize_env()).observations.numpy()
    assert not np.allclose((seen[:, :2] ** 2).sum(axis=1), 1.0, atol=1e-2)


def test_a_saved_vec_normalize_remembers_whether_it_trains(tmp_path):
    """Therefore ``get_vec_normalize_env`` must never be the target's: CheckpointCallback saves what it returns."""
    frozen = VecNormalize(make_vec_env(pendulum), training=False)
    frozen.save(str(tmp_path / "statistics.pkl"))
    assert not VecNormalize.load(str(tmp_path / "statistics.pkl"), make_vec_env(pendulum)).training
    assert "get_vec_normalize_env()" in inspect.getsource(CheckpointCallback._on_step)


# ---------------------------------------------------------------------- logs


def test_long_log_keys_collide():
    stdout = sb3_logger.HumanOutputFormat(io.StringIO())
    long = "group/" + "x" * 40
    with pytest.raises(ValueError, match="truncated"):
        stdout.write({long + "1": 1.0, long + "2": 2.0}, {long + "1": (), long + "2": ()})


@pytest.mark.slow
@ours
def test_our_log_keys_are_short_and_lower_case(cls):
    model = (
        build(cls, VecNormalize(make_vec_env(pendulum)), model_train_freq=50) if cls.updates_dynamics else build(cls)
    )
    seen = set()
    model.set_logger(configure(None, []))
    record = model.logger.record
    model.logger.record = lambda key, value, exclude=None: (seen.add(key), record(key, value, exclude))
    model.learn(210, source_timesteps=60, log_interval=1)
    assert len(seen) > 12
    for key in seen:
        group, name = key.split("/")
        assert len(key) <= 33
        assert key == key.lower()
        assert group
        assert name


def test_dump_logs_is_the_hook_for_more_keys():
    assert "dump_logs" in vars(OffPolicyAlgorithm)
    assert "self.dump_logs()" in inspect.getsource(OffPolicyAlgorithm.collect_rollouts)
    assert "dump_logs" in vars(TransferAlgorithm)


# ---------------------------------------------------------------------- what is refused, what works


class Spaces(gym.Env):
    def __init__(self, observation_space, action_space=None):
        self.observation_space = observation_space
        self.action_space = spaces.Box(-1, 1, (1,)) if action_space is None else action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}


@ours
def test_dict_image_discrete_her_and_n_steps_are_refused_at_construction(cls):
    flat = spaces.Box(-1, 1, (3,), np.float32)
    refused = [
        {"env": Spaces(spaces.Dict({"a": flat}))},
        {"env": Spaces(spaces.Box(0, 255, (36, 36, 3), np.uint8))},
        {"env": Spaces(flat, spaces.Discrete(2))},
        {"replay_buffer_class": HerReplayBuffer},
        {"n_steps": 2},
    ]
    for arguments in refused:
        with pytest.raises(NotImplementedError):
            build(cls, **arguments)


def test_her_needs_a_dict_buffer():
    assert issubclass(HerReplayBuffer, DictReplayBuffer)


@ours
def test_vec_normalize_several_sources_sde_noise_and_callbacks_work_together(cls, tmp_path):
    model = build(
        cls,
        VecNormalize(make_vec_env(pendulum, n_envs=3)),
        make_vec_env(lambda: pendulum(12.0), n_envs=2),
        use_sde=True,
        action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)),
    )
    callbacks = [CheckpointCallback(5, str(tmp_path)), StopTrainingOnMaxEpisodes(5)]
    model.learn(20, callback=callbacks, source_timesteps=30)
    assert model.num_timesteps == 20
    assert len(list(tmp_path.iterdir())) == 2


@ours
def test_ids_with_a_module_work_everywhere(cls):
    model = cls(
        "MlpPolicy",
        "sb3_rpto:rpto/ContinuousCartPole-v0",
        target_env="sb3_rpto:rpto/ContinuousCartPole-v0",
        policy_kwargs={"net_arch": [8]},
        device="cpu",
    )
    model.set_target_env("sb3_rpto:rpto/ContinuousCartPole-v0")
    assert model.get_env().get_attr("spec")[0].id == "rpto/ContinuousCartPole-v0"


def test_our_wrapper_records_its_constructors_arguments():
    assert issubclass(DynamicsEnv, gym.utils.RecordConstructorArgs)


# ---------------------------------------------------------------------- speed


def test_matmul_precision_is_left_as_it_was():
    before = th.get_float32_matmul_precision()
    build(RPTO, model_train_freq=5).learn(10, source_timesteps=10)
    assert th.get_float32_matmul_precision() == before


def test_versions_are_those_that_the_facts_were_read_from():
    """A newer minor release is no failure, but these facts deserve a second reading then."""
    version = importlib.metadata.version("stable-baselines3")
    if not version.startswith("2.9."):
        warnings.warn(f"the facts were read from stable-baselines3 2.9.2, this is {version}", stacklevel=1)
    assert version.split(".")[0] == "2"
