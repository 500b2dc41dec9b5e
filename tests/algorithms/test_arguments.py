"""What is refused before anything is built, each check by itself."""

import warnings
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import ALGORITHMS, SMALL_ENSEMBLE, pendulum, small
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms import argument_ranges, arguments
from sb3_rpto.algorithms.target import OfflineTarget
from sb3_rpto.effects import LIBRARY, declare


class Matrix(gym.Env):
    """Two rows of actions."""

    observation_space = spaces.Box(-1, 1, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (2, 2), np.float32)

    def reset(self, *, seed=None, options=None):
        return np.zeros(3, np.float32), {}


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_actions_that_are_not_flat_are_refused_at_construction(cls):
    with pytest.raises(NotImplementedError, match=r"shape \(2, 2\).*TransformAction"):
        small(cls, Matrix(), Matrix())


def test_what_is_allowed_passes():
    argument_ranges.check_given(
        {
            **{
                "policy": "MlpPolicy",
                "learning_rate": lambda _: 1e-3,
                "buffer_size": np.int64(10),
                "learning_starts": 0,
            },
            **{"train_freq": (1, "episode"), "gradient_steps": -1, "ent_coef": "auto_0.5", "target_entropy": -1.0},
            **{
                "policy_kwargs": {"net_arch": {"pi": [8], "qf": []}, "use_sde": False},
                "verbose": True,
                "seed": 2**32 - 1,
            },
            **{"tensorboard_log": Path("logs"), "source_steps": "auto", "weighting": None, "gamma": 1, "device": "cpu"},
            **{"use_sde": np.bool_(True), "ent_coef": 0, "dynamics_kwargs": {}, "device": th.device("cpu")},
        }
    )
    arguments.check_supported(1, False, None)
    arguments.check_applicable("RPO", False, {"env", "real_ratio"})
    arguments.check_applicable("RPTO", True, arguments.DYNAMICS_ARGUMENTS)


#: What a constructor refuses, by the argument, whatever else it is given.
WRONG = {
    "policy": ["MlpPolcy", 3],
    "learning_rate": [-1e-3, float("nan")],
    "buffer_size": [0, 2.5, "1000", None, 10**15, 10**30],
    "learning_starts": [-1, 1.5, None],
    "batch_size": [0, "64", True],
    "tau": [0.0, 5.0, "0.1"],
    "gamma": [1.5, float("nan"), None],
    "train_freq": [0, (1, "epoch"), (0, "step"), [1, "step"], "step"],
    "gradient_steps": [2.5, "5"],
    "action_noise": [0.1, NormalActionNoise],
    "replay_buffer_class": [3, dict],
    "replay_buffer_kwargs": [[1], {"target_size": 10**15}],
    "optimize_memory_usage": ["yes"],
    "n_steps": [0, "2"],
    "ent_coef": ["autoo", "auto_", "auto_-1", "auto_0", -0.1, float("inf"), None],
    "target_update_interval": [0],
    "target_entropy": ["aut", None],
    "use_sde": ["yes", 2],
    "sde_sample_freq": [-2, 0.5],
    "use_sde_at_warmup": ["no"],
    "stats_window_size": [0],
    "tensorboard_log": [3],
    "policy_kwargs": [
        [1],
        "net_arch",
        {"net_arc": [8]},
        {"net_arch": [0]},
        {"net_arch": 64},
        {"net_arch": {"pi": [8]}},
    ],
    "verbose": ["2", -1],
    "seed": ["a", -1, 1.5, 2**32],
    "device": ["cuda:9", "gpu", 3.5],
    "preset": ["defalt", 3],
    "dynamics": ["gp", ["ensemble"]],
    "dynamics_kwargs": [[1], "hidden"],
    "weighting": ["centered", ["paper"]],
    "rollout_start": ["middle"],
    "real_ratio": [1.0, -0.1, "0.1"],
    "weight_floor": [-1e-9, "0.5", float("inf")],
    "retrain_steps": [-1, 2.5],
    "source_steps": [0, "autoo", 2.5],
    "model_train_freq": [2.5, 0],
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_value_is_named_with_what_it_must_be(name):
    for value in WRONG[name]:
        with pytest.raises(
            ValueError, match=rf"^{name}.*(must|does not exist|cannot be used|has no argument|do not fit into)"
        ):
            RPTO(**{"policy": "MlpPolicy", "env": pendulum(), "target_env": pendulum(12.0), name: value})


def test_load_and_from_source_look_at_their_arguments_before_the_zip():
    for name in set(WRONG) - {"policy", "preset", "dynamics", "dynamics_kwargs", "use_sde", "n_steps"}:
        value = WRONG[name][0]
        for make in (
            lambda **given: RPTO.load("nowhere", **given),
            lambda **given: RPTO.from_source("n", pendulum(), **given),
        ):
            with pytest.raises(ValueError, match=rf"^{name}"):
                make(**{name: value})


#: The same of the backends' arguments.
WRONG_DYNAMICS = {
    "hidden": [(), 64, [0], "64", [8, 1.5], {8}],
    "n_members": [0, 2.5],
    "n_elites": [0, 9],
    "learning_rate": [0, "1e-3"],
    "batch_size": [0],
    "holdout_ratio": [0.6, "0.2"],
    "patience": [0],
    "max_steps": [0, 2.5],
    "min_holdout_for_elites": [-1],
    "noise": ["no"],
    "reward_fn": [3],
}


@pytest.mark.parametrize("name", WRONG_DYNAMICS)
def test_a_wrong_value_of_the_ensemble_is_named(name):
    for value in WRONG_DYNAMICS[name]:
        with pytest.raises(ValueError, match=rf"^(dynamics_kwargs\[')?{name}.* must"):
            small(RPTO, dynamics_kwargs={name: value, **({} if name == "reward_fn" else RULES)})


RULES = {"termination_fn": lambda o, a, n: th.zeros(len(o), dtype=th.bool)}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("total_timesteps", value) for value in (0, -5, 2.5, "10", True)),
        *(("source_timesteps", value) for value in (-1, 2.5, "10")),
        *(("callback", value) for value in ("x", 3, [3])),
        *(("log_interval", value) for value in (0, -1, "4")),
        ("tb_log_name", 3),
        ("reset_num_timesteps", "no"),
        ("progress_bar", 1),
    ],
)
def test_learn_names_a_wrong_argument_before_a_step(name, value):
    model = small(RPO)
    with pytest.raises(ValueError, match=f"^{name} must"):
        model.learn(**{"total_timesteps": 10, name: value})
    assert (model.num_timesteps, model.source_timesteps) == (0, 0)


@pytest.mark.parametrize(
    ("passed", "named"),
    [
        ((3, False, None), "n_steps"),
        ((1, True, None), "optimize_memory_usage"),
        ((1, False, DictReplayBuffer), "replay_buffer_class=DictReplayBuffer"),
    ],
)
def test_what_is_not_supported_is_named(passed, named):
    with pytest.raises(NotImplementedError, match=named):
        arguments.check_supported(*passed)


def test_arguments_without_use_are_named():
    with pytest.raises(ValueError, match=r"RPO does not use \['declared', 'weighting'\]"):
        arguments.check_applicable("RPO", False, {"env", "weighting", "declared"})


@pytest.mark.parametrize(
    ("kinds", "error", "message"),
    [(["coulomb"], ValueError, "effects.*coulomb_friction"), ("coulomb_friction", TypeError, "effects must be")],
)
def test_effects_to_look_for_are_checked_at_once(kinds, error, message):
    env, target = (gym.make("InvertedDoublePendulum-v5") for _ in range(2))
    with pytest.raises(error, match=message):
        small(RPTO, env, target, dynamics="physical", dynamics_kwargs={}, close_loop=True, effects=kinds)


@pytest.mark.parametrize("rule", ["reward_fn", "termination_fn"])
@pytest.mark.parametrize("answer", [lambda o, a, n: np.zeros(len(o)), lambda o, a, n: o])
def test_rules_that_answer_in_another_form_are_refused_at_once(rule, answer):
    with pytest.raises(ValueError, match=rf"dynamics_kwargs\['{rule}'\] must answer"):
        small(RPTO, dynamics_kwargs={**SMALL_ENSEMBLE, rule: answer})


def test_a_fit_of_no_steps_is_refused_at_once():
    with pytest.raises(ValueError, match="max_steps must be a positive integer"):
        small(RPTO, dynamics_kwargs={**SMALL_ENSEMBLE, "max_steps": 0})


def test_a_monitor_that_forbids_resets_is_refused_before_the_source_phase():
    model = small(RPO, Monitor(pendulum(), allow_early_resets=False))
    with pytest.raises(ValueError, match="allow_early_resets"):
        model.learn(10)
    assert model.source_timesteps == 0


def test_a_batch_keeps_a_row_of_the_source():
    model = small(RPO, real_ratio=0.99, batch_size=32, gradient_steps=5)
    model.learn(20, source_timesteps=0)
    assert model._n_updates == 100
    batches = list(model.critic_batches(5, 32))
    assert [len(b.rewards) for b in batches] == [32] * 5


def test_a_single_declared_name_does_not_come_apart_into_letters():
    env, target = (gym.make("InvertedDoublePendulum-v5") for _ in range(2))
    with pytest.raises(TypeError, match=r"list of names, not the string 'pole.length'; write \['pole.length'\]"):
        small(RPTO, env, target, dynamics="physical", dynamics_kwargs={}, declared="pole.length")


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        ({"pole.length": (0.1, 1.0)}, "not a mapping; bounds are part of a name"),
        ([1], r"not \[1\]"),
        ([{"pole.length": None}], "not .*in YAML put a name that begins with '\\?' in quotes"),
        (None, "not None"),
    ],
)
def test_declared_names_of_another_type_are_refused(declared, said):
    with pytest.raises(TypeError, match=f"declared must be a list of names, {said}"):
        physical(declared=declared)


def test_declared_numbers_among_the_known_effects_are_refused():
    (length,) = declare(gym.make("InvertedDoublePendulum-v5").unwrapped.model, ["pole.length"])
    with pytest.raises(ValueError, match=r"holds declared numbers, pole.length: .* name those in declared="):
        physical(dynamics_kwargs={"effects": [length]})


def physical(**kwargs):
    env, target = (gym.make("InvertedDoublePendulum-v5") for _ in range(2))
    return small(RPTO, env, target, dynamics="physical", **kwargs)


def test_whole_episodes_have_no_branches_to_start():
    with pytest.raises(ValueError, match="rollout_start is for one-step branches"):
        physical(declared=["pole.length"], rollout_start="target", dynamics_kwargs={})


@pytest.mark.parametrize("closed", [{}, {"close_loop": True, "effects": ["spring"]}])
def test_effects_that_are_known_are_trained(closed):
    given = {"effects": [LIBRARY["command_delay"]("slide", delay=0.03).to_json()]}
    made = physical(dynamics_kwargs=given, **closed)
    assert made.dynamics.names == ["command_delay(slide).delay"]


def test_effects_need_not_be_plain_data():
    delay = LIBRARY["command_delay"]("slide", delay=0.03)
    made = physical(dynamics_kwargs={"effects": [delay]})
    assert made.dynamics.names == ["command_delay(slide).delay"]
    assert made.dynamics_kwargs["effects"] == [delay.to_json()]


@pytest.mark.parametrize(
    ("error", "kwargs", "said"),
    [
        (TypeError, {"dynamics_kwargs": {"effects": LIBRARY["command_delay"]("slide", delay=0.03)}}, "a list of effe"),
        (TypeError, {"dynamics_kwargs": {"effects": ["command_delay"]}}, r"effects or their to_json\(\), not 'comm"),
        (ValueError, {"dynamics_kwargs": {"effects": [{"kind": "command_delay"}]}}, "it lacks on, values"),
        (ValueError, {"dynamics_kwargs": {"max_steps": 2.5}}, "max_steps must be a positive integer"),
        (ValueError, {"dynamics_kwargs": {"threads": -1}}, "threads must be a number of threads from 1"),
        (ValueError, {"close_loop": None}, "close_loop must be True or False"),
        (ValueError, {"close_loop": ["spring"]}, "close_loop must be True or False .*effects="),
        (TypeError, {"close_loop": True, "effects": None}, 'effects must be "all" or a list of kinds'),
        (ValueError, {"declared": ["pole.length"], "effects": ["spring"]}, "pass close_loop=True, too"),
    ],
)
def test_wrong_settings_of_a_simulator_are_refused_at_once(error, kwargs, said):
    with pytest.raises(error, match=said):
        physical(**{"declared": ["hinge.damping"], "dynamics_kwargs": {}, **kwargs})


def test_what_acts_on_target_steps_has_no_use_for_a_log():
    log = small(RPO).learn(30, source_timesteps=0).replay_buffer
    with pytest.raises(ValueError, match="action_noise, train_freq has no use"):
        RTO("MlpPolicy", pendulum(), target_data=log, train_freq=2, action_noise=NormalActionNoise(0.0, 0.1))


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ({"weighting": "value-aware"}, "weighting='value-aware' does not exist"),
        ({"source_steps": 0}, "source_steps must be a positive integer"),
        ({"gradient_stps": 5}, "'gradient_stps', which is no argument; did you mean 'gradient_steps'"),
    ],
)
def test_what_load_changes_is_looked_at_as_well(kwargs, said, tmp_path):
    small(RPTO).save(tmp_path / "model")
    with pytest.raises(ValueError, match=said):
        RPTO.load(tmp_path / "model", **kwargs)
    assert RPTO.load(tmp_path / "model", gradient_steps=3, weighting="centred", device="cpu").gradient_steps == 3


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        ([LIBRARY["command_delay"]("slide")], "does nothing"),
        ([LIBRARY["viscous_friction"]("hinge", coefficient=0.1)], "is a number that is declared, too"),
        ([LIBRARY["command_delay"]("slide", delay=d) for d in (0.02, 0.03)], "is there twice"),
    ],
)
def test_known_effects_that_a_trace_would_refuse_are_refused_before_the_first_step(effects, said):
    given = {"effects": [effect.to_json() for effect in effects]}
    with pytest.raises(ValueError, match=said):
        physical(close_loop=True, effects=["spring"], declared=["hinge.damping"], dynamics_kwargs=given)


@pytest.mark.parametrize("wrapper", [gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward])
@pytest.mark.parametrize("normalised", [0, 1])
def test_statistics_of_one_world_alone_are_refused(normalised, wrapper):
    worlds = [pendulum(), pendulum(12.0)]
    worlds[normalised] = wrapper(worlds[normalised])
    with pytest.raises(ValueError, match=rf"{wrapper.__name__}.*VecNormalize"):
        small(RPO, *worlds)


@pytest.mark.parametrize("nested", [False, True])
def test_a_callback_that_evaluates_in_the_target_itself_is_refused(nested):
    target = Monitor(pendulum(12.0))
    model = small(RPO, pendulum(), target)
    callback = EvalCallback(target, eval_freq=10, verbose=0)
    with pytest.raises(ValueError, match="EvalCallback evaluates in target_env itself"):
        model.learn(20, callback=[EveryNTimesteps(5, callback)] if nested else callback, source_timesteps=0)
    assert model.target_spent == {}
    model.learn(20, callback=EvalCallback(Monitor(pendulum(12.0)), eval_freq=10, verbose=0), source_timesteps=0)


def test_a_budget_that_ends_before_the_first_fit_is_told():
    with pytest.warns(UserWarning, match="total_timesteps=20 ends before the first fit.*lower model_train_freq"):
        small(RPTO, model_train_freq=50).learn(20, source_timesteps=40)


def test_a_budget_that_ends_before_the_first_trace_is_told_before_that_of_the_fit():
    model = physical(close_loop=True, effects=["spring"], declared=["hinge.damping"])
    with pytest.warns(UserWarning, match="ends before the closed loop's first trace, for which it waits 2.. target"):
        arguments.warn_of_little(model, 20)


@pytest.mark.parametrize(
    ("passed", "said"),
    [
        ({"closed_loop": True}, "RPTO has no argument 'closed_loop'; did you mean 'close_loop'"),
        ({"target": "x"}, "RPTO has no argument 'target'; did you mean .*'target_env'"),
        ({"learning_rate": pendulum()}, "learning_rate must be a number or a schedule, not .*target_env="),
    ],
)
def test_arguments_that_do_not_exist_or_stand_in_the_wrong_place_are_told(passed, said):
    with pytest.raises(TypeError, match=said):
        RPTO("MlpPolicy", pendulum(), **passed)


def test_a_subclass_may_take_arguments_of_its_own():
    class Mine(RPO):
        def __init__(self, *args, colour="red", **kwargs):
            super().__init__(*args, **kwargs)

    assert small(Mine, pendulum(), pendulum(12.0), colour="blue").updates_policy
    with pytest.raises(TypeError, match="Mine has no argument 'color'; did you mean 'colour'"):
        small(Mine, pendulum(), pendulum(12.0), color="blue")


def test_what_a_subclass_sets_wins_over_the_preset():
    class Mine(RPTO):
        def __init__(self, env, gradient_steps=7, **kwargs):
            super().__init__("MlpPolicy", env, 3e-4, 2_000, gradient_steps=gradient_steps, source_steps=10, **kwargs)

    plain, mine = RPTO("MlpPolicy", pendulum(), dynamics_kwargs={"hidden": [4]}), Mine(pendulum())
    names = ("buffer_size", "gradient_steps", "source_steps", "model_train_freq")
    assert [getattr(mine, name) for name in names] == [2_000, 7, 10, plain.model_train_freq]
    assert plain.gradient_steps != 7


def test_a_source_model_that_is_not_there_is_named():
    with pytest.raises(FileNotFoundError, match=r"source_model='nowhere\.zip': there is no such file"):
        RPO.from_source("nowhere.zip", pendulum())


def test_next_to_no_updates_offline_are_told():
    model = small(RPTO, source_steps=400, gradient_steps=5)
    model.target = OfflineTarget()
    told = r"3 rounds of 400 \(source_steps=400\) with 5 updates each by gradient_steps=5, 15 in all"
    with pytest.warns(UserWarning, match=told):
        arguments.warn_of_little(model, 1_200)
    model.gradient_steps = -1
    with pytest.warns(UserWarning, match="with 1 updates each by gradient_steps=-1, 3 in all"):
        arguments.warn_of_little(model, 1_200)
    model.gradient_steps = 0  # nobody asked for any
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arguments.warn_of_little(model, 1_200)


@pytest.mark.parametrize(("agent", "error"), [(PPO, TypeError), (TD3, TypeError)])
def test_a_source_model_of_another_kind_is_refused(agent, error, tmp_path):
    other = agent("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [4]})
    with pytest.raises(error, match=f"source_model must be a SAC.*not {agent.__name__}"):
        RPTO.from_source(other, pendulum(), pendulum(12.0))
    other.save(tmp_path / "other.zip")
    with pytest.raises(ValueError, match="is not the zip of a SAC"):
        RPTO.from_source(tmp_path / "other.zip", pendulum(), pendulum(12.0))


def test_a_zip_of_tqc_is_no_sacs_though_it_loads_as_one(tmp_path):
    TQC("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [4]}, buffer_size=10).save(tmp_path / "tqc.zip")
    with pytest.raises(ValueError, match=r"is not the zip of a SAC \(another .* a policy of sb3_contrib\.tqc"):
        RPTO.from_source(tmp_path / "tqc.zip", pendulum(), pendulum(12.0))


@pytest.mark.parametrize("agent", [PPO, TD3, TQC])
def test_load_says_that_a_zip_is_another_algorithms(agent, tmp_path):
    agent("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [4]}).save(tmp_path / "other.zip")
    of_policy = agent.policy_aliases["MlpPolicy"].__module__
    with pytest.raises(
        ValueError, match=rf"other.zip was not saved by RPTO \(.* a policy of {of_policy}\).*from_source"
    ):
        RPTO.load(tmp_path / "other.zip", pendulum(), target_env=pendulum(12.0))


def _no_zips(folder):
    """Paths that hold no whole zip of a model, by what is to be said of them."""
    PPO("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [4]}).save(folder / "whole.zip")
    whole = (folder / "whole.zip").read_bytes()
    (folder / "cut.zip").write_bytes(whole[: len(whole) // 2])
    (folder / "text.zip").write_text("no zip at all")
    (folder / "flipped.zip").write_bytes(whole.replace(b'"policy_class"', b'"policy_clash"', 1))
    (folder / "empty").mkdir()
    with zipfile.ZipFile(folder / "photos.zip", "w") as archive:
        archive.writestr("beach.png", b"")
    return {
        "cut.zip": "is a zip that was cut off; copy it anew",
        "text.zip": "is no zip of a model",
        "flipped.zip": "is damaged at its entry 'data'",
        "empty": "is a folder, without the zip of a model",
        ".": "is a folder; pass the zip of a model, such as 'cut.zip' in it",
        "photos.zip": "is no zip of a model of Stable-Baselines3",
    }


def test_what_is_no_whole_zip_of_a_model_is_told(tmp_path):
    for name, said in _no_zips(tmp_path).items():
        with pytest.raises(ValueError, match=f"path=.*{said}"):
            RPTO.load(tmp_path / name)
        with pytest.raises(ValueError, match=f"source_model=.*{said}"):
            RPTO.from_source(tmp_path / name, pendulum())
    with pytest.raises(ValueError, match="is a zip that was cut off"), (tmp_path / "cut.zip").open("rb") as file:
        RPTO.load(file)
    with pytest.raises(FileNotFoundError, match=r"path='nowhere': there is no such file"):
        RPTO.load("nowhere")
    with pytest.raises(TypeError, match="path must be the path of a zip or an open file, not dict"):
        RPTO.load({})


def test_a_zip_without_its_suffix_is_found_beside_a_folder_of_that_name(tmp_path):
    small(RPO).save(tmp_path / "model.zip")
    (tmp_path / "model").mkdir()
    assert RPO.load(tmp_path / "model").env is None
    with pytest.raises(TypeError, match="env must be a gymnasium environment"):
        RPO.load(tmp_path / "model", 3)


@pytest.mark.parametrize("given", [3, [pendulum]])
@pytest.mark.parametrize("name", ["env", "target_env"])
def test_what_is_no_environment_is_refused(name, given):
    worlds = {"env": pendulum(), "target_env": pendulum(12.0), name: given}
    with pytest.raises(TypeError, match=rf"^{name} must be a gymnasium environment.*not {type(given).__name__}"):
        RPO("MlpPolicy", **worlds)


def test_load_takes_ids_as_the_constructor_does(tmp_path):
    small(RPO).save(tmp_path / "model.zip")
    model = RPO.load(tmp_path / "model.zip", "Pendulum-v1", target_env="Pendulum-v1")
    assert model.env is not None
    assert model.target_env is not None


def test_environments_may_be_given_by_functions_that_make_them():
    model = small(RPO, pendulum, lambda: pendulum(12.0))
    assert model.env.envs[0].unwrapped.g == 10.0
    assert model.target_env.envs[0].unwrapped.g == 12.0
    with pytest.raises(TypeError, match="target_env: the function returned int"):
        small(RPO, pendulum, lambda: 3)
