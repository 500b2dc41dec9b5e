"""The open-loop loss on known linear systems, and the model that is trained by it."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_rpto.baselines import slbo_dynamics
from sb3_rpto.baselines.slbo_dynamics import FARTHEST, DeterministicDynamics, open_loop_loss
from sb3_rpto.dynamics.base import Transitions

A = th.tensor([[0.9, 0.2], [-0.3, 1.1]], dtype=th.float64)
B = th.tensor([[0.5], [-1.0]], dtype=th.float64)
SIGMA = th.tensor([2.0, 0.5], dtype=th.float64)


def linear(a: th.Tensor, b: th.Tensor):
    return lambda observations, actions: observations @ a.T + actions @ b.T


def trajectories(horizon: int, n: int = 7) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """States (H + 1, n, 2) of the true system and its actions (H, n, 1)."""
    generator = th.Generator().manual_seed(1)
    actions = th.randn(horizon, n, 1, generator=generator, dtype=th.float64)
    states = [th.randn(n, 2, generator=generator, dtype=th.float64)]
    for action in actions:
        states.append(linear(A, B)(states[-1], action))
    return th.stack(states), actions


def loss(a: th.Tensor, b: th.Tensor, horizon: int, continues: bool = True) -> th.Tensor:
    states, actions = trajectories(horizon)
    follows = th.full((horizon, states.shape[1]), continues)
    return open_loop_loss(linear(a, b), states[:-1], actions, states[1:], follows, SIGMA)


@pytest.mark.parametrize("horizon", [1, 2, 4])
@pytest.mark.parametrize("continues", [True, False])
def test_it_is_zero_at_the_true_matrices(horizon, continues):
    assert float(loss(A, B, horizon, continues)) == pytest.approx(0, abs=1e-12)


def test_over_two_steps_its_value_is_known():
    """With the matrix A + D: errors D s_0, then D s_1 + (A + D - 1) D s_0, because the first one is fed back."""
    states, _ = trajectories(2)
    d = th.tensor([[0.05, -0.1], [0.2, 0.0]], dtype=th.float64)
    first = states[0] @ d.T
    second = states[1] @ d.T + first @ (A + d - th.eye(2)).T
    expected = ((first / SIGMA).norm(dim=1).mean() + (second / SIGMA).norm(dim=1).mean()) / 2
    th.testing.assert_close(loss(A + d, B, 2), expected)


def test_where_the_data_do_not_go_on_the_next_step_starts_from_its_true_state():
    states, _ = trajectories(2)
    d = th.tensor([[0.05, -0.1], [0.2, 0.0]], dtype=th.float64)
    errors = [(s @ d.T / SIGMA).norm(dim=1).mean() for s in states[:2]]
    th.testing.assert_close(loss(A + d, B, 2, continues=False), sum(errors) / 2)


def test_it_is_a_norm_and_not_its_square():
    d = th.tensor([[0.0], [1.0]], dtype=th.float64)
    th.testing.assert_close(loss(A, B + 3 * d, 1), 3 * loss(A, B + d, 1))


def test_its_gradient_goes_through_what_is_fed_back():
    a = A + 0.1
    a.requires_grad_()
    (gradient,) = th.autograd.grad(loss(a, B, 3), a)
    step = 1e-6 * th.eye(2, dtype=th.float64)[0].outer(th.eye(2, dtype=th.float64)[1])
    slope = (loss(a.detach() + step, B, 3) - loss(a.detach() - step, B, 3)) / 2e-6
    assert float(gradient[0, 1]) == pytest.approx(float(slope), rel=1e-5)


def never(observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor) -> th.Tensor:
    return th.zeros(len(actions), dtype=th.bool)


def make(**kwargs) -> DeterministicDynamics:
    th.manual_seed(0)
    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    settings = {"hidden": (32,), "termination_fn": never, **kwargs}
    return DeterministicDynamics(observation_space, spaces.Box(-1.0, 1.0, (1,)), **settings)


def one_trajectory(n: int = 400) -> Transitions:
    generator = th.Generator().manual_seed(2)
    actions = th.rand(n, 1, generator=generator, dtype=th.float64) * 2 - 1
    states = [th.ones(2, dtype=th.float64)]
    for action in actions:
        states.append(0.5 * states[-1] + B[:, 0] * action)
    s = th.stack(states)
    return Transitions(s[:-1].clone(), actions, s[1:, 0], s[1:], th.zeros(n))


@pytest.mark.slow
def test_it_learns_a_linear_system_and_its_reward():
    model, data = make(), one_trajectory()
    log = model.fit(data, max_steps=600)
    assert log["steps"] == 600
    assert model.error(data) < 0.1
    predicted = model.step(data.observations, data.actions)
    assert (predicted.rewards - data.rewards).abs().mean() < 0.1


def test_the_same_question_has_one_answer():
    model, data = make(), one_trajectory()
    model.fit(data, max_steps=5)
    answers = [model.step(data.observations, data.actions) for _ in range(2)]
    assert th.equal(answers[0].next_observations, answers[1].next_observations)


def test_rows_that_go_on_from_each_other_are_followed_and_no_others(monkeypatch):
    data, seen = one_trajectory(), []
    monkeypatch.setattr(slbo_dynamics, "open_loop_loss", lambda *given: seen.append(given) or open_loop_loss(*given))
    model = make()
    model.fit(data, max_steps=3)
    model.fit(data.take(th.arange(0, 400, 2)), max_steps=3)
    (_, observations, _, following, continues, _), scattered = seen[0], seen[-1]
    assert continues[0].all()
    assert th.equal(following[0], observations[1])
    assert len(observations) == 2
    assert not scattered[4][0].any()


def test_interleaved_rows_of_several_environments_are_followed(monkeypatch):
    data, seen = one_trajectory(), []
    monkeypatch.setattr(slbo_dynamics, "open_loop_loss", lambda *given: seen.append(given) or open_loop_loss(*given))
    order = th.arange(400).reshape(2, 200).T.reshape(-1)  # two halves, row by row
    make().fit(data.take(order), max_steps=3)
    _, observations, _, following, continues, _ = seen[0]
    assert continues[0].float().mean() > 0.95
    assert th.equal(following[0][continues[0]], observations[1][continues[0]])


def test_an_ended_episode_is_not_followed(monkeypatch):
    data = one_trajectory(10)
    data.observations[5] += 1.0  # a reset
    seen = []
    monkeypatch.setattr(slbo_dynamics, "open_loop_loss", lambda *given: seen.append(given) or open_loop_loss(*given))
    make(batch_size=200).fit(data, max_steps=1)
    _, observations, _, following, continues, _ = seen[0]
    assert th.equal(continues[0], (following[0] == observations[1]).all(dim=1))
    assert 0 < continues[0].float().mean() < 1


@pytest.mark.slow
def test_terminations_are_learned_where_the_rule_is_unknown():
    with pytest.warns(UserWarning, match="terminations"):
        model = make(termination_fn=None)
    data = one_trajectory()
    data.terminations.copy_((data.actions[:, 0] > 0).double())
    model.fit(data, max_steps=300)
    answered = model.step(data.observations, data.actions).terminations
    assert (answered == data.terminations.bool()).float().mean() > 0.95


def test_a_prediction_far_beyond_all_data_is_held_back():
    model, data = make(), one_trajectory()
    model.fit(data, max_steps=5)
    far = th.full((1, 2), 1e9, dtype=th.float64)
    held = model.step(far, th.zeros(1, 1, dtype=th.float64)).next_observations
    th.testing.assert_close(held[0].float(), model.input_mean[:2] + FARTHEST * model.input_std[:2])


def test_numbers_out_of_range_are_refused():
    with pytest.raises(ValueError, match="horizon"):
        make(horizon=0)
    with pytest.raises(ValueError, match="at least 2"):
        make().fit(one_trajectory(1))


def test_it_is_an_environments_model():
    from sb3_rpto import DynamicsEnv

    env = gym.make("Pendulum-v1")
    model = DeterministicDynamics(env.observation_space, env.action_space, hidden=(8,), termination_fn=never)
    env = DynamicsEnv(env, model)
    observation, _ = env.reset(seed=0)
    for action in np.float32([[1.5], [-0.7]]):
        answer = model.step(th.as_tensor(observation)[None], th.as_tensor(action)[None])
        observation, reward, terminated, _, _ = env.step(action)
        np.testing.assert_allclose(observation, answer.next_observations[0].numpy(), rtol=1e-6)
        assert reward == pytest.approx(float(answer.rewards[0]))
        assert not terminated
