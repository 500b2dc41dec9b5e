"""Autograd is the oracle of the gradients that are written out."""

import pytest
import torch as th
from conftest import small
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common import policies
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_rpto import RPO, RTO
from sb3_rpto.algorithms.fast_update import ManualUpdate, OptimizerStep, OptimizerSteps, supports_manual_gradients

widths = st.lists(st.integers(1, 9), min_size=1, max_size=3)


class Recorded(OptimizerStep):
    """Keeps the gradients instead of stepping down them."""

    def step(self, gradients):
        self.gradients = gradients


def batch(n: int, seed: int) -> ReplayBufferSamples:
    rows = th.Generator().manual_seed(seed)
    draw = [th.randn(n, d, generator=rows, dtype=th.float64) for d in (3, 1, 3)]
    dones = (th.rand(n, 1, generator=rows) < 0.3).double()
    return ReplayBufferSamples(draw[0], draw[1].tanh(), draw[2], dones, draw[0][:, :1])


def recorded(model, update):
    """Losses and gradients of one update that moves nothing."""
    steps = OptimizerSteps(*(Recorded(o) for o in (model.actor.optimizer, model.critic.optimizer)))
    if model.ent_coef_optimizer is not None:
        steps = steps._replace(ent_coef=Recorded(model.ent_coef_optimizer))
    th.manual_seed(5)
    losses = update(batch(20, 0), batch(11, 1), steps)
    return losses, [getattr(step, "gradients", None) for step in steps if step is not None]


@given(
    actor=widths,
    critic=widths,
    n_critics=st.integers(1, 3),
    ent_coef=st.sampled_from(["auto", 0.3]),
    log_std=st.sampled_from([-25.0, 0.0, 1.9]),
    cls=st.sampled_from([RPO, RTO]),
)
def test_losses_and_gradients_are_autograds(actor, critic, n_critics, ent_coef, log_std, cls):
    arch = {"net_arch": {"pi": actor, "qf": critic}, "n_critics": n_critics}
    model = small(cls, policy_kwargs=arch, ent_coef=ent_coef)
    model.policy.double()
    model.actor.log_std.bias.data += log_std  # within SB3's bounds, at one, or beyond one
    assert supports_manual_gradients(model.policy)
    with pytest.MonkeyPatch.context() as patch:  # SB3 would make float32 of the observations
        patch.setattr(policies, "preprocess_obs", lambda obs, *_, **__: obs)
        losses, gradients = recorded(model, model.update_once)
    manual = ManualUpdate(model.policy, model.log_ent_coef, model.target_entropy, model.gamma)

    def without_autograd(critic_batch, actor_batch, steps):
        learned_from = actor_batch if model.policy_learns else None
        return manual(critic_batch, learned_from, model.temperature(), steps)

    written_losses, written = recorded(model, without_autograd)
    assert losses.keys() == written_losses.keys()
    for name, loss in losses.items():
        th.testing.assert_close(written_losses[name].reshape(()), loss.detach().reshape(()))
    for theirs, ours in zip(gradients, written, strict=True):
        assert (theirs is None) == (ours is None)
        if theirs is not None:
            th.testing.assert_close(list(ours), list(theirs), check_dtype=False)  # log alpha is float32


class OwnExtractor(FlattenExtractor):
    pass


def _freeze(model):
    model.critic.q_networks[0][0].weight.requires_grad = False


def _hook(model):
    model.actor.latent_pi[0].register_forward_hook(lambda *seen: None)


def _gradient_hook(model):
    model.actor.mu.weight.register_hook(lambda gradient: None)


def _accumulated_hook(model):
    model.critic.q_networks[1][0].bias.register_post_accumulate_grad_hook(lambda parameter: None)


def _own_layer(model):
    model.actor.mu = nn.Sequential(model.actor.mu)


def _turned(model):
    model.critic.optimizer.param_groups[0]["params"].reverse()


@pytest.mark.parametrize("change", [_freeze, _hook, _gradient_hook, _accumulated_hook, _own_layer, _turned])
def test_networks_that_were_changed_go_through_autograd(change):
    model = small(RPO)
    assert supports_manual_gradients(model.policy)
    change(model)
    assert not supports_manual_gradients(model.policy)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"policy_kwargs": {"net_arch": [16], "activation_fn": nn.Tanh}},
        {"policy_kwargs": {"net_arch": {"pi": [], "qf": [16]}}},
        {"policy_kwargs": {"net_arch": [16], "features_extractor_class": OwnExtractor}},
        {"use_sde": True},
    ],
    ids=["tanh", "no-hidden-layer", "own-extractor", "gsde"],
)
def test_other_networks_go_through_autograd_and_learn(kwargs):
    model = small(RPO, **kwargs)
    assert not supports_manual_gradients(model.policy)
    before = next(model.actor.mu.parameters()).detach().clone()
    model.learn(64, source_timesteps=0)
    assert not th.equal(before, next(model.actor.mu.parameters()))


@pytest.mark.parametrize("name", ["critic_loss", "actor_loss", "temperature_loss", "update_once"])
def test_losses_of_a_subclass_are_what_is_descended(name):
    asked = []

    def own(self, *given):
        asked.append(name)
        return getattr(RPO, name)(self, *given)

    model = small(type("Own", (RPO,), {name: own}))
    model.learn(64, source_timesteps=0)
    assert len(asked) == model._n_updates > 0


@pytest.mark.slow
def test_losses_put_in_place_of_a_models_are_what_is_descended(monkeypatch):
    model, asked = small(RPO), []
    monkeypatch.setattr(model, "critic_loss", lambda *given: (asked.append(1), RPO.critic_loss(model, *given))[1])
    model.learn(64, source_timesteps=0)
    assert len(asked) == model._n_updates > 0


def learned():
    """A model that has begun to learn, so that its optimizers have their state."""
    return small(RPO).learn(24, source_timesteps=0)


def weights(*modules):
    return [parameter.detach().clone() for module in modules for parameter in module.parameters()]


@pytest.mark.parametrize("network", ["actor", "critic"])
@pytest.mark.parametrize("begun", [False, True])
def test_frozen_layers_stay_and_the_rest_learns(network, begun):
    model = learned() if begun else small(RPO)
    layers = [layer for layer in getattr(model, network).modules() if isinstance(layer, nn.Linear)]
    layers[0].requires_grad_(False)
    frozen, rest = weights(layers[0]), weights(*layers[1:])
    model.learn(24, source_timesteps=0, reset_num_timesteps=False)
    assert all(map(th.equal, frozen, weights(layers[0])))
    assert not any(map(th.equal, rest, weights(*layers[1:])))


def test_layers_that_are_frozen_in_turns_learn_in_turns():
    model = small(RPO, policy_kwargs={"net_arch": [16, 16]})
    trunk, heads = model.actor.latent_pi, (model.actor.mu, model.actor.log_std)
    trunk.requires_grad_(False)
    model.learn(24, source_timesteps=0)
    for still, moving in ((heads, [trunk]), ([trunk], heads)):
        for module in (*still, *moving):
            module.requires_grad_(module in moving)
        stays, moves = weights(*still), weights(*moving)
        model.learn(24, source_timesteps=0, reset_num_timesteps=False)
        assert all(map(th.equal, stays, weights(*still)))
        assert not any(map(th.equal, moves, weights(*moving)))


class FrozenExtractor(FlattenExtractor):
    """Features of a network that was trained elsewhere."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.layer = nn.Linear(self.features_dim, self.features_dim).requires_grad_(False)

    def forward(self, observations):
        return self.layer(super().forward(observations))


def test_features_that_are_given_stay_and_a_frozen_actor_too():
    model = small(RPO, policy_kwargs={"net_arch": [16], "features_extractor_class": FrozenExtractor})
    model.actor.requires_grad_(False)
    stays, moves = weights(model.actor, model.critic.features_extractor), weights(*model.critic.q_networks)
    model.learn(24, source_timesteps=0)
    assert all(map(th.equal, stays, weights(model.actor, model.critic.features_extractor)))
    assert not any(map(th.equal, moves, weights(*model.critic.q_networks)))


def test_hooks_of_parameters_act_on_their_gradients():
    model, seen = learned(), []
    head = model.actor.mu.weight
    head.register_hook(lambda gradient: seen.append("before") or 0 * gradient)
    head.register_post_accumulate_grad_hook(lambda parameter: seen.append(float(parameter.grad.abs().max())))
    model.actor.optimizer.state[head]["exp_avg"].zero_()
    before, others = head.detach().clone(), weights(model.actor.latent_pi)
    model.train(2, 32)
    assert seen == ["before", 0.0] * 2
    assert th.equal(head, before)
    assert not any(map(th.equal, others, weights(model.actor.latent_pi)))


@pytest.mark.parametrize("extractor", [FlattenExtractor, OwnExtractor])
def test_callbacks_see_the_last_gradients(extractor):
    seen = []

    def norms(values, _):
        model = values["self"]
        parameters = [*model.actor.parameters(), *model.critic.parameters()]
        seen.append([p.grad is not None and bool(p.grad.any()) for p in parameters])
        return True

    small(RPO, policy_kwargs={"net_arch": [16], "features_extractor_class": extractor}).learn(
        24, norms, 1, source_timesteps=0
    )
    assert all(any(row) for row in seen[-8:])
    assert sum(seen[-1]) >= len(seen[-1]) - 2  # a unit may be dead
