"""PDML's sampler: its weights in closed form, and that they reach the fits and the starts."""

import copy

import numpy as np
import pytest
import torch as th
from conftest import pendulum, small
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Independent, Normal, kl_divergence

from sb3_rpto.baselines.pdml import PDML, AdaptedBranches, Block, block_shares, gaussian_distance


def test_an_older_block_weighs_one_over_its_distance_and_the_newest_as_much_as_the_heaviest():
    np.testing.assert_allclose(block_shares([2.0, 1.0], 0.02), [1 / 5, 2 / 5, 2 / 5])
    np.testing.assert_allclose(block_shares([], 0.02), [1.0])


def test_the_newest_block_is_guaranteed_its_share():
    """Of a hundred equal blocks none weighs 2 %: the guarantee holds, rho / (1 - rho) of all others together."""
    shares = block_shares(np.ones(100), 0.02)
    assert shares[-1] == pytest.approx(0.02)
    assert shares[-1] / shares[:-1].sum() == pytest.approx(0.02 / 0.98)


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=60), st.floats(0.0, 0.5))
def test_shares_are_a_distribution_in_proportion_to_closeness(distances, rho):
    shares = block_shares(distances, rho)
    assert shares.sum() == pytest.approx(1.0)
    assert shares[-1] >= rho - 1e-9
    assert shares[-1] >= shares.max() - 1e-12
    np.testing.assert_allclose(shares[:-1] * distances, shares[0] * distances[0], rtol=1e-6)


def test_the_distance_is_pinskers_bound_of_the_total_variation():
    generator = th.Generator().manual_seed(0)
    mean, log_std, other_mean, other_log_std = th.randn(4, 50, 3, generator=generator)
    first = Independent(Normal(mean, log_std.exp()), 1)
    second = Independent(Normal(other_mean, other_log_std.exp()), 1)
    expected = (kl_divergence(first, second) / 2).sqrt()
    th.testing.assert_close(gaussian_distance(mean, log_std, other_mean, other_log_std), expected, rtol=1e-4, atol=1e-5)
    th.testing.assert_close(gaussian_distance(mean, log_std, mean, log_std), th.zeros(50))


def with_constant_noise(model, std: float = 0.5):
    """The policy's standard deviation is the same everywhere."""
    model.actor.log_std.weight.data.zero_()
    model.actor.log_std.bias.data.fill_(np.log(std))
    return model


def test_the_distance_of_a_shifted_mean_is_known():
    """KL = (delta / sigma)^2 / 2, the distance delta / (2 sigma)."""
    model = with_constant_noise(small(PDML).learn(40, source_timesteps=0))
    block = Block(40, copy.deepcopy(model.actor.state_dict()))
    assert model.distance(block) == 0
    model.actor.mu.bias.data += 0.1
    before = copy.deepcopy(model.actor.state_dict())
    assert model.distance(block) == pytest.approx(0.1 / (2 * 0.5), rel=1e-4)
    assert all(th.equal(before[name], value) for name, value in model.actor.state_dict().items())


def with_blocks(target_size: int, collected: int):
    """Blocks of 3 and 2 target steps, and 2 since; the shares are 0.2 and 0.8."""
    model = small(PDML, replay_buffer_kwargs={"target_size": target_size})
    model.learn(collected, source_timesteps=0)
    model.blocks, model.shares, model.steps_since_block = [Block(3, {}), Block(2, {})], np.array([0.2, 0.8]), 2
    return model


def test_a_blocks_share_is_divided_among_its_steps():
    model = with_blocks(100, 7)
    each = np.array([0.2 / 3] * 3 + [0.4] * 4)  # steps since the last block weigh as the newest block's
    np.testing.assert_allclose(model.row_weights(7), each / each.sum())
    np.testing.assert_allclose(model.row_weights(5), each[-5:] / each[-5:].sum())


@pytest.mark.parametrize("target_size", [100, 7], ids=["growing", "full"])
def test_branches_start_where_the_weights_say(target_size):
    model = with_blocks(target_size, 7 if target_size == 100 else 10)
    side = model.replay_buffer.target
    np.random.seed(0)
    rows = AdaptedBranches(model.dynamics, "target").target_rows(model, 20_000)
    order = (np.arange(7) + (side.pos if side.full else 0)) % 7  # oldest first
    drawn = np.bincount(rows, minlength=7)[order] / len(rows)
    np.testing.assert_allclose(drawn, model.row_weights(7), atol=0.015)


def test_in_a_run_the_weights_feed_the_fits(monkeypatch):
    model = small(PDML, block_steps=20, model_train_freq=20, gradient_steps=2)
    given_weights = []
    fit = model.dynamics.fit

    def spy(data, weights=None, max_steps=None):
        given_weights.append(None if weights is None else weights.numpy())
        return fit(data, weights, max_steps)

    monkeypatch.setattr(model.dynamics, "fit", spy)
    model.learn(70, source_timesteps=0)
    assert model.num_timesteps == 70
    assert [block.size for block in model.blocks] == [20, 20, 20]
    phi_0, first, second, third = given_weights
    assert phi_0 is None
    np.testing.assert_allclose(first, np.ones(20))
    assert len(np.unique(second.round(6))) == 1  # the older of two blocks is the heaviest of the others
    distances = [np.unique(third[rows]) for rows in (slice(0, 20), slice(20, 40), slice(40, 60))]
    oldest, middle, newest = (float(values) for (values,) in distances)
    assert oldest < middle == pytest.approx(newest)  # the policy moved away from the older one
    assert third.mean() == pytest.approx(1)


def test_a_checkpoint_keeps_the_blocks(tmp_path):
    model = small(PDML, block_steps=20).learn(50, source_timesteps=0)
    model.save(tmp_path / "m.zip")
    loaded = PDML.load(tmp_path / "m.zip", env=pendulum(), target_env=pendulum(12.0))
    np.testing.assert_array_equal(loaded.row_weights(50), model.row_weights(50))
    assert loaded.distance.__self__.blocks[0].actor.keys() == model.actor.state_dict().keys()


def test_another_target_has_no_blocks_yet():
    model = small(PDML, block_steps=20).learn(50, source_timesteps=0)
    with pytest.warns(UserWarning, match="D_target loses 50 transitions"):
        model.set_target_env(pendulum(13.0))
    assert model.blocks == []
    np.testing.assert_allclose(model.row_weights(5), 0.2)


def test_what_it_cannot_do_is_refused():
    with pytest.raises(ValueError, match="newest_share"):
        PDML("MlpPolicy", pendulum(), newest_share=1.0)
    with pytest.raises(ValueError, match="block_steps"):
        PDML("MlpPolicy", pendulum(), block_steps=0)
    with pytest.raises(ValueError, match="target_data"):
        PDML("MlpPolicy", pendulum(), target_data="log.npz")
    with pytest.raises(NotImplementedError, match="use_sde"):
        PDML("MlpPolicy", pendulum(), use_sde=True)
