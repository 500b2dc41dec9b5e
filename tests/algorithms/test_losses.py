"""SB3's own SAC is the oracle of the update."""

import copy

import numpy as np
import pytest
import torch as th
from conftest import ALGORITHMS, pendulum, small
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms.batches import ALTERNATION, GATHERED
from sb3_rpto.algorithms.fast_update import OptimizerStep
from sb3_rpto.algorithms.losses import sample_actions
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.weights import rto_weights


def filled_sac(**kwargs) -> SAC:
    sac = SAC(
        "MlpPolicy",
        pendulum(),
        policy_kwargs={"net_arch": [16]},
        batch_size=32,
        learning_starts=40,
        seed=0,
        device="cpu",
        **kwargs,
    )
    return sac.learn(60)


def twin_of(cls, sac: SAC, monkeypatch, **kwargs):
    """One of ours with SAC's state, which sees SAC's minibatches."""
    model = cls.from_source(sac, pendulum(), pendulum(12.0), seed=1, device="cpu", **kwargs)
    model.set_logger(configure(None, []))

    def batches(count, batch_size):
        for _ in range(count):
            batch = sac.replay_buffer.sample(batch_size, env=sac.get_vec_normalize_env())
            yield batch, batch

    monkeypatch.setattr(model, "sample_batches", batches)
    return model


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"ent_coef": 0.2},
        {"ent_coef": "auto_0.5", "target_update_interval": 3},
        {"use_sde": True},
        {"learning_rate": lambda left: 1e-3 * left + 1e-4},
    ],
    ids=["auto", "fixed", "interval", "gsde", "schedule"],
)
def test_given_the_same_minibatches_the_update_is_sacs(kwargs, monkeypatch):
    sac = filled_sac(**kwargs)
    taken_over = {name: value for name, value in kwargs.items() if name == "target_update_interval"}
    model = twin_of(RPO, sac, monkeypatch, **taken_over)
    before = copy.deepcopy(sac.policy.state_dict())
    for algorithm in (sac, model):
        np.random.seed(3)
        th.manual_seed(3)
        algorithm._current_progress_remaining = 0.5
        algorithm.train(gradient_steps=100, batch_size=32)
    for name, theirs in sac.policy.state_dict().items():
        moved = (theirs - before[name]).norm()
        assert moved > 0, name
        assert (model.policy.state_dict()[name] - theirs).norm() < 1e-3 * moved, name
    alpha = sac.log_ent_coef.exp() if sac.log_ent_coef is not None else sac.ent_coef_tensor
    assert model.temperature().item() == pytest.approx(alpha.item(), rel=1e-5)
    for name in ("train/actor_loss", "train/critic_loss", "train/learning_rate"):
        assert model.logger.name_to_value[name] == pytest.approx(sac.logger.name_to_value[name], rel=1e-4), name


def test_rto_moves_the_critic_and_leaves_policy_and_temperature(monkeypatch):
    sac = filled_sac()
    model = twin_of(RTO, sac, monkeypatch, dynamics_kwargs={"hidden": (16,)})
    before = copy.deepcopy(model.policy.state_dict())
    alpha = model.temperature()
    model.train(10, 32)
    after = model.policy.state_dict()
    assert all(th.equal(before[name], after[name]) for name in before if name.startswith("actor"))
    assert any(not th.equal(before[name], after[name]) for name in before if name.startswith("critic."))
    assert model.temperature() == alpha


@pytest.mark.parametrize("cls", [RPO, RPTO])
def test_the_actor_alternates_four_target_batches_and_one_source_batch(cls):
    model = small(cls)
    model.learn(64, source_timesteps=0)
    model.replay_buffer.source.rewards[:] = -1.0
    model.replay_buffer.target.rewards[:] = 1.0
    worlds = [actor.rewards.mean().item() for _, actor in model.sample_batches(2 * ALTERNATION - 3, 32)]
    worlds += [actor.rewards.mean().item() for _, actor in model.sample_batches(3, 32)]  # it goes on where it was
    assert sorted(worlds[:ALTERNATION]) == [-1, 1, 1, 1, 1]
    assert worlds[:ALTERNATION] == worlds[ALTERNATION:]


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize(("ratio", "expected"), [(0.0, 0), (0.05, 2), (0.5, 16)])
def test_the_critics_batch_holds_the_real_ratio_of_target_transitions(cls, ratio, expected):
    model = small(cls, real_ratio=ratio)
    model.learn(64, source_timesteps=0)
    model.replay_buffer.source.rewards[:] = 0.0
    model.replay_buffer.target.rewards[:] = 1.0
    ((critic_batch, _),) = model.sample_batches(1, 32)
    assert len(critic_batch.rewards) == 32
    assert critic_batch.rewards.sum() == expected


def normalised_pendulum() -> VecNormalize:
    """Observations about a mean of 3 with a standard deviation of 2, rewards a fifth and clipped at 1."""
    env = VecNormalize(make_vec_env(pendulum), training=False, clip_reward=1.0)
    env.obs_rms.mean, env.obs_rms.var, env.ret_rms.var = np.full(3, 3.0), np.full(3, 4.0), np.float64(25.0)
    return env


@pytest.mark.parametrize("normalised", [False, True])
def test_values_for_the_weights_are_the_target_critics(normalised):
    model = small(RPTO, normalised_pendulum() if normalised else None, ent_coef=0.1)
    raw = th.randn(50, 3)
    observations = (raw - 3) / 2 if normalised else raw
    th.manual_seed(0)
    ours = model.soft_value(raw)
    th.manual_seed(0)
    with th.no_grad():
        actions, log_prob = model.actor.action_log_prob(observations)
        q1, q2 = model.critic_target(observations, actions)
    th.testing.assert_close(ours, th.minimum(q1, q2)[:, 0] - 0.1 * log_prob)
    # Pendulum's torque is within 2 N m, the critic sees actions in [-1, 1]
    th.testing.assert_close(
        model.q_value(raw, 2 * actions), th.minimum(*model.critic_target(observations, actions))[:, 0]
    )


@pytest.mark.parametrize("weighting", ["paper", "centred", "value_aware"])
def test_weights_are_of_rewards_as_the_critic_knows_them(weighting):
    model = small(RPTO, normalised_pendulum(), weighting=weighting, weight_floor=0.0)
    model.learn(60, source_timesteps=0)
    data = model.transitions("target")
    shown = (data.rewards / 25**0.5).clamp(-1, 1)
    assert ((shown > -1) & (shown < 0)).any()
    known = Transitions(data.observations, data.actions, shown, data.next_observations, data.terminations)
    found = []
    for each in (
        model.fit_weights,
        lambda _: rto_weights(weighting, known, model.dynamics, model.soft_value, model.q_value, model.gamma, 0.0),
    ):
        th.manual_seed(0)
        model.dynamics.seed(0)
        found.append(each(data))
    th.testing.assert_close(*found)
    assert found[0].std() > 0


def test_a_policy_that_draws_its_actions_itself_is_asked():
    class Own(Actor):
        def action_log_prob(self, obs):
            return th.full((len(obs), 1), 0.25), th.full((len(obs),), -3.0)

    class OwnPolicy(SACPolicy):
        def make_actor(self, features_extractor=None):
            kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
            return Own(**kwargs).to(self.device)

    model = small(RPTO)
    own = OwnPolicy(model.observation_space, model.action_space, lambda _: 1e-3).actor
    actions, log_prob = sample_actions(own, th.zeros(5, 3))
    assert (actions == 0.25).all()
    assert actions.shape == (5, 1)
    assert (log_prob == -3.0).all()
    assert log_prob.shape == (5, 1)


def test_what_does_not_fit_is_gathered_in_parts(monkeypatch):
    model = small(RPO)
    model.learn(64, source_timesteps=0)
    counts, batches = [], model.sample_batches
    monkeypatch.setattr(model, "sample_batches", lambda count, size: (counts.append(count), batches(count, size))[1])
    model.train(5, GATHERED // 2)
    assert counts == [2, 2, 1]


def test_adam_with_options_of_the_users_steps_as_it_is():
    weights = [th.nn.Parameter(th.tensor([1.0, -2.0])) for _ in range(2)]
    theirs, ours = (th.optim.Adam([w], lr=0.1, amsgrad=True) for w in weights)
    descend = OptimizerStep(ours)
    for step in range(5):
        theirs.zero_grad()
        ((step - 2) * weights[0].square()).sum().backward()
        theirs.step()
        descend(((step - 2) * weights[1].square()).sum())
    assert th.equal(weights[0], weights[1])
    assert th.equal(theirs.state[weights[0]]["max_exp_avg_sq"], ours.state[weights[1]]["max_exp_avg_sq"])
