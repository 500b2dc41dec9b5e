"""The speed benchmark: its plain versions do the same mathematics, its floor counts what is needed, its ratios add."""

import copy
import json

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from benchmarks import RESULTS, speed
from benchmarks.runner import read_table
from benchmarks.speed import cases, timing
from benchmarks.speed.cases import ACTION, Case, Stage, random_rows
from benchmarks.speed.plain import PlainEnsemble, PlainRPTO
from sb3_rpto import RPTO
from sb3_rpto.dynamics.ensemble import EnsembleDynamics


def ensembles(hidden=(8, 8)):
    stage = Stage(3, 2)
    found = []
    for cls in (PlainEnsemble, EnsembleDynamics):
        th.manual_seed(0)
        with pytest.warns(UserWarning, match="terminations"):
            found.append(cls(stage.observation_space, stage.action_space, hidden=hidden, n_members=3, n_elites=3))
    plain, ours = found
    with th.no_grad():
        for i, member in enumerate(plain.networks.members):
            linear = [layer for layer in member.body if isinstance(layer, th.nn.Linear)]
            for layer, weight, bias in zip(linear, ours.networks.weights, ours.networks.biases):
                layer.weight.copy_(weight[i].T)
                layer.bias.copy_(bias[i, 0])
    return plain, ours


def test_the_plain_ensemble_predicts_as_the_stacked_one():
    plain, ours = ensembles()
    inputs = th.randn(3, 50, 5)
    for a, b in zip(plain.networks(inputs), ours.networks(inputs)):
        th.testing.assert_close(a, b)
    members = th.tensor([2, 0])
    for a, b in zip(plain.networks(inputs[:2], members), ours.networks(inputs[:2], members)):
        th.testing.assert_close(a, b)


def test_a_plain_members_loss_is_the_stacked_ones():
    plain, ours = ensembles()
    rows = 20
    inputs, targets, weights = th.randn(3, rows, 5), th.randn(3, rows, 4), th.ones(3, rows)
    ended = th.zeros(3, rows)
    stacked = ours.networks(inputs).nll(targets, ended).mean(dim=1)
    for i, member in enumerate(plain.networks.members):
        th.testing.assert_close(member.descend(inputs[i], targets[i], ended[i], weights[i]), stacked[i].detach())


def test_the_plain_loop_updates_as_ours_does():
    models = []
    for cls in (PlainRPTO, RPTO):
        with pytest.warns(UserWarning, match="terminations"):
            model = cls(
                "MlpPolicy",
                Stage(3),
                target_env=Stage(3),
                seed=0,
                device="cpu",
                policy_kwargs={"net_arch": [16]},
                dynamics_kwargs={"hidden": (8,)},
            )
        model.replay_buffer.append("source", **random_rows(500, 3, ACTION))
        model.replay_buffer.append("target", **random_rows(300, 3, ACTION, 1))
        model.set_logger(configure(None, []))
        model._current_progress_remaining = 1.0
        models.append(model)
    plain, ours = models
    ours.policy.load_state_dict(plain.policy.state_dict())
    before = copy.deepcopy(plain.policy.state_dict())
    for model in models:
        for _ in range(20):
            np.random.seed(3)
            th.manual_seed(3)
            model.train(1, 32)
    for name, theirs in plain.policy.state_dict().items():
        moved = (theirs - before[name]).norm()
        assert (ours.policy.state_dict()[name] - theirs).norm() < 1e-3 * moved, name


def test_the_floor_of_an_update_counts_each_needed_product_once():
    o, a, h, b = 17, 6, 256, 256
    mid, into_actor, into_critic = b * h * h, b * o * h, b * (o + a) * h
    actor_out, critic_out = b * h * 2 * a, b * h
    actor = 2 * (into_actor + mid + actor_out) + (into_actor + 2 * mid + 2 * actor_out)
    critics = 2 * (3 * (into_critic + mid + critic_out) + (into_critic + 2 * mid + 2 * critic_out))
    through = 2 * (into_critic + mid + critic_out)
    assert timing.flops(cases.sac_products(o, b, 1)) == 2 * (actor + critics + through)


def test_products_are_made_as_often_as_they_count(monkeypatch):
    made = []
    monkeypatch.setattr(timing.th, "matmul", lambda a, b: made.append((tuple(a.shape), tuple(b.shape))))
    timing.products({(1, 2, 3, 4): 2, (5, 2, 3, 4): 1})()
    assert made == [((2, 3), (3, 4))] * 2 + [((5, 2, 3), (5, 3, 4))]


def test_variants_take_turns_and_the_first_round_does_not_count():
    calls = []
    times = timing.interleaved({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=2)
    assert calls == ["a", "b", "b", "a", "a", "b"]
    assert [len(seconds) for seconds in times.seconds.values()] == [2, 2]


def test_ratios_are_formed_round_by_round():
    times = timing.Times({"slow": np.array([2.0, 6.0, 20.0]), "fast": np.array([1.0, 2.0, 10.0])})
    assert times.ratio("slow", "fast") == (2.0, 2.0, 3.0)


def test_a_case_becomes_a_row_and_a_line_of_the_table(monkeypatch):
    seconds = {"plain": np.array([4.0, 4.0]), "ours": np.array([1.0, 2.0]), "floor": np.array([0.5, 0.5])}
    monkeypatch.setattr(speed, "interleaved", lambda *_: timing.Times(seconds))
    case = Case("SAC update", "ms/update", 10, {"plain": print, "ours": print}, "plain", {(1, 2, 2, 2): 1})
    row = {"threads": 1, **speed.measure(case, 2)}
    assert row["milliseconds"] == {"plain": 400, "ours": 150, "floor": 50}
    assert (row["ratio"], row["range"], row["floor_share"]) == (3, [2, 4], 0.375)
    text = speed.table([row])
    assert "| 3.00 [2.00, 4.00] | 38% | 2.2, 60% | no |" in text


def test_the_tracers_steps_are_those_of_the_plain_batch():
    ours, plain = (cases.substeps(5, 50).variants[name]() for name in ("ours", "MuJoCo's batch"))
    np.testing.assert_array_equal(ours, plain)
    assert np.ptp(ours) > 1


def test_the_columns_of_a_fit_are_those_of_models_of_their_own():
    ours, plain = (cases.columns(3).variants[name]() for name in ("ours", "a compilation a column"))
    np.testing.assert_allclose(ours, plain, atol=1e-9)
    nominal, *others = plain.reshape(-1, 3, plain.shape[1])
    assert all(np.abs(column - nominal).max() > 1e-6 for column in others)


def test_the_floor_of_a_fit_counts_the_batches_that_it_makes():
    case = cases.ensemble_training("cpu", 16, members=2, rows=700)
    (rows,) = {rows for _, rows, n_in, _ in case.floor if n_in == cases.OBSERVATION + ACTION}
    assert 3 * rows == pytest.approx(0.8 * 700, abs=3)  # three batches of at most 256


def test_the_command_writes_figures_and_manifest(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "_cases", lambda *_: [cases.columns(2)])
    monkeypatch.setattr(
        speed, "growth", lambda *_: [{"what": "peak memory", "value": 10, "megabytes": {"SB3": 5, "ours": 6}}]
    )
    before = th.get_num_threads()
    assert speed.main(["--out", str(tmp_path / "new" / "speed"), "--threads", "1"]) == 0
    assert th.get_num_threads() == before
    rows = read_table(tmp_path / "new" / "speed.csv")
    assert rows[0]["case"] == "columns of the fit"
    assert json.loads((tmp_path / "new" / "speed.json").read_text())["gpu"] == "unmeasured"
    assert "| peak memory | 10 | 5 MB | 6 MB |" in speed.table(rows)


def test_the_committed_table_is_printed_as_it_was_measured():
    text = speed.table(read_table(RESULTS / "speed.csv"))
    assert text.count("| yes |") > 3
    assert "| update, batch | 1,024 |" in text
