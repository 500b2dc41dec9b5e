"""The zoo's experiment manager over two worlds: it trains between a source and a target and judges on the target."""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import warnings
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
from huggingface_sb3 import EnvironmentName
from rl_zoo3.callbacks import TrialEvalCallback
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import get_callback_list
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from sb3_rpto.algorithms.checkpointing import TARGET_SEED_OFFSET
from sb3_rpto.algorithms.plain_sac import carried_arguments
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.algorithms.transition_checks import NotFiniteError
from sb3_rpto.algorithms.warm_start import check_source_spaces, load_sac
from sb3_rpto.zoo.samplers import SAMPLERS
from sb3_rpto.zoo.settings import ALGORITHMS, section, settings_beside, shipped_file, source_of, target_beside

#: What torch says where an actor's numbers are not finite.
INVALID = "found invalid values"
#: Settings that no model carries: of the worlds, and of what is called beside the training.
OUTSIDE = ("n_envs", "normalize", "env_wrapper", "monitor_kwargs", "callback")


@dataclass(frozen=True)
class Start:
    """Where a run starts; the target is the zoo's ``--env``.

    :param source_env: id of the source
    :param source_model: zip of the SAC that was trained there; None: the run trains one first
    :param source_data: transitions of the source, as ``from_source`` takes them
    :param source_timesteps: of the training in the source, as ``learn`` takes them
    :param seed: one that was asked for; None: the zoo draws one
    """

    source_env: str
    source_model: str | None = None
    source_data: str | None = None
    source_timesteps: int | None = None
    seed: int | None = None


class TransferManager(ExperimentManager):
    """Trains RPO, RTO, RPTO and the model-based baselines; other algorithms as the zoo does.

    ``env_kwargs`` are the source's, ``eval_env_kwargs`` the target's (by default the same). ``n_envs`` counts source
    environments; there is one target. Monitor files, checkpoints, evaluation and Optuna's trials are the target's.

    :param args: as the zoo's, like all that follow
    :param algo: likewise
    :param env_id: of the target
    :param positional: likewise
    :param start: where a run starts, for an algorithm of ours
    :param keywords: likewise
    """

    def __init__(
        self,
        args: argparse.Namespace,
        algo: str,
        env_id: str,
        *positional: Any,
        start: Start | None = None,
        **keywords: Any,
    ) -> None:
        self._shipped = None
        if not keywords.get("config") and (algo in ALGORITHMS or source_of(env_id)):
            self._shipped = shipped_file(algo)
            keywords["config"] = str(self._shipped) if self._shipped else None
        if start is not None:  # args.yml, which the zoo writes beside the agent, holds them
            vars(args).update({name: value for name, value in vars(start).items() if name != "seed"})
        super().__init__(args, algo, env_id, *positional, **keywords)
        self.start = start
        self.resumes = self.continue_training
        if start is not None and not self.optimize_hyperparameters:
            self.continue_training = True  # the zoo then asks _load_pretrained_agent for the model
        self._n_source_envs = 1
        self._asked = set(self.custom_hyperparams or {})
        #: parameters of a trial of a search, with which the run is to train
        self._drawn: dict[str, Any] = {}

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """As the zoo's; ``enjoy`` takes the newest folder, so that of a search, or of what could not begin, goes."""
        had, begun = Path(self.save_path).exists(), None
        try:
            begun = super().setup_experiment()
        finally:
            if begun is None and not had:
                shutil.rmtree(self.save_path, ignore_errors=True)
        return begun

    # ------------------------------------------------------------------ settings

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """As the zoo's; in a file of ours, a target has the settings of its task.

        A run that goes on has the worlds of the ``config.yml`` that the zoo left beside its zip, unless it is told
        otherwise.
        """
        if self.start is not None and self.trial_id == 0:  # the zoo takes that for none
            self.load_trial(self.storage, self.study_name, self.trial_id)
        env_name = self.env_name
        if self._shipped is not None:
            self.env_name = type(env_name)(section(env_name.gym_id))
        try:
            hyperparams, saved = super().read_hyperparameters()
        finally:
            self.env_name = env_name
        drawn = _applicable(self._not_told(self._drawn), hyperparams)
        for settings in (hyperparams, saved):
            settings.update(drawn)
        if self.resumes and self.start is not None:
            had = settings_beside(self.trained_agent, "config.yml")
            kept = {name: had[name] for name in OUTSIDE if name in had and name not in self._asked}
            if kept:
                print(f"As before: {', '.join(f'{name}: {value}' for name, value in kept.items())}")
            hyperparams.update(kept)
            saved.update(kept)
        return hyperparams, saved

    def load_trial(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As the zoo's; a trial's parameters win over what a source agent brings along.

        With two worlds they join the settings as in the search, :meth:`read_hyperparameters` sees to that.

        :raises ValueError: there is no such study, or no such trial in it
        """
        try:
            found = super().load_trial(*args, **kwargs)
        except KeyError:
            raise ValueError(f"--storage {self.storage} holds no study {self.study_name!r}: see --study-name") from None
        except IndexError:
            raise ValueError(f"--trial-id {self.trial_id}: study {self.study_name!r} has fewer trials") from None
        self._asked |= found.keys()
        if self.start is None:
            return found
        self._drawn = found
        return {}

    def _not_told(self, drawn: dict[str, Any]) -> dict[str, Any]:
        """What a search has drawn but what -params says: that wins, as in the zoo; keyword arguments are joined."""
        told = set(self.custom_hyperparams or ()) - {"dynamics_kwargs"}
        return {name: value for name, value in drawn.items() if name not in told}

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        """As the zoo's; with two worlds ``n_envs`` is taken to be the source's, callbacks count target steps."""
        preprocessed = super()._preprocess_hyperparams(hyperparams)
        if self.start is not None:
            self._n_source_envs, self.n_envs = self.n_envs, 1
            if self.frame_stack is not None or self.vec_env_wrapper is not None:
                raise ValueError(f"--algo {self.algo} takes env_wrapper; leave frame_stack and vec_env_wrapper out")
        return preprocessed

    def create_callbacks(self) -> None:
        """As the zoo's, with checkpoints that a run can resume from."""
        super().create_callbacks()
        for callback in self.callbacks:
            if isinstance(callback, CheckpointCallback):
                callback.save_replay_buffer = self.save_replay_buffer
                callback.save_vecnormalize = True

    # ------------------------------------------------------------------ worlds

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """The target to evaluate in, or the source to train in; arguments as the zoo's."""
        if self.start is None or eval_env:
            return super().create_envs(n_envs, eval_env, no_log)
        return self._maybe_normalize(self._make(self.start.source_env, self.env_kwargs, self._n_source_envs), False)

    def create_target(self, no_log: bool = False) -> VecEnv:
        """The target to train in; the algorithm normalises it by the source's statistics.

        :param no_log: leave no monitor file, as in a search
        """
        folder = None if no_log else self.save_path
        target = self._make(self.env_name.gym_id, self.eval_env_kwargs, monitor_dir=folder)
        target.seed(self.seed + TARGET_SEED_OFFSET)
        return target

    def _make(self, env_id: str, env_kwargs: dict[str, Any], n_envs: int = 1, monitor_dir: str | None = None) -> VecEnv:
        kind: Any = self.vec_env_class
        return make_vec_env(
            partial(gym.spec(env_id).make, **env_kwargs),  # a process of its own need not know the id
            n_envs=n_envs,
            seed=self.seed,
            monitor_dir=monitor_dir,
            wrapper_class=self.env_wrapper,
            vec_env_cls=kind,
            vec_env_kwargs=self.vec_env_kwargs,
            monitor_kwargs=self.monitor_kwargs,
        )

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """As the zoo's; the statistics of a checkpoint, or of a source agent, are those that were saved with it."""
        agent, source = self.trained_agent, self.start.source_env if self.start is not None else None
        if self.start is not None and self.start.source_model is not None and not agent:
            agent = self.start.source_model
        names = [EnvironmentName(source) if source else None, Path(agent).stem]
        folders = [Path(agent).parent / name for name in names if name] if agent else []
        candidates = [beside(agent, "vecnormalize"), *(folder / "vecnormalize.pkl" for folder in folders)]
        statistics = next((path for path in candidates if path is not None and path.is_file()), None)
        if statistics is None:
            return super()._maybe_normalize(env, eval_env)
        env = VecNormalize.load(str(statistics), env)
        if not self.normalize:  # no settings say so, but the agent's; the zoo saves statistics where it normalises
            self.normalize, self.normalize_kwargs = True, {"norm_obs": env.norm_obs, "norm_reward": env.norm_reward}
        if eval_env:
            env.training = env.norm_reward = False
        return env

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        """As the zoo's, whose ``enjoy`` reads there whether observations are normalised, and how to make the target.

        It makes it by ``env_kwargs``: those of the source are kept as ``source_env_kwargs``.
        """
        if self.normalize:
            saved_hyperparams.setdefault("normalize", self.normalize_kwargs or True)
        if self.start is not None:
            of_source = vars(self.args).get("env_kwargs")
            vars(self.args).update(source_env_kwargs=of_source, env_kwargs=self._eval_env_kwargs_args or of_source)
        super()._save_config(saved_hyperparams)

    # ------------------------------------------------------------------ models

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """As the zoo's, with the zip's suffix: the folder of its settings has the same name without it."""
        env_name = self.env_name
        self.env_name = f"{env_name}.zip"
        try:
            super().save_trained_model(model)
        finally:
            self.env_name = env_name

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        """The model to train: a checkpoint that goes on, or a new one."""
        if self.start is None:
            if self.algo == "sac":
                hyperparams["learning_starts"] = 0  # a trained agent takes no random steps
            agent: Any = super()._load_pretrained_agent(hyperparams, env)
            came_from = settings_beside(self.trained_agent, "args.yml").get("env") or target_beside(self.trained_agent)
            here = came_from is not None and EnvironmentName(str(came_from)) == self.env_name
            if not here and (came_from is not None or agent.replay_buffer.size()):
                place = came_from or "an environment that nothing beside it tells"
                print(f"Trained in {place}: it begins here with an empty replay buffer")
                agent.replay_buffer.reset()
            return agent
        if not self.resumes:
            return self._begin(self.start, hyperparams, self._asked, env, self.create_target(), seed=self.seed)
        carried = sorted(self._asked - set(OUTSIDE))
        if carried:
            raise ValueError(
                f"--trained-agent goes on with the settings that it was saved with; leave {', '.join(carried)} out of "
                f"-params, which may set {', '.join(OUTSIDE)}"
            )
        print(f"Resuming {self.trained_agent}")
        model = ALGORITHMS[self.algo].load(
            self.trained_agent,
            env,
            target_env=self.create_target(),
            tensorboard_log=self.tensorboard_log,
            verbose=self.verbose,
            device=self.device,
        )
        if model.num_timesteps >= self.n_timesteps:
            raise ValueError(
                f"--trained-agent has taken {model.num_timesteps} target steps already; pass --n-timesteps above that"
            )
        if self.start.seed is not None and self.start.seed != model.seed:
            model.seed = self.start.seed
            model.set_random_seed(model.seed)
        data = beside(self.trained_agent, "replay_buffer")
        if data is not None and data.is_file():
            model.load_replay_buffer(data)
            held = model.replay_buffer.target.size()
            if held > model.num_timesteps:
                warnings.warn(
                    f"{data.name} holds {held} target transitions, {self.trained_agent} has taken "
                    f"{model.num_timesteps}: the run goes on with transitions that came after that model",
                    stacklevel=2,
                )
        else:
            warnings.warn(
                f"there is no replay buffer beside {self.trained_agent}: the run goes on with empty ones "
                "(--save-replay-buffer saves them)",
                stacklevel=2,
            )
        return model

    def _begin(
        self,
        start: Start,
        hyperparams: dict[str, Any],
        asked: Collection[str],
        source: VecEnv,
        target: VecEnv,
        **settings: Any,
    ) -> TransferAlgorithm:
        """A new model, from the source agent where one was named.

        :param start: where the run starts
        :param hyperparams: constructor arguments
        :param asked: those of them that win over what the source agent brings along
        :param source: to train in
        :param target: to train in
        :param settings: further constructor arguments
        :raises SystemExit: code 2, and a line of what is wrong with the source agent
        """
        common = {"tensorboard_log": self.tensorboard_log, "verbose": self.verbose, "device": self.device}
        settings = {**hyperparams, **common, **settings, "target_env": target}
        cls = ALGORITHMS[self.algo]
        if start.source_model is None:
            return cls(env=source, **settings)
        try:
            sac = load_sac(start.source_model, self.device)
            check_source_spaces(sac, source)
        except ValueError as error:
            print(f"sb3_rpto.zoo.train: error: --source-model: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        brought = {"policy"} | carried_arguments(sac).keys() - set(asked)
        settings = {name: value for name, value in settings.items() if name not in brought}
        return cls.from_source(sac, source, source_data=start.source_data, **settings)

    def learn(self, model: BaseAlgorithm) -> None:
        """As the zoo's; ``n_timesteps`` is the number of target steps at the end, also of a run that was resumed."""
        if self.start is None or not isinstance(model, TransferAlgorithm):
            super().learn(model)
            return
        log_interval: Any = self.log_interval if self.log_interval >= 0 else None
        if self.log_interval == -1:  # the zoo's "as the algorithm has it"; below, it logs nothing
            log_interval = 4
        try:
            model.learn(
                self.n_timesteps - model.num_timesteps,
                callback=self.callbacks or None,
                reset_num_timesteps=not self.resumes,
                source_timesteps=self.start.source_timesteps,
                log_interval=log_interval,
            )
        except KeyboardInterrupt:  # what was learned is saved, and resumes
            pass
        finally:
            _close(model.env, model.target_env)
            if self.callbacks and hasattr(self.callbacks[0], "pbar"):  # a progress bar that was begun is the first
                self.callbacks[0].on_training_end()

    # ------------------------------------------------------------------ search

    def objective(self, trial: optuna.Trial) -> float:
        """Train with drawn hyperparameters; return the mean return on the target.

        :param trial: as the zoo's
        :raises optuna.exceptions.TrialPruned: for a trial that is stopped early or whose numbers leave their range
        """
        if self.start is None:
            return super().objective(trial)
        sampled = self._not_told(SAMPLERS[self.algo](trial, self.n_actions, self._n_source_envs, {}))
        merged = {**self._hyperparams, **_applicable(sampled, self._hyperparams)}
        source, target = self.create_envs(1, no_log=True), self.create_target(no_log=True)
        evaluation = self.create_envs(self.n_eval_envs, eval_env=True)
        folder = None
        if self.optimization_log_path is not None:
            folder = str(Path(self.optimization_log_path) / f"trial_{trial.number}")
        judge = TrialEvalCallback(
            evaluation,
            trial,
            best_model_save_path=folder,
            log_path=folder,
            n_eval_episodes=self.n_eval_episodes,
            eval_freq=max(self.n_timesteps // self.n_evaluations, 1),
            deterministic=self.deterministic_eval,
        )
        asked = self._asked | sampled.keys()
        verbose = self.verbose if self.verbose >= 2 else 0
        try:
            model = self._begin(self.start, merged, asked, source, target, seed=None, verbose=verbose)
            model.learn(self.n_timesteps, callback=[*get_callback_list({"callback": self.specified_callbacks}), judge])
            if judge.is_pruned:
                raise optuna.exceptions.TrialPruned()
            # The last step was judged before what follows it: updates, a fit, a trace and the learning after that.
            if isinstance(evaluation, VecNormalize):
                sync_envs_normalization(source, evaluation)
            earned, _ = evaluate_policy(model, evaluation, self.n_eval_episodes, self.deterministic_eval)
        except ValueError as error:
            if not (isinstance(error, NotFiniteError) or INVALID in str(error)):
                raise  # a wrong setting is no matter of what was drawn
            print(f"trial {trial.number} is pruned: {error}")
            raise optuna.exceptions.TrialPruned() from error
        finally:
            _close(source, target, evaluation)
        return float(np.mean(earned))

    def hyperparameters_optimization(self) -> None:
        """As the zoo's.

        :raises ValueError: no trial was completed
        """
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):
                raise
            raise ValueError("no trial of the search was completed; those that were pruned say above why") from None


def beside(trained_agent: str, kind: str) -> Path | None:
    """The file of a kind that was saved with a zip, by SB3's and the zoo's names; None without a zip.

    :param trained_agent: the zip
    :param kind: ``replay_buffer`` or ``vecnormalize``
    """
    if not trained_agent:
        return None
    path = Path(trained_agent)
    prefix, _, steps = path.stem.removesuffix("_steps").rpartition("_")
    if path.stem.endswith("_steps") and steps.isdigit():
        return path.with_name(f"{prefix}_{kind}_{steps}_steps.pkl")
    return path.with_name(f"pretrain_{kind}.pkl" if path.stem == "pretrain" else f"{kind}.pkl")


def _applicable(drawn: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """What a search has drawn, as it joins settings: part of the model's arguments, nothing that the model has not."""
    found = dict(drawn)
    if "dynamics_kwargs" in found:
        found["dynamics_kwargs"] = {**settings.get("dynamics_kwargs", {}), **found["dynamics_kwargs"]}
    if settings.get("dynamics") == "physical":  # it has no branches
        found.pop("rollout_start", None)
    return found


def _close(*worlds: VecEnv | None) -> None:
    for world in worlds:
        if world is not None:
            with contextlib.suppress(EOFError, OSError):  # processes that Ctrl-C has ended, too
                world.close()
