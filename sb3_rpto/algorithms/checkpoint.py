"""What a checkpoint holds beyond SB3's zip, so that resuming equals not having stopped."""

from __future__ import annotations

import inspect
import io
import pathlib
import pickle
import random
import warnings
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_rpto.algorithms.arguments import (
    begin_temperature,
    check_values_of,
    constructor_names,
    one_kind_of_temperature,
)
from sb3_rpto.algorithms.bookkeeping import STEP, TARGET_SEED_OFFSET, RuleOfEnvironment, TwoWorlds
from sb3_rpto.algorithms.machine import check_simulator
from sb3_rpto.algorithms.normalisation import check_normalisation, normalises
from sb3_rpto.algorithms.worlds import find_ledger
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.effects.names import near
from sb3_rpto.envs.state import reseed, restore_state, restore_statistics, save_state, save_statistics
from sb3_rpto.files import write_atomically

Self = TypeVar("Self", bound="Resumable")

#: Kept out of the zip: saved by other means, rebuilt, or of no use without the environments.
NOT_SAVED = (
    "target_env",
    "measured",
    "dynamics",
    "_source_world",
    "_null_check",
    "_passed",
    "_last_obs",
    "_last_original_obs",
    "_source_first_obs",
    "_callback",
    "_pretraining",
)


#: Arguments that the saved dynamics, networks and buffers were made by.
FIXED = frozenset(
    {"dynamics", "dynamics_kwargs", "declared", "close_loop", "preset", "target_data", "use_sde", "n_steps"}
)
#: What a VecNormalize keeps of the last step as it was.
RAW = ("old_obs", "old_reward")


class Resumable(TwoWorlds):
    """A complete checkpoint: SB3's zip with the dynamics, and where both worlds and the random streams stand."""

    #: whether the policy knows the source, by a warm start or by training there
    _warm: bool
    #: arguments that other algorithms have and this one does not use
    unused: ClassVar[frozenset[str]] = frozenset()

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all that a resumed run needs, except the replay buffers (``save_replay_buffer``); atomic for paths."""
        loaded = self._resume_state  # a loaded model that has not learned since stands where it was saved first
        config, learner = self.dynamics_config, self.snapshots.get("learner")
        since = {"warm": self._warm, "learner": learner, "seed": self._new_seed}
        try:
            self._resume_state = {**loaded, **since} if loaded else capture(self)
            if self.env is not None:
                self._resume_state["normalised"] = normalises(self.get_vec_normalize_env())
            self._resume_state["algorithm"] = _algorithm(type(self))
            self.dynamics_config = _picklable(config)
            write_atomically(path, lambda file: super(Resumable, self).save(file, exclude, include))
        finally:
            self._resume_state, self.dynamics_config = loaded, config

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Save both replay buffers as one pickle; atomic for paths."""
        write_atomically(path, super().save_replay_buffer, suffix="pkl")

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Load both replay buffers.

        :param path: what ``save_replay_buffer`` wrote
        :param truncate_last_traj: as in SB3; without effect here
        :raises ValueError: for the buffer of another algorithm or of other environments; the model keeps its own then
        """
        kept = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        except (pickle.UnpicklingError, EOFError, AssertionError) as error:  # SB3 sets it, then asserts that it is one
            self.replay_buffer = kept
            raise ValueError(f"{path} is no replay buffer; pass what save_replay_buffer() wrote") from error
        if not isinstance(self.replay_buffer, DualReplayBuffer):
            self.replay_buffer = kept
            raise ValueError(
                f"{path} holds one world only; pass it as source_data= of from_source() or as target_data="
            )
        shapes = [(b.observation_space.shape, b.action_space.shape) for b in (self.replay_buffer, self)]
        if shapes[0] != shapes[1]:
            self.replay_buffer = kept
            raise ValueError(
                f"{path} holds observations and actions of shapes {shapes[0]}, the model's are {shapes[1]}; load the "
                "buffers that were saved beside it"
            )
        asked = (self.replay_buffer_kwargs or {}).get("target_size")
        if asked is not None:  # load() may have been given another than was saved
            self.replay_buffer.resize("target", asked)
        if self.replay_buffer.estimated and self.target_env is not None:  # a target has taken the log's place
            self._drop_target_data()

    @classmethod
    def load(
        cls: type[Self],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        *args: Any,
        target_env: GymEnv | str | None = None,
        **kwargs: Any,
    ) -> Self:
        """Load a checkpoint; without environments the model can predict, with them it resumes.

        :param path: of the zip
        :param env: the source, or its id
        :param args: as SB3's ``load``
        :param target_env: the target, or its id
        :param kwargs: as SB3's ``load``
        :raises ValueError: for a file that another algorithm saved, a target that is not passed by name, and arguments
            that a saved model does not change
        """
        if args and not isinstance(args[0], str | th.device):
            raise ValueError(f"load() takes {args[0]!r} for the device; pass a target by name, as target_env=")
        cls.refuse_unused(kwargs)
        fixed = sorted(FIXED & set(kwargs))
        if fixed:
            raise ValueError(
                f"load() does not change {', '.join(fixed)}, which the saved model was made with; begin anew by "
                f"{cls.__name__}.from_source(...) of the source's SAC"
            )
        known = constructor_names(cls) | set(inspect.signature(SAC.load).parameters)
        for name in kwargs:
            if name not in known:
                raise ValueError(f"load() was given {name!r}, which is no argument; {near(name, known)}")
        with one_kind_of_temperature(kwargs):
            model = super().load(path, gym.make(env) if isinstance(env, str) else env, *args, **kwargs)
        begin_temperature(model, kwargs.get("ent_coef"))
        if model._resume_state is None:
            raise ValueError(
                f"{path} was not saved by {cls.__name__}; start from a SAC model by "
                f"{cls.__name__}.from_source(path, env, target_env=...)"
            )
        check_values_of(model)
        # The seed of its beginning is not one given now; one that was given before it was saved anew is.
        model._new_seed = None
        model.set_random_seed(kwargs["seed"] if kwargs.get("seed") is not None else model._resume_state.get("seed"))
        model._warm = model._resume_state["warm"]
        if model._resume_state.get("learner") is not None:  # set_parameters() has dropped it
            model.snapshots["learner"] = model._resume_state["learner"]
        if model.env is not None:
            check_simulator(model.env, model.dynamics, model.weighting == "value_aware")
            model._bind_rules(model.env, of_target=False)
            had = model._resume_state.get("normalised")
            if had is not None:
                check_normalisation(had, model.get_vec_normalize_env(), "the model")
        if target_env is not None:
            model.set_target_env(target_env)
        return model

    @classmethod
    def refuse_unused(cls, passed: Iterable[str]) -> None:
        """Refuse arguments in :attr:`unused`.

        :param passed: names of the arguments
        :raises ValueError: naming those
        """
        unused = sorted(cls.unused.intersection(passed))
        if unused:
            raise ValueError(f"{cls.__name__} does not use {unused}; leave them out or use RPTO")

    def _setup_model(self) -> None:
        saved_by = (self._resume_state or {}).get("algorithm")  # while a checkpoint is loaded
        if saved_by is not None and saved_by != _algorithm(type(self)):
            raise ValueError(f"this was saved by {saved_by}, {type(self).__name__} cannot continue it; load it there")
        self._check_numbers()
        super()._setup_model()

    def _check_numbers(self) -> None:
        """Refuse numbers of its own out of range.

        :raises ValueError: naming the argument and its value
        """

    def set_parameters(self, load_path_or_dict: Any, exact_match: bool = True, device: Any = "auto") -> None:
        """As in SB3; a model that was given parameters counts as warm-started and is not trained in the source."""
        super().set_parameters(load_path_or_dict, exact_match, device)
        self.snapshots.pop("learner", None)  # what goes on learning is this one
        self._warm = True

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *NOT_SAVED]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.dynamics is not None:
            state_dicts.append("dynamics")
            if hasattr(self.dynamics, "optimizer"):
                state_dicts.append("dynamics.optimizer")
        return state_dicts, variables


def _algorithm(cls: type) -> str:
    """Whose checkpoints a class goes on with: its own, of a user's class those of what it is derived from."""
    name = next(base.__name__ for base in cls.__mro__ if base.__module__.startswith("sb3_rpto."))
    return "RTO or RPTO" if name in ("RTO", "RPTO") else name


def _picklable(config: dict[str, Any] | None) -> dict[str, Any] | None:
    """A config of the dynamics without rules whose environment does not pickle; these are read again after loading."""
    if config is None:
        return None
    found = dict(config)
    for name in {"reward_fn", "termination_fn"} & set(config):
        try:
            cloudpickle.dumps(config[name])
        except Exception:  # whatever an environment's own pickling raises
            found[name] = RuleOfEnvironment(name)
    return found


def capture(model: Resumable) -> dict[str, Any]:
    """Where the two worlds and the random streams stand, as plain data."""
    normaliser = None if model.env is None else model.get_vec_normalize_env()
    return {
        **_streams(model),
        "source": None if model.env is None else save_state(model.env),
        "statistics": {} if normaliser is None else save_statistics(normaliser),
        "target": None if model.target_env is None else save_state(find_ledger(model.target_env).venv),
        "source_world": None if model._source_world is None else model._source_world.get_state(),
        "last_obs": model._last_obs,
        "last_original_obs": model._last_original_obs,
        "unstored_step": _unstored_step(model),
        "warm": model._warm,
        "learner": model.snapshots.get("learner"),
    }


def _streams(model: Resumable) -> dict[str, Any]:
    return {
        "random": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state(model.device) if model.device.type == "cuda" else None,
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _unstored_step(model: Resumable) -> dict[str, Any] | None:
    """The target step that is taken and not yet stored: SB3 calls callbacks, which may save, between the two."""
    if model.target_env is None or model._callback is None or not find_ledger(model.target_env).unstored:
        return None
    normaliser = unwrap_vec_normalize(model.target_env)
    raw = None if normaliser is None else {name: getattr(normaliser, name) for name in RAW}
    return {"raw": raw, "known": {name: model._callback.locals[name] for name in STEP}}


def resume(model: Resumable) -> None:
    """Put the worlds and the random streams back to where the loaded checkpoint left them.

    A world that cannot be put back begins a new episode, and a warning says which.
    """
    state, model._resume_state = model._resume_state, None
    if state is None:
        return
    assert model.env is not None  # learn() has checked both worlds
    began = 1 if model.target_env is None else model.target_env.num_envs
    learned = state["last_obs"] is not None and model.num_timesteps > began and not model._offline
    if learned and model.replay_buffer.target.size() == 0:
        warnings.warn(
            "the run goes on without its replay buffers, so D_target begins empty: call load_replay_buffer() with what "
            "save_replay_buffer() wrote beside the checkpoint before learn()",
            stacklevel=3,
        )
    restarted = []
    if not _put_source_back(model, state):
        restarted.append("source")
    if not model._offline and state["last_obs"] is not None and not _put_target_back(model, state):
        restarted.append("target")
    if restarted:
        warnings.warn(
            f"the state of the {' and the '.join(restarted)} environment cannot be restored: a new episode begins, "
            "so the resumed run differs from one that never stopped (it can be where the environment is built as it "
            "was when the checkpoint was saved, and is one of gymnasium's or has save_state() and "
            "restore_state(state), see docs/checkpoints.md)",
            stacklevel=3,
        )
    _go_on_drawing(model, state)


def resume_unbegun(model: Resumable) -> None:
    """As :func:`resume`, of a trained model that was saved before its first step here: before all that precedes it."""
    state = model._resume_state
    if state is not None and state["last_obs"] is None and model._warm and not model._offline:
        resume(model)


def resume_source_phase(model: Resumable) -> None:
    """Go on with the statistics and random streams of a checkpoint of the source phase, in a new episode."""
    state, model._resume_state = model._resume_state, None
    if state is None:
        return
    assert model.env is not None  # learn() has checked
    if model._pretrained_steps > 0 and model.replay_buffer.source.size() == 0:
        warnings.warn(
            "the source phase goes on without its replay buffers: updates wait for learning_starts new steps; call "
            "load_replay_buffer() with what save_replay_buffer() wrote beside the checkpoint before learn()",
            stacklevel=3,
        )
    _put_env_back(model, model.env, state)
    _go_on_drawing(model, state)
    model._source_first_obs = np.asarray(model.env.reset())


def leave(model: Resumable) -> None:
    """Begin a new run with a loaded model: what the policy needs of its checkpoint stays, and a step not yet stored."""
    state, model._resume_state = model._resume_state, None
    if state is None:
        return
    normaliser = model.get_vec_normalize_env()
    if normaliser is not None:
        restore_statistics(normaliser, state.get("statistics", {}))
    if model.target_env is not None and state["unstored_step"] is not None:
        model._last_obs, model._last_original_obs = state["last_obs"], state["last_original_obs"]
        _store_unstored_step(model, state["unstored_step"])


def _put_env_back(model: Resumable, env: VecEnv, state: dict[str, Any]) -> bool:
    """Restore the source; where its state is unknown, what its VecNormalize has seen all the same, and False."""
    if _put_back(env, state["source"]):
        return True
    normaliser = model.get_vec_normalize_env()
    if normaliser is not None:
        restore_statistics(normaliser, state.get("statistics", {}))
    return False


def _go_on_drawing(model: Resumable, state: dict[str, Any]) -> None:
    """Draw from the random streams that were saved, or, where a seed was given since, from new ones everywhere."""
    seed = model._new_seed
    if seed is None:
        _restore_streams(model, state)
        return
    model.set_random_seed(seed)  # whatever was drawn since it was given
    assert model.env is not None  # learn() has checked
    reseed(model.env, seed)
    if model.target_env is not None:
        reseed(model.target_env, seed + TARGET_SEED_OFFSET)
    if model._source_world is not None:
        model._source_world.reseed()


def _restore_streams(model: Resumable, state: dict[str, Any]) -> None:
    random.setstate(state["random"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if model.device.type == "cuda" and state.get("cuda") is not None:  # else it was saved on another kind of device
        th.cuda.set_rng_state(state["cuda"], model.device)
    model.action_space.np_random.bit_generator.state = state["actions"]


def _put_source_back(model: Resumable, state: dict[str, Any]) -> bool:
    """Restore the source and its episodes; False where new ones begin."""
    assert model.env is not None  # learn() has checked
    restored = _put_env_back(model, model.env, state)
    if not state["source_world"] or model._source_world is None:  # branches have no episodes
        return restored or state["source_world"] == {}
    if restored:
        try:
            model._source_world.set_state(state["source_world"])
        except ValueError:  # another number of episodes side by side, or other simulators
            model._source_world.begin_anew()
            restored = False
    return restored


def _put_target_back(model: Resumable, state: dict[str, Any]) -> bool:
    """Restore the target, and store the step that the checkpoint carries; False where a new episode begins after it."""
    assert model.target_env is not None
    normaliser = unwrap_vec_normalize(model.target_env)
    raw = {} if normaliser is None else {name: getattr(normaliser, name) for name in RAW}
    begun = model._last_obs, model._last_original_obs, raw
    restored = _put_back(find_ledger(model.target_env).venv, state["target"])
    find_ledger(model.target_env).begin()
    model._last_obs, model._last_original_obs = state["last_obs"], state["last_original_obs"]
    if state["unstored_step"] is not None:
        _store_unstored_step(model, state["unstored_step"])
    if not restored:
        model._last_obs, model._last_original_obs, raw = begun
        if normaliser is not None:
            vars(normaliser).update(raw)
    return restored


def _store_unstored_step(model: Resumable, step: dict[str, Any]) -> None:
    """Store a step that began at the model's last observation."""
    assert model.target_env is not None  # whose step it is
    normaliser = unwrap_vec_normalize(model.target_env)
    if normaliser is not None:
        vars(normaliser).update(step["raw"])
    model.store_step(step["known"])


def _put_back(env: VecEnv, state: dict[str, Any] | None) -> bool:
    """Restore a world; False, with nothing changed, without a state or with one of a world that is built otherwise."""
    if state is None:
        return False
    try:
        restore_state(env, state)
    except ValueError:
        return False
    return True
