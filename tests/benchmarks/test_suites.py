"""The suites are what the docs say: who is compared where, for how long, in which order."""

from __future__ import annotations

import json
from collections import Counter
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
from conftest import SMALL_ENSEMBLE, SMALL_POLICY, pendulum
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import SAC

from benchmarks.runner import chosen
from benchmarks.transfer.ablation import ABLATED, FACTORS, WithoutRPO, cells
from benchmarks.transfer.plan import Job, Suite, jobs, listing
from benchmarks.transfer.suites import ABLATION, FURTHER, PAPER, PAPER_TASKS, QUICK, SUITES
from sb3_rpto import RPTO
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.registry import REGISTRY, Run
from sb3_rpto.envs.tasks import TARGETS, TASKS, env_id, make_shift
from sb3_rpto.evaluation.learning_curve import LearningCurve

by_suite = pytest.mark.parametrize("suite", SUITES.values(), ids=SUITES)


# --- what is compared -----------------------------------------------------------------------------------------------


@by_suite
def test_runs_have_names_of_their_own_and_methods_that_exist(suite: Suite) -> None:
    listed = jobs(suite)
    assert len({job.name for job in listed}) == len(listed)
    assert {job.method for job in listed} <= {*REGISTRY, *ABLATED}
    for place in suite.places:
        assert place.task in TASKS
        assert list(place.points) == sorted(set(place.points))
        assert len({v.label for v in place.variants}) == len(place.variants)


@by_suite
def test_targets_change_something(suite: Suite) -> None:
    for place in suite.places:
        for target in place.targets:
            factors = make_shift(place.task, target).factors
            assert factors
            assert any(factor != 1 for factor in factors.values())


def test_quick_has_every_method_on_two_tasks() -> None:
    assert [place.task for place in QUICK.places] == ["ContinuousCartPole", "InvertedDoublePendulum"]
    for place in QUICK.places:
        assert {v.method for v in place.variants} == set(REGISTRY) - {"oracle"}
        backends = {(v.method, v.settings.get("dynamics")) for v in place.variants if v.method in ("rto", "rpto")}
        assert backends == set(product(("rto", "rpto"), ("ensemble", "physical")))
        often = {"rpo", "rto", "rpto", "sac-warm"}
        assert all(v.seeds == (5 if v.method in often else 3) for v in place.variants)
        assert (len(place.targets), place.points) == (1, (100, 250, 500, 1_000))
    closed = [v.label for place in QUICK.places for v in place.variants if v.settings.get("close_loop")]
    assert closed == ["rpto-physical-closed"]
    assert QUICK.episodes == 10


def test_quick_is_planned_to_take_less_than_two_hours_on_two_cores() -> None:
    assert 60 < sum(job.seconds for job in jobs(QUICK)) / 2 / 60 < 110


def test_further_has_20_updates_for_all_and_the_residual_model_that_has_to_find_the_shift() -> None:
    for place, quick in zip(FURTHER.places, QUICK.places):
        assert (place.task, place.targets, place.points) == (quick.task, quick.targets, quick.points)
        ensemble, alone, *residual = place.variants
        assert ensemble.settings["gradient_steps"] == alone.settings["gradient_steps"] == 20
        learned = next(v for v in quick.variants if v.label == "rpto-ensemble")
        assert ensemble.settings == {**learned.settings, "gradient_steps": 20}
        closed = [v.settings["declared"] for v in quick.variants if v.settings.get("close_loop")]
        assert [v.settings for v in residual] == [{"dynamics": "residual", "declared": names} for names in closed]


def test_paper_is_five_tasks_four_targets_four_seeds_all_methods() -> None:
    assert PAPER_TASKS == ("Ant", "HalfCheetah", "Hopper", "Walker2d", "Swimmer")
    per_label = Counter((job.task, job.target, job.label) for job in jobs(PAPER))
    assert set(per_label.values()) == {4}
    for place in PAPER.places:
        assert place.targets == tuple(f"target{i}" for i in TARGETS)
        assert {v.method for v in place.variants} == set(REGISTRY) - {"oracle"}
    settings = {(p.task, v.label): v.settings for p in PAPER.places for v in p.variants}
    assert settings["Swimmer", "rpto-ensemble"]["preset"] == "paper"
    assert settings["Ant", "sac-warm-high"] == {"gradient_steps": 5, "n_critics": 10}  # RPTO's number in the paper
    runs = [(p.task, v.method, json.dumps(v.settings, sort_keys=True)) for p in PAPER.places for v in p.variants]
    assert len(set(runs)) == len(runs)  # none is another over again
    assert settings["Swimmer", "sac"]["gamma"] == 0.9999


@pytest.mark.parametrize("suite", [QUICK, PAPER], ids=["quick", "paper"])
def test_physical_models_declare_what_the_target_changes_and_the_closed_loop_does_not(suite: Suite) -> None:
    for place in suite.places:
        env = gym.make(env_id(place.task)).unwrapped
        changed = {name for target in place.targets for name in make_shift(place.task, target, env).factors}
        for variant in (v for v in place.variants if "declared" in v.settings):
            declared = set(variant.settings["declared"])
            if variant.settings.get("close_loop"):
                assert not declared & changed
            elif suite is QUICK:
                assert declared == changed
            else:
                assert declared == {*TASKS[place.task].lengths, *TASKS[place.task].frictions}


# --- the order ------------------------------------------------------------------------------------------------------

ORDERED = {name: jobs(suite) for name, suite in SUITES.items()}


@given(st.sampled_from(list(SUITES)), st.floats(0, 1))
def test_an_unfinished_suite_is_a_fair_sample(name: str, share: float) -> None:
    listed = ORDERED[name]
    begun = listed[: round(share * len(listed))]
    wanted = Counter((job.task, job.target, job.label) for job in listed)
    done = Counter((job.task, job.target, job.label) for job in begun)
    for place in {(job.task, job.target) for job in listed}:
        counts = {label: done[key] for key in wanted if key[:2] == place for label in [key[2]]}
        for a, b in combinations(counts, 2):
            if wanted[(*place, a)] == wanted[(*place, b)]:
                assert abs(counts[a] - counts[b]) <= 1
    seeds = [Counter(job.seed for job in begun if job.task == task) for task in {job.task for job in listed}]
    for seed in {job.seed for job in listed}:  # a seed is begun on no task before the one below is done on all
        if any(count[seed] for count in seeds):
            assert {job.name for job in listed if job.seed < seed} <= {job.name for job in begun}


def test_the_order_is_always_the_same_and_choosing_keeps_it() -> None:
    listed = jobs(QUICK)
    assert listed == jobs(QUICK)
    names = [job.name for job in listed]
    assert names != sorted(names)
    found = [job.name for job in chosen(jobs(QUICK), "CartPole.*rpto-(ens|phys)")]
    assert found == [name for name in names if "CartPole" in name and "_rpto-" in name]
    assert len(found) == 10


def test_seeds_can_be_given() -> None:
    counts = Counter((job.task, job.label) for job in jobs(QUICK, seeds=2))
    assert set(counts.values()) == {2}
    assert max(job.seed for job in jobs(QUICK, seeds=7)) == 6


def test_bad_choices_are_refused() -> None:
    with pytest.raises(ValueError, match="seeds is 0"):
        jobs(QUICK, seeds=0)


def test_the_listing_says_what_it_will_cost() -> None:
    text = listing(chosen(jobs(QUICK), "sac-warm_0"), 2).splitlines()
    assert len(text) == 3
    assert text[-1].startswith("2 runs, about 0.0 core hours")


def test_what_a_run_is_does_not_depend_on_what_it_was_expected_to_cost() -> None:
    job = jobs(QUICK)[0]
    dear = Job(**{**vars(job), "seconds": 9e9})
    assert job.to_json() == dear.to_json() != Job(**{**vars(job), "episodes": 1}).to_json()


# --- they run -------------------------------------------------------------------------------------------------------

SMALL: dict[str, dict[str, Any]] = {
    "ensemble": {"dynamics_kwargs": SMALL_ENSEMBLE},
    "slbo": {"iterations": 1, "policy_updates": 1, "rollout_samples": 40, "rollout_length": 20},
    "sysid-retrain": {"retrain_steps": 20},
    "sac": {"policy_kwargs": SMALL_POLICY},
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suite", [QUICK, ABLATION], ids=["quick", "ablation"])
def test_every_variant_of_a_small_suite_runs(suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_rpto.baselines.policy_distillation.clone.__defaults__", (20,))
    place = suite.places[0]
    make_source = partial(gym.make, env_id(place.task))
    make_target = partial(gym.make, env_id(place.task), shift=place.targets[0])
    path = str(tmp_path / "sac.zip")
    SAC("MlpPolicy", make_source(), policy_kwargs=SMALL_POLICY, learning_starts=20, seed=0).learn(60).save(path)
    variants = place.variants if suite is QUICK else place.variants[:3] + place.variants[-3:]
    for variant in variants:
        small = dict(SMALL.get(variant.method, {}))
        if "dynamics_kwargs" in variant.settings:
            small |= SMALL["ensemble"]
        curve = LearningCurve(make_target, [12], n_episodes=1)
        method = {**REGISTRY, **ABLATED}[variant.method]
        method.run(Run(path, make_source, make_target, 12, kwargs={**variant.settings, **small}), curve)
        assert curve.rows[-1]["steps"] == (0 if variant.method == "zero-shot" else 12), variant.label


# --- the ablation ---------------------------------------------------------------------------------------------------


def test_the_fraction_is_balanced() -> None:
    chosen = [cell.factors for cell in cells()]
    assert len({tuple(f.values()) for f in chosen}) == 24
    assert all(set(FACTORS[name]) == {f[name] for f in chosen} for name in FACTORS)
    second = [name for name, levels in FACTORS.items() if len(levels) == 2]
    for third in ("start", "updates"):  # each level once with each of the eight combinations
        assert set(Counter((f[third], *(f[name] for name in second)) for f in chosen).values()) == {1}
    assert set(Counter((f["start"], f["updates"]) for f in chosen).values()) == {2, 3}
    assert len({cell.label for cell in cells()}) == 24


def test_cells_differ_in_their_factors_alone() -> None:
    moved = {"rollout_start", "gradient_steps", "weighting", "model_train_freq"}
    fixed = {tuple(sorted((k, str(v)) for k, v in cell.settings.items() if k not in moved)) for cell in cells()}
    assert len(fixed) == 1
    assert {cell.method for cell in cells()} == {"rpto", "rpto-without-rpo"}
    assert {v.label for v in ABLATION.places[0].variants} == {cell.label for cell in cells()}
    assert all({v.seeds for v in place.variants} == {3} for place in ABLATION.places)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_without_rpo_and_weights_it_is_mbpo() -> None:
    """From states of the target alone; number for number."""
    settings = {"source_steps": 8, "buffer_size": 500, "real_ratio": 0.1, "model_train_freq": 20, "gradient_steps": 2}
    settings |= {"dynamics_kwargs": {**SMALL_ENSEMBLE, "noise": True, "patience": 5}, "policy_kwargs": SMALL_POLICY}
    settings |= {"batch_size": 32, "seed": 3}
    actors = []
    for cls, more in ((MBPO, {}), (WithoutRPO, {"weighting": None}), (RPTO, {"weighting": None})):
        target = pendulum(12.0)
        model = cls(
            "MlpPolicy", pendulum(), target_env=target, rollout_start="target", device="cpu", **settings, **more
        )
        model.learn(60, source_timesteps=0)
        actors.append(th.cat([p.detach().flatten() for p in model.actor.parameters()]))
    assert th.equal(actors[0], actors[1])
    assert not th.equal(actors[1], actors[2])
