import copy
import math
import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.ensemble import EnsembleDynamics

OBS, ACT = 3, 2


def never(observations, actions, next_observations):
    return th.zeros(len(observations), dtype=th.bool)


def make(seed: int = 0, **kwargs) -> EnsembleDynamics:
    th.manual_seed(seed)
    options = {"termination_fn": never, "n_members": 4, "n_elites": 3, "hidden": (32, 32), **kwargs}
    if options["termination_fn"] is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            model = EnsembleDynamics(spaces.Box(-9, 9, (OBS,)), spaces.Box(-1, 1, (ACT,)), **options)
    else:
        model = EnsembleDynamics(spaces.Box(-9, 9, (OBS,)), spaces.Box(-1, 1, (ACT,)), **options)
    model.seed(seed)
    return model


def linear(n: int, noise: float = 0.1, seed: int = 0, dtype: th.dtype = th.float64) -> Transitions:
    """A linear-Gaussian world with a reward that is linear too."""
    generator = th.Generator().manual_seed(seed)
    observations = th.randn(n, OBS, generator=generator, dtype=dtype)
    actions = 2 * th.rand(n, ACT, generator=generator, dtype=dtype) - 1
    matrix = th.tensor(
        [[0.3, -0.2, 0.1], [0.1, 0.2, 0.4], [-0.3, 0.1, 0.2], [0.5, 0.1, 0.0], [0.0, 0.4, 0.6]], dtype=dtype
    )
    change = th.cat([observations, actions], dim=1) @ matrix
    change = change + noise * th.randn(n, OBS, generator=generator, dtype=dtype)
    rewards = observations[:, 0] - actions[:, 1]
    ended = (observations[:, 0] + actions[:, 0] > 1.0).to(dtype)
    return Transitions(observations, actions, rewards, observations + change, ended)


def replace(data: Transitions, **fields: th.Tensor) -> Transitions:
    return Transitions(**{**data.__dict__, **fields})


def exact_noise_free(model: EnsembleDynamics) -> None:
    """Leave the members' Gaussians no width."""
    with th.no_grad():
        model.networks.max_log_variance.fill_(-60.0)
        model.networks.min_log_variance.fill_(-80.0)


def members_alone(model: EnsembleDynamics, data: Transitions) -> list[dict[str, th.Tensor]]:
    """The same networks one by one, in numpy, written from the definitions."""

    def softplus(x):
        return np.logaddexp(0.0, x)

    answers = []
    x = th.cat([data.observations, data.actions], dim=1).numpy()
    y = th.cat([data.next_observations - data.observations, data.rewards[:, None]], dim=1).numpy()
    state = {name: value.double().numpy() for name, value in model.state_dict().items() if isinstance(value, th.Tensor)}
    x = (x - state["input_mean"]) / state["input_std"]
    y = (y - state["target_mean"]) / state["target_std"]
    n_layers = len(model.networks.weights)
    for m in range(model.n_members):
        h = x
        for i in range(n_layers):
            h = h @ state[f"networks.weights.{i}"][m] + state[f"networks.biases.{i}"][m]
            if i < n_layers - 1:
                h = h / (1.0 + np.exp(-h))
        mean, raw, logit = h[:, : OBS + 1], h[:, OBS + 1 : 2 * OBS + 2], h[:, 2 * OBS + 2 :]
        high, low = state["networks.max_log_variance"][m], state["networks.min_log_variance"][m]
        log_variance = high - softplus(high - raw)
        log_variance = low + softplus(log_variance - low)
        density = np.exp(-((y - mean) ** 2) / (2 * np.exp(log_variance))) / np.sqrt(2 * np.pi * np.exp(log_variance))
        with np.errstate(divide="ignore"):
            terms = [-np.log(density)]
        squares = [(y - mean) ** 2]
        if logit.shape[1]:
            p, d = 1 / (1 + np.exp(-logit)), data.terminations.numpy()[:, None]
            terms.append(-(d * np.log(p) + (1 - d) * np.log(1 - p)))
            squares.append((p - d) ** 2)
        answers.append(
            {
                "mean": mean * state["target_std"] + state["target_mean"],
                "log_variance": log_variance,
                "nll": np.concatenate(terms, axis=1).mean(axis=1),
                "squared_error": np.concatenate(squares, axis=1).mean(axis=1),
            }
        )
    return answers


# ------------------------------------------------------------------- networks


@pytest.mark.parametrize("termination_fn", [never, None])
def test_nll_and_error_equal_those_of_the_members_alone(termination_fn):
    model = make(termination_fn=termination_fn)
    data = linear(300)
    model.fit(data, max_steps=30)
    examples = model._prepare(data, None)
    held = model.holdout_mask(th.arange(300))
    alone = members_alone(model, data)
    for part, mask in zip(examples, (~held, held)):
        heads = model.networks(part.inputs.expand(model.n_members, -1, -1))
        for got, name in ((heads.nll, "nll"), (heads.squared_error, "squared_error")):
            expected = np.stack([member[name][mask] for member in alone])
            np.testing.assert_allclose(got(part.targets, part.terminations).detach(), expected, rtol=2e-4, atol=1e-5)


def test_one_gradient_step_equals_that_of_each_member_alone():
    """Members share nothing: Adam on one of them alone makes the same move."""
    model = make(batch_size=512)
    data, weights = linear(400), th.rand(400) + 0.5
    train, _ = model._prepare(data, weights)
    alone = [copy.deepcopy(model.networks) for _ in range(model.n_members)]
    model._train_epoch(train, 1)
    for m, networks in enumerate(alone):
        decays = [2.5e-5, 5e-5, 1e-4]
        groups = [{"params": [w], "weight_decay": d} for w, d in zip(networks.weights, decays)]
        bounds = [networks.min_log_variance, networks.max_log_variance]
        optimizer = th.optim.Adam([*groups, {"params": [*networks.biases, *bounds]}], lr=1e-3)
        heads = networks(train.inputs.expand(model.n_members, -1, -1))
        square = (heads.mean[m] - train.targets) ** 2
        # MBPO's loss, of one member
        loss = (train.weights[:, None] * (square * th.exp(-heads.log_variance[m]) + heads.log_variance[m])).mean()
        loss = loss + 0.01 * (bounds[1][m].sum() - bounds[0][m].sum())
        loss.backward()
        optimizer.step()
        for moved, expected in zip(model.networks.parameters(), networks.parameters()):
            th.testing.assert_close(moved[m], expected[m], rtol=1e-4, atol=2e-5)


def test_initial_weights_are_a_truncated_normal():
    model = make(hidden=(400, 400))
    weight = model.networks.weights[1]
    sigma = 1 / (2 * math.sqrt(400))
    assert weight.abs().max() <= 2 * sigma
    assert float(weight.detach().std()) == pytest.approx(0.8796 * sigma, rel=0.01)  # of a normal cut at two sigma
    assert not any(bias.any() for bias in model.networks.biases)


@pytest.mark.parametrize(
    ("hidden", "decays"),
    [((8,) * 4, [2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4]), ((8, 8), [2.5e-5, 5e-5, 1e-4]), ((8,), [2.5e-5, 1e-4])],
)
def test_weight_decays(hidden, decays):
    groups = make(hidden=hidden).optimizer.param_groups
    assert [group["weight_decay"] for group in groups] == [*decays, 0.0]


def test_log_variance_bounds_are_trained():
    model = make()
    before = [model.networks.max_log_variance.clone(), model.networks.min_log_variance.clone()]
    assert before[0].unique().tolist() == [0.5]
    assert before[1].unique().tolist() == [-10.0]
    model.fit(linear(1000), max_steps=200)
    assert (model.networks.max_log_variance < before[0] - 0.02).all()
    assert (model.networks.min_log_variance > before[1] + 0.02).all()


# ------------------------------------------------------------------------ fit


def test_recovers_a_linear_gaussian_system():
    model, noise = make(), 0.1
    train, test = linear(4000, noise), linear(2000, noise, seed=1)
    log = model.fit(train)
    truth = replace(test, next_observations=linear(2000, 0.0, seed=1).next_observations)
    change = (test.next_observations - test.observations).std(dim=0)
    floor = float((noise / change).square().mean().sqrt())
    assert model.error(test) == pytest.approx(floor, rel=0.05)
    assert model.error(truth) < 0.3 * floor
    heads = model._ask_elites(model._inputs(test.observations, test.actions))
    spread = (0.5 * heads.log_variance).exp().mean(dim=(0, 1))[:OBS] * model.target_std[:OBS]
    np.testing.assert_allclose(spread.detach(), noise, rtol=0.15)
    prediction = model.step(test.observations, test.actions, deterministic=True)
    assert float((prediction.rewards - test.rewards).abs().mean()) < 0.05
    assert 0 < log["holdout_rmse"] < 0.3


def test_weights_matter():
    """Half of the labels are wrong and weigh nothing."""
    clean = linear(3000, noise=0.02)
    wrong = th.arange(3000) % 2 == 0
    corrupted = replace(
        clean,
        next_observations=th.where(wrong[:, None], clean.observations + 2.0, clean.next_observations),
        rewards=th.where(wrong, 7.0, clean.rewards),
    )
    test = linear(1000, noise=0.02, seed=1)
    trusting, told = make(), make()
    trusting.fit(corrupted, max_steps=600)
    told.fit(corrupted, (~wrong).float(), max_steps=600)
    assert told.error(test) < 0.15
    assert trusting.error(test) > 1.0


def test_scale_of_the_weights_is_irrelevant():
    data, weights = linear(500), th.rand(500)
    models = make(), make()
    for model, scale in zip(models, (1.0, 1024.0)):
        model.fit(data, scale * weights, max_steps=20)
    for one, other in zip(*(model.parameters() for model in models)):
        th.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_equal_weights_are_no_weights():
    data = linear(500)
    models = make(), make()
    models[0].fit(data, max_steps=20)
    models[1].fit(data, th.full((500,), 4.0), max_steps=20)
    assert all(th.equal(one, other) for one, other in zip(*(model.parameters() for model in models)))


def test_constant_dimension_is_harmless():
    data = linear(1000)
    fixed = th.full((1000, 1), 3.0, dtype=th.float64)
    data = replace(
        data,
        observations=th.cat([data.observations[:, :2], fixed], dim=1),
        next_observations=th.cat([data.next_observations[:, :2], fixed], dim=1),
    )
    model = make()
    model.fit(data, max_steps=300)
    assert model.input_std[2] == 1
    assert model.target_std[2] == 1
    assert model.input_mean[2] == 3
    prediction = model.step(data.observations, data.actions, deterministic=True)
    assert (prediction.next_observations[:, 2] - 3.0).abs().max() < 0.2


def test_scaler_is_kept_after_the_first_fit():
    model, data = make(), linear(500)
    model.fit(data, max_steps=5)
    train = ~model.holdout_mask(th.arange(500))
    inputs = th.cat([data.observations, data.actions], dim=1)[train]
    th.testing.assert_close(model.input_mean, inputs.mean(dim=0).float())
    th.testing.assert_close(model.input_std, inputs.std(dim=0, unbiased=False).float())
    before = [buffer.clone() for buffer in (model.input_mean, model.input_std, model.target_mean, model.target_std)]
    model.fit(replace(data, observations=data.observations + 50.0), max_steps=5)
    after = model.input_mean, model.input_std, model.target_mean, model.target_std
    assert all(th.equal(one, other) for one, other in zip(before, after))


@settings(max_examples=60, deadline=None)
@given(n=st.integers(2, 3000), more=st.integers(1, 3000), cap=st.integers(1, 400), ratio=st.floats(0.01, 0.5))
def test_holdout_is_permanent(n, more, cap, ratio):
    model = make(hidden=(4,), max_holdout=cap, holdout_ratio=ratio)
    first, later = model.holdout_mask(th.arange(n)), model.holdout_mask(th.arange(n + more))
    assert not (later[:n] & ~first).any()  # what was trained on never judges
    assert th.equal(first, later[:n]) or int(later.sum()) == cap  # and what judged goes on, but for the cap
    assert 1 <= int(first.sum()) <= cap
    assert not first.all()
    assert abs(int(first.sum()) - min(cap, ratio * n)) < 5


def test_holdout_judges_the_newest_data_as_the_oldest():
    shares = make(hidden=(4,)).holdout_mask(th.arange(100_000)).reshape(10, -1).sum(1)
    assert int(shares.sum()) == 5_000
    assert (shares - 500).abs().max() < 10


@pytest.mark.parametrize("kind", [np.uint8, np.int64])
def test_whole_numbers_are_refused(kind):
    whole = spaces.Box(0, 100, (2,), kind)
    with pytest.raises(ValueError, match=r"observation_space holds u?int\d+, and .*DtypeObservation"):
        EnsembleDynamics(whole, spaces.Box(-1, 1, (1,)))


def test_holdout_is_not_trained_on():
    data, model = linear(400), make()
    held = model.holdout_mask(th.arange(400))
    train, judged = model._prepare(data, None)
    changed = replace(data, rewards=th.where(held, 100.0, data.rewards))
    train_again, judged_again = model._prepare(changed, None)
    assert th.equal(train.targets, train_again.targets)
    assert not th.equal(judged.targets, judged_again.targets)
    assert len(train.inputs) + len(judged.inputs) == 400


def test_best_state_is_restored():
    """Overfitting on few, noisy transitions: the restored state is the best that any epoch ended with."""
    data = linear(60, noise=1.0)
    model = make(learning_rate=1e-2, patience=8)
    seen = []
    judge = model._judge

    def recording(held):
        seen.append((judge(held), [p.detach().clone() for p in model.networks.parameters()]))
        return seen[-1][0]

    model._judge = recording
    log = model.fit(data)
    assert log["epochs"] + 1 == len(seen)
    scores = th.stack([score[1] for score, _ in seen])
    best = scores.argmin(dim=0)
    assert (best < len(seen) - 1).any()  # else there was nothing to restore
    for i, parameter in enumerate(model.networks.parameters()):
        expected = th.stack([seen[b][1][i][m] for m, b in enumerate(best.tolist())])
        assert th.equal(parameter.detach(), expected)
    nll = th.stack([seen[b][0][0][m] for m, b in enumerate(best.tolist())])
    assert log["holdout_nll"] == pytest.approx(float(nll[model.elites].mean()))


def test_a_fit_that_helps_nobody_changes_nothing():
    data = linear(60, noise=1.0)
    model = make(learning_rate=1e-2)
    model.fit(data)
    before = [p.detach().clone() for p in model.networks.parameters()]
    for group in model.optimizer.param_groups:
        group["lr"] = 10.0
    model.fit(data, max_steps=100)
    assert all(th.equal(one, other) for one, other in zip(before, model.networks.parameters()))


@pytest.mark.parametrize(("n", "cap", "steps"), [(1000, 3, 3), (1000, 27, 27), (2, 5, 5), (300, 1, 1)])
def test_max_steps_is_respected(n, cap, steps):
    model = make(batch_size=32)
    log = model.fit(linear(n), max_steps=cap)
    assert log["steps"] == steps
    assert {int(state["step"]) for state in model.optimizer.state.values()} == {steps}
    # what was done of an epoch is judged and kept
    assert math.isfinite(log["holdout_nll"])
    assert math.isfinite(log["train_nll"])


def test_constructor_caps_the_steps():
    assert make(max_steps=7).fit(linear(300))["steps"] == 7


def test_patience_ends_a_fit():
    log = make(patience=2).fit(linear(300, noise=0.5), max_steps=100_000)
    assert log["steps"] < 5000
    assert log["steps"] == log["epochs"] * 20  # one batch an epoch would be judged too often


def test_a_hundredth_less_is_an_improvement_and_less_than_that_is_none(monkeypatch):
    model, errors = make(patience=2), iter([1.0, 0.995, 0.989, 0.985, 0.981, 0.5])
    monkeypatch.setattr(model, "_judge", lambda held: 2 * (th.full((model.n_members,), next(errors)),))
    monkeypatch.setattr(model, "_train_epoch", lambda train, most: (th.tensor(0.0), 1))
    assert model.fit(linear(300), max_steps=100)["epochs"] == 4


def test_every_member_has_its_own_order_and_sees_all():
    model = make(batch_size=100)
    train, _ = model._prepare(linear(500), None)
    seen: list[th.Tensor] = []
    forward = model.networks.forward
    model.networks.forward = lambda inputs, members=None: (seen.append(inputs), forward(inputs, members))[1]
    model._train_epoch(train, 5 if len(train.inputs) > 400 else 4)
    rows = th.cat(seen, dim=1)[:, : len(train.inputs), 0]
    assert th.equal(rows.sort(dim=1).values, train.inputs[:, 0].sort().values.expand(model.n_members, -1))
    assert not th.equal(rows[0], rows[1])


def test_elites_wait_for_a_holdout_that_is_large_enough():
    model = make(min_holdout_for_elites=50)
    with th.no_grad():
        model.networks.biases[-1][0].fill_(3.0)  # a bad first member
    model.fit(linear(100), max_steps=1)
    assert model.elites.tolist() == [0, 1, 2]
    model.fit(linear(1000), max_steps=1)
    assert 0 not in model.elites.tolist()


def test_optimizer_state_is_kept_between_fits():
    model, data = make(), linear(300)
    model.fit(data, max_steps=10)
    model.fit(data, max_steps=10)
    assert {int(state["step"]) for state in model.optimizer.state.values()} == {20}


def test_float64_positions_lose_nothing():
    data = linear(2000, noise=0.01)
    far = replace(data, observations=data.observations + 1e8, next_observations=data.next_observations + 1e8)
    model, reference = make(), make()
    model.fit(far, max_steps=300)
    reference.fit(data, max_steps=300)
    assert model.error(far) == pytest.approx(reference.error(data), rel=0.05)


@pytest.mark.parametrize("field", ["observations", "actions", "rewards", "next_observations", "terminations"])
def test_nan_is_refused(field):
    data = linear(50)
    values = getattr(data, field).clone()
    values[7] = math.nan
    with pytest.raises(ValueError, match=rf"data\.{field} .*not finite"):
        make().fit(replace(data, **{field: values}))


def test_bad_arguments_of_fit():
    model, data = make(), linear(50)
    with pytest.raises(ValueError, match="at least 2"):
        model.fit(linear(1))
    with pytest.raises(ValueError, match=r"data\.actions must have shape \(50, 2\)"):
        model.fit(replace(data, actions=data.actions[:, :1]))
    with pytest.raises(ValueError, match="weights must have shape"):
        model.fit(data, th.ones(49))
    with pytest.raises(ValueError, match="non-negative"):
        model.fit(data, -th.ones(50))
    with pytest.raises(ValueError, match="not all zero"):
        model.fit(data, th.zeros(50))
    with pytest.raises(ValueError, match="weights holds"):
        model.fit(data, th.full((50,), math.nan))
    with pytest.raises(ValueError, match="max_steps"):
        model.fit(data, max_steps=0)


def test_a_diverging_fit_leaves_the_last_good_state():
    data, model = linear(300), make()
    model.fit(data, max_steps=100)
    before = [p.detach().clone() for p in model.parameters()]
    for group in model.optimizer.param_groups:
        group["lr"] = math.nan
    with pytest.warns(UserWarning, match="not finite"):
        log = model.fit(data, max_steps=100)
    assert all(th.equal(one, other) for one, other in zip(before, model.parameters()))
    assert math.isfinite(log["holdout_nll"])
    for group in model.optimizer.param_groups:
        group["lr"] = 1e-3
    assert math.isfinite(model.fit(data, max_steps=100)["train_nll"])


# ----------------------------------------------------------------------- step


def test_every_row_is_answered_by_one_elite_and_rows_are_dealt_evenly():
    model, data = make(), linear(3001)
    model.fit(data, max_steps=20)
    model.elites.copy_(th.tensor([3, 0, 2]))
    exact_noise_free(model)
    prediction = model.step(data.observations, data.actions)
    change = (prediction.next_observations - data.observations).numpy()
    alone = np.stack([member["mean"][:, :OBS] for member in members_alone(model, data)])
    match = np.abs(alone - change).max(axis=2) < 1e-4
    assert not match[1].any()
    assert (match.sum(axis=0) == 1).all()
    assert set(match.sum(axis=1)[[0, 2, 3]]) <= {1000, 1001}
    # another draw deals differently
    again = model.step(data.observations, data.actions).next_observations
    other = (again - prediction.next_observations).abs().amax(dim=1) > 1e-4
    assert 0.2 < float(other.double().mean()) < 0.9


def test_a_single_row_gets_a_random_elite():
    model, data = make(), linear(300)
    model.fit(data, max_steps=20)
    exact_noise_free(model)
    answers = {float(model.step(data.observations[:1], data.actions[:1]).rewards) for _ in range(60)}
    assert len({round(answer, 5) for answer in answers}) == model.n_elites


def test_deterministic_is_the_mean_of_the_elites():
    model, data = make(), linear(300)
    model.fit(data, max_steps=20)
    model.elites.copy_(th.tensor([3, 0, 2]))
    prediction = model.step(data.observations, data.actions, deterministic=True)
    mean = np.mean([members_alone(model, data)[m]["mean"] for m in (0, 2, 3)], axis=0)
    np.testing.assert_allclose(prediction.next_observations - data.observations, mean[:, :OBS], atol=1e-4)
    np.testing.assert_allclose(prediction.rewards, mean[:, OBS], atol=1e-4)


def test_a_mean_prediction_ends_where_the_elites_think_that_likely(monkeypatch):
    model = make(termination_fn=None)
    model.fit(linear(60), max_steps=2)
    heads = model._ask_elites(th.zeros(4, OBS + ACT, dtype=th.float64).float())
    likely = th.tensor([0.2, 0.45, 0.55, 0.9]).expand(model.n_elites, 4)[:, :, None]
    monkeypatch.setattr(model, "_ask_elites", lambda inputs: heads._replace(logit=th.logit(likely)))
    found = model.step(th.zeros(4, OBS), th.zeros(4, ACT), deterministic=True)
    assert found.terminations.tolist() == [False, False, True, True]


def test_sample_statistics():
    """Moments of the mixture of the elites, at one state."""
    model, data = make(), linear(500)
    model.fit(data, max_steps=200)
    one = data.take(slice(0, 1))
    n = 60_000
    samples = model.step(one.observations.expand(n, -1), one.actions.expand(n, -1))
    change = samples.next_observations - one.observations
    members = [members_alone(model, one)[m] for m in model.elites.tolist()]
    scale = model.target_std.numpy()[:OBS]
    means = np.stack([member["mean"][0, :OBS] for member in members])
    variances = np.stack([np.exp(member["log_variance"][0, :OBS]) for member in members]) * scale**2
    std = np.sqrt(variances.mean(axis=0) + means.var(axis=0))
    np.testing.assert_allclose(change.mean(dim=0), means.mean(axis=0), atol=float(5 * std.max() / math.sqrt(n)))
    np.testing.assert_allclose(change.std(dim=0), std, rtol=0.02)


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("n", [0, 1, 7, 1600])
def test_step_keeps_shapes_and_dtype(n, dtype):
    data, model = linear(n, dtype=dtype), make(termination_fn=None)
    for deterministic in (False, True):
        prediction = model.step(data.observations, data.actions.float(), deterministic)
        assert prediction.next_observations.shape == (n, OBS)
        assert prediction.next_observations.dtype == dtype
        assert prediction.rewards.shape == prediction.terminations.shape == (n,)
        assert prediction.terminations.dtype == th.bool
        assert not prediction.next_observations.requires_grad


def test_known_rules_are_used():
    def reward(observations, actions, next_observations):
        return observations[:, 0] + 10 * actions[:, 0] + 100 * next_observations[:, 0]

    def fallen(observations, actions, next_observations):
        return next_observations[:, 1] > 0

    data = linear(200)
    model = make(reward_fn=reward, termination_fn=fallen)
    prediction = model.step(data.observations, data.actions)
    given = data.observations, data.actions, prediction.next_observations
    assert th.equal(prediction.rewards, reward(*given))
    assert th.equal(prediction.terminations, fallen(*given))
    assert prediction.terminations.any()
    bad = make(reward_fn=lambda o, a, x: o)
    with pytest.raises(ValueError, match="reward_fn must return"):
        bad.step(data.observations, data.actions)


def test_termination_is_learned_and_says_so_once():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        th.manual_seed(0)
        model = EnsembleDynamics(
            spaces.Box(-9, 9, (OBS,)), spaces.Box(-1, 1, (ACT,)), n_members=3, n_elites=2, hidden=(32, 32)
        )
        train, test = linear(3000), linear(1000, seed=1)
        model.fit(train, max_steps=700)
        prediction = model.step(test.observations, test.actions, deterministic=True)
        sampled = model.step(test.observations, test.actions)
    assert len(caught) == 1
    assert "termination_fn" in str(caught[0].message)
    assert float((prediction.terminations == test.terminations.bool()).double().mean()) > 0.93
    assert float((sampled.terminations == test.terminations.bool()).double().mean()) > 0.85
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(termination_fn=never)


# ----------------------------------------------------------------- checkpoint


@pytest.mark.parametrize("termination_fn", [never, None])
def test_state_dict_is_complete(termination_fn):
    data = linear(600)
    model = make(termination_fn=termination_fn)
    model.fit(data, max_steps=50)
    fresh = make(seed=99, termination_fn=termination_fn)
    fresh.load_state_dict(copy.deepcopy(model.state_dict()))
    fresh.optimizer.load_state_dict(copy.deepcopy(model.optimizer.state_dict()))
    assert bool(fresh.fitted)
    for _ in range(2):
        for one, other in zip(*(m.step(data.observations, data.actions) for m in (model, fresh))):
            assert th.equal(one, other)
        logs = [m.fit(data, max_steps=50) for m in (model, fresh)]
        assert logs[0]["holdout_nll"] == logs[1]["holdout_nll"]
        assert all(th.equal(one, other) for one, other in zip(model.parameters(), fresh.parameters()))
        assert th.equal(model.elites, fresh.elites)


def test_state_dict_loads_with_weights_only(tmp_path):
    model = make()
    model.fit(linear(100), max_steps=5)
    th.save(model.state_dict(), tmp_path / "phi.pt")
    fresh = make(seed=1)
    fresh.load_state_dict(th.load(tmp_path / "phi.pt", weights_only=True))
    assert th.equal(fresh.generator.get_state(), model.generator.get_state())


def test_a_stream_saved_on_another_kind_of_device_starts_from_its_seed():
    model = make()
    foreign = th.zeros(16, dtype=th.uint8)  # a CUDA generator's state: seed, offset
    foreign[0] = 42
    model.set_extra_state({"generator": foreign})
    assert model.generator.initial_seed() == 42


def test_moving_carries_optimizer_and_stream():
    model, data = make(), linear(300)
    model.fit(data, max_steps=5)
    stream = model.generator.get_state()
    model.to("cpu")
    assert th.equal(model.generator.get_state(), stream)
    model.to(th.float64)
    moments = {s["exp_avg"].dtype for s in model.optimizer.state.values()}
    assert moments == {th.float64}
    assert model.fit(data, max_steps=5)["steps"] == 5


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs CUDA")
def test_cuda():
    data = linear(500)
    model = make().to("cuda")
    model.seed(3)
    assert model.generator.device.type == "cuda"
    there = Transitions(**{name: value.to("cuda") for name, value in data.__dict__.items()})
    model.fit(there, th.ones(500, device="cuda"), max_steps=20)
    assert model.step(there.observations, there.actions).next_observations.device.type == "cuda"


def test_bad_arguments():
    box = spaces.Box(-1, 1, (2,))
    for observation_space, action_space in ((spaces.Box(-1, 1, (2, 2)), box), (box, spaces.Discrete(2))):
        with pytest.raises(ValueError, match="flat Box"):
            EnsembleDynamics(observation_space, action_space)
    for bad in ({"n_elites": 0}, {"n_elites": 9}, {"holdout_ratio": 0.0}, {"holdout_ratio": 0.6}, {"batch_size": 0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            EnsembleDynamics(box, box, **bad)


def test_without_noise_every_step_is_the_elites_mean():
    data = linear(300)
    model, quiet = make(), make(noise=False)
    for each in (model, quiet):
        each.fit(data, max_steps=20)
    expected = model.step(data.observations, data.actions, deterministic=True)
    answer = quiet.step(data.observations, data.actions)
    th.testing.assert_close(answer.next_observations, expected.next_observations)
    assert not th.allclose(
        model.step(data.observations, data.actions).next_observations, expected.next_observations, atol=1e-3
    )
