"""MBPO is RTO's machinery without weights, with one batch for critic and actor."""

import numpy as np
import pytest
import torch as th
from conftest import SMALL_ENSEMBLE, SMALL_POLICY, pendulum, small

from sb3_rpto import RPTO, RTO
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.buffers import chronological

PUBLISHED_FIT = {**SMALL_ENSEMBLE, "patience": 5, "noise": True}  # the default preset asks for the mean
UNWEIGHTED = {"weighting": None, "rollout_start": "target", "real_ratio": 0.05, "dynamics_kwargs": PUBLISHED_FIT}


def assert_same_worlds(ours, theirs):
    for world in ("source", "target"):
        sides = [chronological(model.replay_buffer.side(world)) for model in (ours, theirs)]
        for name, array in sides[0].items():
            np.testing.assert_array_equal(array, sides[1][name])
    for name, value in ours.dynamics.networks.state_dict().items():
        assert th.equal(value, theirs.dynamics.networks.state_dict()[name]), name


@pytest.mark.slow
def test_model_and_data_are_rtos_without_weights():
    """The same seed and a policy that stays: the same numbers in D_source, in D_target and in the model."""
    ours = small(MBPO, gradient_steps=0).learn(120, source_timesteps=0)
    theirs = small(RTO, gradient_steps=0, **UNWEIGHTED).learn(120, source_timesteps=0)
    assert_same_worlds(ours, theirs)


@pytest.mark.slow
def test_with_the_critics_batch_for_the_actor_rpto_without_weights_is_mbpo(monkeypatch):
    ours = small(MBPO).learn(60, source_timesteps=0)
    theirs = small(RPTO, **UNWEIGHTED)
    batches = theirs.critic_batches
    monkeypatch.setattr(theirs, "sample_batches", lambda *numbers: ((batch, batch) for batch in batches(*numbers)))
    theirs.learn(60, source_timesteps=0)
    assert_same_worlds(ours, theirs)
    for name, value in ours.policy.state_dict().items():
        assert th.equal(value, theirs.policy.state_dict()[name]), name


def test_critic_and_actor_learn_from_the_same_batches_of_model_data_and_a_share_of_real_ones():
    model = small(MBPO, real_ratio=0.25).learn(64, source_timesteps=0)
    model.replay_buffer.source.rewards[:] = 0.0
    model.replay_buffer.target.rewards[:] = 1.0
    for critic_batch, actor_batch in model.sample_batches(5, 32):
        assert actor_batch is critic_batch
        assert critic_batch.rewards.sum() == 8


def test_branches_start_from_states_of_the_target():
    model = small(MBPO).learn(60, source_timesteps=0)
    newest = chronological(model.replay_buffer.source)["observations"][-8:]
    seen = chronological(model.replay_buffer.target)["observations"]
    assert all((seen == state).all(axis=1).any() for state in newest)


def test_the_published_numbers_fill_in_what_is_not_passed():
    assert MBPO.published("HalfCheetah-v5")["gradient_steps"] == 40
    assert MBPO.published("rpto/HalfCheetah-v0")["gradient_steps"] == 40
    assert MBPO.published("sb3_rpto:rpto/Hopper-v0")["gradient_steps"] == MBPO.published(None)["gradient_steps"] == 20
    model = MBPO("MlpPolicy", pendulum(), model_train_freq=7, policy_kwargs=SMALL_POLICY)
    assert (model.gradient_steps, model.source_steps, model.buffer_size, model.real_ratio) == (20, 400, 400_000, 0.05)
    assert (model.model_train_freq, model.rollout_start, model.weighting) == (7, "target", None)


@pytest.mark.parametrize(
    "argument", [{"weighting": "paper"}, {"weight_floor": 1.0}, {"preset": "paper"}, {"declared": ["pole.mass"]}]
)
def test_arguments_without_a_meaning_are_refused(argument):
    with pytest.raises(ValueError, match=f"MBPO does not use.*{next(iter(argument))}"):
        MBPO("MlpPolicy", pendulum(), **argument)


@pytest.mark.slow
def test_it_resumes_where_a_checkpoint_left_it(tmp_path):
    whole = small(MBPO).learn(60, source_timesteps=0)
    half = small(MBPO).learn(30, source_timesteps=0)
    half.save(tmp_path / "m.zip")
    half.save_replay_buffer(tmp_path / "b.pkl")
    resumed = MBPO.load(tmp_path / "m.zip", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    resumed.load_replay_buffer(tmp_path / "b.pkl")
    resumed.learn(30, reset_num_timesteps=False)
    assert_same_worlds(whole, resumed)
    assert resumed.target_spent == {"learning": 60}
