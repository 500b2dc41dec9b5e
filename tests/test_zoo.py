"""The RL Zoo with two worlds: settings, training, resuming, searching, and what is said to wrong arguments."""

from __future__ import annotations

import csv
import importlib
import json
import shutil
import sys
from collections import OrderedDict
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from conftest import SMALL_ENSEMBLE, pendulum
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rpto import RPO, RPTO
from sb3_rpto.algorithms.transition_checks import NotFiniteError
from sb3_rpto.baselines.registry import REGISTRY
from sb3_rpto.envs import tasks
from sb3_rpto.presets import preset_names, resolve_preset
from sb3_rpto.zoo import enjoy, train
from sb3_rpto.zoo.samplers import SAMPLERS, convert
from sb3_rpto.zoo.settings import (
    ALGORITHMS,
    settings_beside,
    shipped_algorithms,
    shipped_file,
    shipped_settings,
    source_of,
)

SOURCE, TARGET = "rpto/ContinuousCartPole-v0", "rpto/ContinuousCartPole-limb-x2-v0"
SMALL = ["-params", "gradient_steps:1", "source_steps:2"]
COLD = [*SMALL, "policy_kwargs:dict(net_arch=[16])", "normalize:True"]

# ---------------------------------------------------------------------- settings: no rl_zoo3 needed


def test_every_algorithm_has_settings_for_every_task():
    assert set(shipped_algorithms()) == {*ALGORITHMS, "sac"}
    assert set(ALGORITHMS) < set(REGISTRY)
    for algo in shipped_algorithms():
        written = shipped_file(algo).read_text()
        for task in tasks.TASKS:
            assert f"{tasks.env_id(task)}:" in written
            settings = shipped_settings(algo, tasks.env_id(task))
            assert settings["policy"] == "MlpPolicy"
            assert settings == shipped_settings(algo, tasks.env_id(task, "target0"))
        assert shipped_settings(algo, "SomebodysRobot-v3")["n_timesteps"] > 0


@pytest.mark.parametrize("task", tasks.TASKS)
def test_a_number_has_one_place(task):
    """Of what a preset or the authors' numbers set, the zoo's files repeat nothing."""
    env_id = tasks.env_id(task)
    budgets = set()
    for algo, cls in ALGORITHMS.items():
        settings = shipped_settings(algo, env_id)
        budgets.add(settings.pop("n_timesteps"))
        assert settings.pop("policy") == "MlpPolicy"
        if hasattr(cls, "published"):
            set_elsewhere = cls.published(env_id)
            stage = settings.pop("model_train_freq", None)  # SLBO's, in budgets too small for the published one
            assert stage in (None, max(budgets) // 4)
        else:
            preset = settings.pop("preset")
            assert preset in preset_names()
            set_elsewhere = resolve_preset(preset, "ensemble" if cls.updates_dynamics else "real", env_id, ())
        assert not settings.keys() & set_elsewhere.keys()
        papers = resolve_preset("paper", "ensemble", env_id, ())
        assert settings == {name: papers[name] for name in settings}  # gamma of the Swimmer
        assert settings.get("gamma", set_elsewhere.get("gamma")) == papers.get("gamma") == shipped_settings(
            "sac", env_id
        ).get("gamma") or (task == "ContinuousCartPole")
    assert len(budgets) == 1  # a comparison has one budget


def test_the_presets_are_not_the_zoos_files():
    assert preset_names() == ["author", "default", "paper"]


def test_the_source_of_a_target():
    assert source_of("rpto/Hopper-gravity-x2-v0") == source_of("rpto/Hopper-v0") == "rpto/Hopper-v0"
    assert source_of("Hopper-v5") is None
    assert source_of("Nothing-v7") is None


def test_settings_beside_a_zip_are_read_as_plain_data(tmp_path):
    folder = tmp_path / "run" / "agent"
    folder.mkdir(parents=True)
    told = OrderedDict(n_envs=2, train_freq=(1, "step"), env_kwargs={"g": [9.0]}, normalize=True)
    ran = tmp_path / "ran"
    evil = f"!!python/object/apply:os.mkdir ['{ran}']"
    text = yaml.dump(OrderedDict(told, activation=np.float64)).rstrip() + f"\n  - - evil\n    - {evil}\n"
    (folder / "config.yml").write_text(text)
    with pytest.raises(yaml.YAMLError):  # as any reader of plain data says
        yaml.safe_load(text)
    assert settings_beside(str(tmp_path / "run" / "agent.zip"), "config.yml") == told
    assert not ran.exists()
    for wrong in ("[1, 2]", "a: [", f"{evil}"):
        (folder / "config.yml").write_text(wrong)
        with pytest.raises(ValueError, match=r"(?s)config\.yml .*mend it"):
            settings_beside(str(tmp_path / "run" / "agent.zip"), "config.yml")
    assert not ran.exists()


def test_an_algorithm_without_settings_names_the_others():
    with pytest.raises(ValueError, match="rpto"):
        shipped_settings("ppo", SOURCE)


# ---------------------------------------------------------------------- the search space


class Draws:
    """Stands in for a trial: the first or the last of what may be drawn."""

    def __init__(self, last: bool) -> None:
        self.last, self.drawn = last, {}

    def suggest_int(self, name, low, high, log=False):
        return self._keep(name, high if self.last else low)

    suggest_float = suggest_int

    def suggest_categorical(self, name, choices):
        return self._keep(name, choices[-1 if self.last else 0])

    def _keep(self, name, value):
        self.drawn[name] = value
        return value


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("algo", SAMPLERS)
def test_what_is_drawn_are_arguments_of_the_algorithm(algo, last):
    trial = Draws(last)
    kwargs = SAMPLERS[algo](trial, 1, 1, {})
    assert kwargs == convert(trial.drawn)  # what the zoo's --trial-id makes of the study
    if "dynamics_kwargs" in kwargs:
        kwargs["dynamics_kwargs"] |= {k: v for k, v in SMALL_ENSEMBLE.items() if k != "max_steps"}
    model = ALGORITHMS[algo]("MlpPolicy", pendulum(), target_env=pendulum(12.0), device="cpu", **kwargs)
    for name in kwargs.keys() - {"dynamics_kwargs", "learning_rate"}:
        assert getattr(model, name) == kwargs[name]


# ---------------------------------------------------------------------- with rl_zoo3


@pytest.fixture(scope="module")
def zoo():
    """rl_zoo3 without what it does to gymnasium: other tests run in this process."""
    places = [gym.wrappers, gym.wrappers.common]
    kept = [(place, place.TimeLimit) for place in places]
    rl_zoo3 = pytest.importorskip("rl_zoo3", reason="the extra 'zoo' is not installed")
    yield rl_zoo3
    for place, time_limit in kept:
        place.TimeLimit = time_limit


@pytest.fixture(scope="module")
def agent(tmp_path_factory) -> Path:
    """The zip of a SAC of the source, hardly trained."""
    path = tmp_path_factory.mktemp("source") / "sac.zip"
    SAC("MlpPolicy", gym.make(SOURCE), gamma=0.97, policy_kwargs={"net_arch": [16]}, device="cpu").save(path)
    return path


def launch(folder: Path, algo: str, *options: str, env: str = TARGET) -> Path:
    """Train; the folder of the run."""
    common = ["--seed", "1", "--device", "cpu", "--verbose", "0", "-f", str(folder)]
    assert train.main(["--algo", algo, "--env", env, *common, *options]) == 0
    runs = sorted((folder / algo).glob(f"{env.replace('/', '-')}_*"))
    return runs[-1]


def final(run: Path) -> Path:
    return run / f"{run.name.rpartition('_')[0]}.zip"


@pytest.fixture(scope="module")
def trained(zoo, tmp_path_factory) -> Path:
    """A run of RPO from scratch, with a checkpoint in its middle."""
    folder = tmp_path_factory.mktemp("logs")
    evaluation = ["--eval-freq", "20", "--eval-episodes", "2"]
    saving = ["--save-freq", "20", "--save-replay-buffer"]
    return launch(folder, "rpo", "-n", "40", "--source-timesteps", "120", *evaluation, *saving, *COLD)


@pytest.mark.slow
def test_training_is_judged_on_the_target(trained):
    model = RPO.load(final(trained), device="cpu")
    assert model.num_timesteps == 40
    assert model.target_spent == {"learning": 40}
    assert model.preset == "default"
    assert model.real_ratio == resolve_preset("default", "real", SOURCE, ())["real_ratio"]
    assert model.state.pretraining_timesteps == 120
    with np.load(trained / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [20, 40]
    header = (trained / "0.monitor.csv").read_text().splitlines()[0]
    assert TARGET in header  # the zoo's curves are the target's


def test_a_resumed_run_is_the_one_that_was_not_stopped(trained):
    checkpoint = str(trained / "rl_model_20_steps.zip")
    resumed = launch(trained.parents[1], "rpo", "-n", "40", "--eval-freq", "-1", "-i", checkpoint)
    assert resumed != trained
    one, other = (RPO.load(final(run), device="cpu") for run in (trained, resumed))
    assert other.num_timesteps == 40
    theirs = other.policy.state_dict()
    assert all(th.equal(value, theirs[name]) for name, value in one.policy.state_dict().items())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-n", "20"], "--n-timesteps above"),
        (["-n", "40", "-params", "gradient_steps:2"], "leave gradient_steps out of -params"),
    ],
)
def test_what_cannot_be_resumed_is_said(trained, options, message):
    with pytest.raises(ValueError, match=message):
        launch(trained.parents[1], "rpo", "--eval-freq", "-1", "-i", str(trained / "rl_model_20_steps.zip"), *options)


def test_another_seed_begins_new_streams(trained):
    checkpoint = str(trained / "rl_model_20_steps.zip")
    common = ["-n", "30", "--eval-freq", "-1", "-i", checkpoint]
    one, other = (
        RPO.load(final(launch(trained.parents[1], "rpo", *common, "--seed", seed)), device="cpu") for seed in "12"
    )
    assert (one.seed, other.seed) == (1, 2)
    theirs = other.policy.state_dict()
    assert any(not th.equal(value, theirs[name]) for name, value in one.policy.state_dict().items())


def test_worlds_are_as_they_were_where_a_run_goes_on(zoo, tmp_path, capsys):
    begun = launch(tmp_path, "rpo", "-n", "4", "--source-timesteps", "120", "--eval-freq", "-1", *COLD, "n_envs:2")
    capsys.readouterr()
    resumed = launch(tmp_path, "rpo", "-n", "8", "--eval-freq", "-1", "-i", str(final(begun)))
    assert "As before: n_envs: 2, normalize: True" in capsys.readouterr().out
    assert settings_beside(str(final(resumed)), "config.yml")["n_envs"] == 2
    last = launch(tmp_path, "rpo", "-n", "12", "--eval-freq", "-1", "-i", str(final(resumed)), "-params", "n_envs:1")
    config = settings_beside(str(final(last)), "config.yml")
    assert (config["n_envs"], config["normalize"]) == (1, True)


def test_a_buffer_of_a_later_time_is_told(trained):
    with pytest.warns(UserWarning, match=r"holds 40 target transitions, .*taken 20"):
        launch(trained.parents[1], "rpo", "-n", "41", "--eval-freq", "-1", "-i", str(_best_at_20(trained)))


def _best_at_20(run: Path) -> Path:
    """A best model of the middle of a run, beside the replay buffer of its end."""
    return shutil.copy(run / "rl_model_20_steps.zip", run / "best_model.zip")


def test_a_run_that_cannot_begin_leaves_no_folder(trained):
    runs = sorted((trained.parent).iterdir())
    with pytest.raises(ValueError, match="--n-timesteps above"):
        launch(trained.parents[1], "rpo", "-n", "20", "-i", str(trained / "rl_model_20_steps.zip"))
    assert sorted((trained.parent).iterdir()) == runs


def test_enjoy_runs_the_agent(trained, capsys):
    folder = str(trained.parents[1])
    options = ["--algo", "rpo", "--env", TARGET, "-f", folder, "--exp-id", "1", "--no-render", "-n", "120"]
    assert enjoy.main([*options, "--device", "cpu"]) == 0
    assert "Mean reward" in capsys.readouterr().out


def test_a_source_agent_brings_its_settings_along(zoo, agent, tmp_path):
    source = ["--source-model", str(agent), "-n", "4", "--eval-freq", "-1"]
    physical = ["dynamics:'physical'", "declared:['pole_length']"]
    run = launch(tmp_path, "rpto", *source, *SMALL, *physical, "batch_size:16")
    model = RPTO.load(final(run), device="cpu")
    assert (model.gamma, model.batch_size, model.state.pretraining_timesteps) == (0.97, 16, 0)
    assert model.policy_kwargs["net_arch"] == [16]
    saved = (run / final(run).stem / "args.yml").read_text()
    assert str(agent) in saved
    assert SOURCE in saved


def test_an_agent_of_another_task_is_refused_in_a_line(zoo, agent, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        launch(tmp_path, "rpo", "--source-model", str(agent), *SMALL, env="rpto/InvertedDoublePendulum-target0-v0")
    assert "error: --source-model: source_model has observation_space" in capsys.readouterr().err
    assert not any(tmp_path.glob("rpo/*"))


def test_another_factor_is_a_target_too(zoo, agent, tmp_path):
    source = ["--source-model", str(agent), "-n", "4", "--eval-freq", "2", "--eval-episodes", "1"]
    run = launch(tmp_path, "rpo", *source, "--eval-env-kwargs", "shift:'limb-x3'", *SMALL, env=SOURCE)
    saved = yaml.unsafe_load((run / final(run).stem / "args.yml").read_text())  # the zoo's enjoy reads its env_kwargs
    assert (saved["env_kwargs"], saved["source_env_kwargs"]) == ({"shift": "limb-x3"}, None)
    assert RPO.load(final(run), device="cpu").num_timesteps == 4


def test_a_normalised_agent_is_played_as_it_was_trained(zoo, tmp_path, monkeypatch):
    small = ["-params", "normalize:dict(norm_obs=True,norm_reward=False)", "policy_kwargs:dict(net_arch=[16])"]
    sac = final(launch(tmp_path, "sac", "-n", "20", "--eval-freq", "-1", *small, env=SOURCE))
    run = launch(tmp_path, "rpo", "--source-model", str(sac), "-n", "4", "--eval-freq", "-1", *SMALL)
    assert RPO.load(final(run), device="cpu").resume_point.normalised
    played, rl_zoo3_enjoy = [], pytest.importorskip("rl_zoo3.enjoy")
    make = rl_zoo3_enjoy.create_test_env
    monkeypatch.setattr(rl_zoo3_enjoy, "create_test_env", lambda *a, **k: played.append(make(*a, **k)) or played[-1])
    options = ["--algo", "rpo", "--env", TARGET, "-f", str(tmp_path), "--no-render", "-n", "5", "--device", "cpu"]
    assert enjoy.main(options) == 0
    assert isinstance(played[0], VecNormalize)
    warm = launch(tmp_path, "sac", "-i", str(sac), "-n", "4", "--eval-freq", "-1")
    assert (warm / final(warm).stem / "vecnormalize.pkl").is_file()


def test_ctrl_c_in_the_source_phase_saves_also_with_a_progress_bar_and_workers_that_it_ended(
    zoo, tmp_path, monkeypatch
):
    begin = RPO.prepare_in_source

    def gone(world):
        raise ConnectionResetError

    def interrupted(model, *args):
        begin(model, *args)
        monkeypatch.setattr(type(model.env.unwrapped), "close", gone)
        raise KeyboardInterrupt

    monkeypatch.setattr(RPO, "prepare_in_source", interrupted)
    run = launch(tmp_path, "rpo", "-P", "-n", "4", "--source-timesteps", "120", "--eval-freq", "-1", *COLD)
    assert RPO.load(final(run), device="cpu").state.pretraining_timesteps == 120


def test_what_a_search_draws_joins_the_settings():
    manager = pytest.importorskip("sb3_rpto.zoo.manager", reason="the extra 'zoo' is not installed")
    drawn = {"rollout_start": "mix", "dynamics_kwargs": {"max_steps": 9}}
    joined = manager._applicable(drawn, {"dynamics_kwargs": {"hidden": (8,), "max_steps": 5}})
    assert joined == {"rollout_start": "mix", "dynamics_kwargs": {"hidden": (8,), "max_steps": 9}}
    assert manager._applicable({"rollout_start": "mix"}, {"dynamics": "physical"}) == {}


@pytest.mark.slow
def test_an_environments_module_is_imported_where_it_runs(zoo, tmp_path, monkeypatch):
    (tmp_path / "faraway.py").write_text(
        "import gymnasium as gym\n"
        "from gymnasium.envs.classic_control import PendulumEnv\n"
        "gym.register('faraway/Pendulum-v0', 'faraway:PendulumEnv', max_episode_steps=20)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    importlib.import_module("faraway")
    worlds = ["--source-env", "faraway/Pendulum-v0", "--eval-env-kwargs", "g:12.0", "--vec-env", "subproc"]
    cold = ["-n", "4", "--source-timesteps", "40", "--eval-freq", "-1", *SMALL, "policy_kwargs:dict(net_arch=[16])"]
    run = launch(tmp_path, "rpo", *worlds, *cold, "n_envs:2", env="faraway/Pendulum-v0")
    assert RPO.load(final(run), device="cpu").num_timesteps == 4


@pytest.mark.parametrize("place", ["vecnormalize.pkl", "{source}/vecnormalize.pkl", "sac/vecnormalize.pkl"])
def test_a_source_agent_brings_its_statistics_along(zoo, agent, tmp_path, place):
    from sb3_rpto.zoo.manager import Start, TransferManager

    shutil.copy(agent, tmp_path / "sac.zip")
    seen = VecNormalize(make_vec_env(SOURCE))
    seen.obs_rms.mean[:] = 7.0
    path = tmp_path / place.format(source=SOURCE.replace("/", "-"))  # as the zoo calls its folder
    path.parent.mkdir(parents=True, exist_ok=True)
    seen.save(str(path))
    manager = TransferManager.__new__(TransferManager)
    manager.normalize = False
    manager.trained_agent, manager.start = "", Start(SOURCE, str(tmp_path / "sac.zip"))
    assert manager._maybe_normalize(make_vec_env(SOURCE), False).obs_rms.mean.tolist() == [7.0] * 4


def test_sac_that_was_trained_takes_no_random_steps_in_the_target(zoo, agent, tmp_path):
    run = launch(tmp_path, "sac", "-i", str(agent), "-n", "4", "--eval-freq", "-1")
    assert SAC.load(final(run), device="cpu").learning_starts == 0


def test_transitions_of_another_world_are_not_taken_into_the_target(zoo, tmp_path):
    short = ["--eval-freq", "-1", "--save-replay-buffer", "-params", "policy_kwargs:dict(net_arch=[16])"]
    there = final(launch(tmp_path, "sac", "-n", "30", *short, env=SOURCE))
    for env, held in ((TARGET, 4), (SOURCE, 34)):
        run = launch(tmp_path, "sac", "-i", str(there), "-n", "4", *short, env=env)
        model = SAC.load(final(run), device="cpu")
        model.load_replay_buffer(run / "replay_buffer.pkl")
        assert model.replay_buffer.size() == held


@pytest.mark.slow
@pytest.mark.parametrize(("told", "held"), [(None, 4), (SOURCE, 4), (TARGET, 34)])
def test_nor_are_those_beside_a_zip_of_another_command(told, held, zoo, tmp_path):
    short = ["--eval-freq", "-1", "--save-replay-buffer", "-params", "policy_kwargs:dict(net_arch=[16])"]
    run = final(launch(tmp_path, "sac", "-n", "30", *short, env=SOURCE)).parent
    (tmp_path / "ours").mkdir()
    for file, name in ((final(run), "model.zip"), (run / "replay_buffer.pkl", "replay_buffer.pkl")):
        shutil.copy(file, tmp_path / "ours" / name)
    if told is not None:
        (tmp_path / "ours" / "config.json").write_text(json.dumps({"command": "train", "target": told}))
    run = launch(tmp_path, "sac", "-i", str(tmp_path / "ours" / "model.zip"), "-n", "4", *short, env=TARGET)
    model = SAC.load(final(run), device="cpu")
    model.load_replay_buffer(run / "replay_buffer.pkl")
    assert model.replay_buffer.size() == held


def test_a_search_is_judged_on_the_target(zoo, agent, tmp_path, monkeypatch):
    from sb3_rpto.zoo.manager import TransferManager

    made = []
    create = TransferManager.create_envs

    def watched(self, n_envs, eval_env=False, no_log=False):
        envs = create(self, n_envs, eval_env, no_log)
        made.append((eval_env, envs.get_attr("spec")[0].id))
        return envs

    monkeypatch.setattr(TransferManager, "create_envs", watched)
    search = ["-optimize", "--n-trials", "2", "--sampler", "random", "--pruner", "none", "--no-optim-plots"]
    judged = ["-n", "4", "--n-evaluations", "2", "--eval-episodes", "1"]
    study = ["--storage", str(tmp_path / "study.log"), "--study-name", "small"]
    options = [
        "--algo",
        "rpo",
        "--env",
        TARGET,
        "-f",
        str(tmp_path),
        "--source-model",
        str(agent),
        "--seed",
        "1",
        *study,
    ]
    assert train.main([*options, *search, *judged, "--verbose", "0", "-params", "batch_size:16"]) == 0
    assert set(made) == {(False, SOURCE), (True, TARGET)}
    (report,) = (tmp_path / "rpo").glob("report_*.csv")
    assert not [path for path in (tmp_path / "rpo").iterdir() if path.is_dir()]  # ``enjoy`` takes the newest
    with report.open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["state"] for row in rows] == ["COMPLETE", "COMPLETE"]
    assert all(float(row["value"]) > 0 and 1 <= int(row["params_gradient_steps"]) <= 40 for row in rows)
    training = ["--source-model", str(agent), "-n", "4", "--eval-freq", "-1", *study]
    for number, row in enumerate(rows):
        model = RPO.load(final(launch(tmp_path, "rpo", *training, "--trial-id", str(number))), device="cpu")
        assert model.gradient_steps == int(row["params_gradient_steps"])
        assert model.lr_schedule(1.0) == pytest.approx(float(row["params_learning_rate"]))  # not the source agent's
    with pytest.raises(ValueError, match="--trial-id 2: study 'small' has fewer trials"):
        launch(tmp_path, "rpo", *training, "--trial-id", "2")
    with pytest.raises(ValueError, match="holds no study 'other'"):
        launch(tmp_path, "rpo", *training, "--study-name", "other", "--trial-id", "1")


def searched(folder: Path, agent: Path, *options: str) -> list[dict[str, str]]:
    """Trials of a search with RPO, by its report."""
    common = ["--algo", "rpo", "--env", TARGET, "-f", str(folder), "--source-model", str(agent), "--seed", "1"]
    search = ["-optimize", "--n-trials", "2", "--sampler", "random", "--pruner", "none", "--no-optim-plots"]
    judged = ["-n", "4", "--n-evaluations", "1", "--eval-episodes", "1", "--device", "cpu", "--verbose", "0"]
    assert train.main([*common, *search, *judged, *options]) == 0
    (report,) = (folder / "rpo").glob("report_*.csv")
    with report.open() as stream:
        return list(csv.DictReader(stream))


def test_a_trial_is_worth_what_the_policy_earns_at_its_end(zoo, agent, tmp_path, monkeypatch):
    from sb3_rpto.zoo import manager

    made, earned = [], iter([7.0, 5.0])

    def evaluated(model, *args):
        made.append((model.num_timesteps, model._n_updates - 4 * model.gradient_steps, model.gradient_steps))
        return next(earned), 0.0

    monkeypatch.setattr(manager, "evaluate_policy", evaluated)
    rows = searched(tmp_path, agent, "-params", "gradient_steps:3")
    assert [float(row["value"]) for row in rows] == [7.0, 5.0]
    assert made == [(4, 0, 3)] * 2  # after the updates of the last step; -params wins over what is drawn


def test_what_a_trial_drew_may_prune_it_and_a_wrong_setting_ends_the_search(zoo, agent, tmp_path, monkeypatch):
    def fails(error):
        def learn(self, *args, **kwargs):
            raise error

        monkeypatch.setattr(RPO, "learn", learn)

    fails(ValueError("a callback in the wrong place"))
    with pytest.raises(ValueError, match="wrong place"):
        searched(tmp_path, agent)
    fails(NotFiniteError("the source environment returned nan"))
    with pytest.raises(ValueError, match="no trial of the search was completed"):
        searched(tmp_path, agent)


# ---------------------------------------------------------------------- wrong arguments


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", SOURCE], "-target0-v0"),
        (["--env", "Pendulum-v1"], "--source-env"),
        (["--env", "rpto/ContinuousCartPole-limb-x3-v0"], "did you mean rpto/ContinuousCartPole-limb-x2-v0"),
        (["--env", TARGET, "--source-model", "absent.zip"], "there is no file 'absent.zip'"),
        (["--env", TARGET, "--source-data", "absent.npz"], "there is no file 'absent.npz'"),
        (["--env", TARGET, "-optimize"], "-optimize needs --source-model"),
        (["--env", TARGET, "--algo", "rto", "--source-model", __file__, "-optimize"], "leaves the policy as it is"),
        (["--env", TARGET, "--source-model", __file__, "-i", "some.zip"], "leave one of them out"),
        (["--env", TARGET, "--trial-id", "0"], "--trial-id 0 needs the --storage and the --study-name"),
        (["--env", TARGET, "--algo", "sac", "--source-model", __file__], "--algo sac has one world"),
    ],
)
def test_wrong_arguments_end_before_the_work(zoo, options, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        train.main(["--algo", "rpto", *options])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("command", [train, enjoy])
def test_without_the_extra_the_remedy_is_named(command, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    assert command.main(["--algo", "rpto"]) == 2
    assert "pip install -e '.[zoo]'" in capsys.readouterr().err
