"""PTP's choice among candidates on known error functions, and what its error network learns."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import pendulum, small

from sb3_rpto.baselines.ptp import PTP, ErrorNetwork, ForeseenBranches, foresee, squared_error
from sb3_rpto.dynamics.base import Prediction, Transitions


def prediction(next_observations: th.Tensor, rewards: th.Tensor | None = None) -> Prediction:
    n = len(next_observations)
    return Prediction(next_observations, th.zeros(n) if rewards is None else rewards, th.zeros(n, dtype=th.bool))


class Candidates:
    """A model on the line: first x + 1, x + 2 ... x + K for the K candidates, then always x + a."""

    def __init__(self, n: int, n_candidates: int) -> None:
        self.offsets = th.arange(1.0, n_candidates + 1).repeat_interleave(n)[:, None]
        self.steps = 0

    def __call__(self, observations: th.Tensor, actions: th.Tensor) -> Prediction:
        self.steps += 1
        following = observations + (self.offsets if self.steps == 1 else actions)
        return prediction(following, rewards=10 * following[:, 0])


def bumpy(observations: th.Tensor, actions: th.Tensor, predicted: Prediction) -> th.Tensor:
    return (7.3 * predicted.next_observations[:, 0]).sin().square()


@pytest.mark.parametrize("horizon", [1, 3])
def test_each_state_keeps_the_candidate_with_the_smallest_sum_of_errors(horizon):
    n, n_candidates = 40, 5
    x = th.linspace(-3, 3, n)[:, None]
    answer = foresee(Candidates(n, n_candidates), lambda s: 0.3 * s, bumpy, x, th.zeros(n, 1), n_candidates, horizon)
    sums = np.zeros((n_candidates, n))
    for k in range(n_candidates):
        state = x[:, 0].numpy() + k + 1
        for _ in range(horizon):
            sums[k] += np.sin(7.3 * state) ** 2
            state = 1.3 * state
    best = sums.argmin(axis=0)
    assert len(set(best)) > 2
    th.testing.assert_close(answer.next_observations[:, 0], x[:, 0] + th.as_tensor(best + 1.0).float())
    th.testing.assert_close(answer.rewards, 10 * answer.next_observations[:, 0])  # of the same candidate


def test_a_candidate_that_looks_best_now_is_left_for_one_that_stays_good():
    """Candidates 1 and 2 err by 0 and 1 now; from 1 the policy leads to errors of 5 a step."""

    def error(observations, actions, predicted):
        known = {1.0: 0.0, 2.0: 1.0, 6.0: 5.0, 11.0: 5.0}
        return th.tensor([known.get(float(x), 0.0) for x in predicted.next_observations[:, 0]])

    def act(states):
        return th.where(states == 2.0, 0.0, 5.0) * (states != 2.0)

    start, none = th.zeros(1, 1), th.zeros(1, 1)
    now = foresee(Candidates(1, 2), act, error, start, none, 2, 1)
    later = foresee(Candidates(1, 2), act, error, start, none, 2, 3)
    assert (float(now.next_observations), float(later.next_observations)) == (1.0, 2.0)


def test_an_early_end_is_no_advantage():
    """A candidate whose episode ends at once is judged by as many errors as the others."""

    class Ending(Candidates):
        def __call__(self, observations, actions):
            answer = super().__call__(observations, actions)
            return answer._replace(terminations=answer.next_observations[:, 0] == 1.0)

    def error(observations, actions, predicted):
        return th.where(predicted.next_observations[:, 0] == 1.0, 1.1, 1.0)

    answer = foresee(Ending(1, 2), lambda s: 0 * s, error, th.zeros(1, 1), th.zeros(1, 1), 2, 4)
    assert float(answer.next_observations) == 2.0
    assert not answer.terminations.any()


def test_the_error_is_that_of_the_state_squared_and_of_the_reward_weighted():
    data = Transitions(
        th.zeros(2, 2), th.zeros(2, 1), th.tensor([1.0, 0.0]), th.tensor([[1.0, 2.0], [0, 0]]), th.zeros(2)
    )
    predicted = prediction(th.tensor([[4.0, 6.0], [0, 0]]), rewards=th.tensor([3.0, 1.0]))
    th.testing.assert_close(squared_error(predicted, data, 0.5), th.tensor([9.0 + 16 + 0.5 * 4, 0.5]))


@pytest.mark.slow
def test_the_error_network_learns_where_the_model_errs():
    generator = th.Generator().manual_seed(0)
    observations, following = th.randn(2, 2000, 3, generator=generator)
    actions = th.randn(2000, 1, generator=generator)
    data = Transitions(observations, actions, th.zeros(2000), observations, th.zeros(2000))
    predicted = prediction(following)
    th.manual_seed(0)
    network = ErrorNetwork(3, 1)
    errors = 1e-4 * (following[:, 0] > 0).float()  # its unit does not matter
    network.fit(data, predicted, errors, 800)
    answer = network(observations, actions, predicted)
    assert np.corrcoef(answer, errors)[0, 1] > 0.9
    assert answer.mean() == pytest.approx(float(errors.mean()), rel=0.2)


@pytest.mark.parametrize("passed", [{}, {"n_candidates": None}])
def test_none_takes_the_papers_number_of_candidates_for_the_task(passed):
    cheetahs = gym.make("HalfCheetah-v5"), gym.make("HalfCheetah-v5")
    model = PTP("MlpPolicy", cheetahs[0], target_env=cheetahs[1], dynamics_kwargs={"hidden": (8,)}, **passed)
    assert model.n_candidates == 6


def test_until_the_first_fit_it_is_mbpo_then_the_network_chooses(monkeypatch):
    model = small(PTP, n_candidates=3, horizon=2, error_steps=5, model_train_freq=30)
    asked = []
    step = model.dynamics.step
    monkeypatch.setattr(model.dynamics, "step", lambda o, a, **k: (asked.append(len(o)), step(o, a, **k))[1])
    model.learn(29, source_timesteps=0)
    assert set(asked) == {8}  # one sample a branch
    assert not model.errors.fitted
    asked.clear()
    model.learn(6, reset_num_timesteps=False)
    assert model.errors.fitted
    assert asked[-2:] == [3 * 8, 3 * 8]  # three candidates, two steps
    assert model.num_timesteps == 35


def test_the_network_is_fitted_to_the_models_errors_on_real_data(monkeypatch):
    model = small(PTP, error_steps=5, beta=2.0, model_train_freq=30)
    seen = {}
    monkeypatch.setattr(ErrorNetwork, "fit", lambda self, *given: seen.update(given=given) or 0.0)
    model.learn(30, source_timesteps=0)
    data, predicted, errors, n_steps = seen["given"]
    th.testing.assert_close(data.next_observations, model.transitions("target").next_observations)
    th.testing.assert_close(errors, squared_error(predicted, data, 2.0))
    assert n_steps == 5


def test_a_checkpoint_keeps_the_error_network(tmp_path):
    model = small(PTP, error_steps=5, model_train_freq=30).learn(30, source_timesteps=0)
    model.save(tmp_path / "m.zip")
    loaded = PTP.load(tmp_path / "m.zip", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    for name, value in model.errors.state_dict().items():
        assert th.equal(value, loaded.errors.state_dict()[name]), name
    assert loaded.errors.optimizer.state_dict()["state"]
    assert isinstance(loaded.make_rollouts(), ForeseenBranches)


def test_numbers_are_the_papers_and_must_be_positive():
    assert PTP.published("HalfCheetah-v5")["n_candidates"] == 6
    assert PTP("MlpPolicy", pendulum()).n_candidates == 4
    assert PTP("MlpPolicy", pendulum(), n_candidates=3).n_candidates == 3
    with pytest.raises(ValueError, match="horizon"):
        PTP("MlpPolicy", pendulum(), horizon=0)
