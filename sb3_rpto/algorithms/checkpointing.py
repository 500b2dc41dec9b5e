"""What a checkpoint holds beyond SB3's zip, so that resuming equals not having stopped."""

from __future__ import annotations

import inspect
import io
import pathlib
import pickle
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import cloudpickle
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr

from sb3_rpto.algorithms import model_zip
from sb3_rpto.algorithms.argument_ranges import check_given
from sb3_rpto.algorithms.arguments import (
    begin_temperature,
    check_values_of,
    constructor_names,
    one_kind_of_temperature,
)
from sb3_rpto.algorithms.normalisation import check_normalisation, normalises
from sb3_rpto.algorithms.plain_sac import sac_of_model
from sb3_rpto.algorithms.run_state import capture
from sb3_rpto.algorithms.target import check_environment
from sb3_rpto.algorithms.target_checks import check_simulator
from sb3_rpto.algorithms.two_env_sac import RuleOfEnvironment, TwoWorlds
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.effects.names import near
from sb3_rpto.envs.env_copy import EnvSource, make_env
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


class Resumable(TwoWorlds):
    """A complete checkpoint: SB3's zip with the dynamics, and where both worlds and the random streams stand."""

    #: whether the policy knows the source, by a warm start or by training there
    _warm: bool
    #: gradient steps of any fit of the dynamics at most, where the user passed a number; None where the preset says
    fit_bound: int | None
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
        config, learner, kwargs = self.dynamics_config, self.snapshots.get("learner"), self.replay_buffer_kwargs
        since = {"warm": self._warm, "learner": learner, "seed": self._new_seed}
        try:
            self._resume_state = {**loaded, **since} if loaded else capture(self)
            if self.env is not None:
                self._resume_state["normalised"] = normalises(self.get_vec_normalize_env())
            self._resume_state["algorithm"] = _algorithm(type(self))
            self._resume_state["target_size"] = kwargs.get("target_size")
            self.dynamics_config = _picklable(config)
            # SAC's buffer, in a SAC that loads the zip, has no target.
            self.replay_buffer_kwargs = {name: value for name, value in kwargs.items() if name != "target_size"}
            write_atomically(path, lambda file: self._write_zip(file, exclude, include))
        finally:
            self._resume_state, self.dynamics_config, self.replay_buffer_kwargs = loaded, config, kwargs

    def _write_zip(self, file: Any, exclude: Iterable[str] | None, include: Iterable[str] | None) -> None:
        """SB3's zip, and in it what SB3 does not read, so that ``SAC.load`` takes the file."""
        if not isinstance(file, str | pathlib.Path):  # it may be open for writing alone
            whole = io.BytesIO()
            self._write_zip_to(whole, exclude, include)
            file.write(whole.getbuffer())
        else:
            self._write_zip_to(file, exclude, include)

    def _write_zip_to(self, file: Any, exclude: Iterable[str] | None, include: Iterable[str] | None) -> None:
        super().save(file, exclude, include)
        model_zip.append_states(file, {name: recursive_getattr(self, name).state_dict() for name in self._own_states()})

    def to_sac(self) -> SAC:
        """The policy in a plain SAC of Stable-Baselines3, with its critics, temperature and optimisers.

        It has no environment and no buffers, acts as this model does, learns on after ``set_env()``, and its zip needs
        nothing of this package.
        """
        return sac_of_model(self)

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
        env: EnvSource | None = None,
        *args: Any,
        target_env: EnvSource | None = None,
        **kwargs: Any,
    ) -> Self:
        """Load a checkpoint; without environments the model can predict, with them it resumes.

        :param path: of the zip
        :param env: the source, or its id
        :param args: as SB3's ``load``
        :param target_env: the target, or its id
        :param kwargs: as SB3's ``load``
        :raises ValueError: for a file that is no zip of this algorithm's, or a damaged one, a target that is not passed
            by name, and arguments that a saved model does not change
        :raises TypeError: for what is no path, or no environment
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
        check_given({**({"device": args[0]} if args else {}), **kwargs})
        file = model_zip.located(path, "path")
        content = model_zip.look_into(file, "path")
        if "_resume_state" not in content:
            misfit = model_zip.misfit_of_sac(content)
            raise ValueError(
                f"{path} was not saved by {cls.__name__}"
                + (f" ({misfit})" if misfit else "")
                + f"; start from a SAC model by {cls.__name__}.from_source(path, env, target_env=...)"
            )
        if env is not None:
            env = make_env(env)
            check_environment(env, "env")
        with one_kind_of_temperature(kwargs):
            model = super().load(file, env, *args, **kwargs)
        model._put_states(model_zip.read_states(file, model._own_states(), model.device))
        begin_temperature(model, kwargs.get("ent_coef"))
        assert model._resume_state is not None  # it is in the zip
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
        """As in SB3; a model that was given parameters counts as warm-started and is not trained in the source.

        The parameters are SAC's. A zip of this package brings the dynamics, too.
        """
        given, own = load_path_or_dict, self._own_states()
        if not isinstance(given, dict):
            file = model_zip.located(given, "load_path_or_dict")
            given = load_from_zip_file(file, load_data=False, device=device)[1] | model_zip.read_states(
                file, own, self.device
            )
        super().set_parameters({name: value for name, value in given.items() if name not in own}, exact_match, device)
        self._put_states({name: value for name, value in given.items() if name in own})
        self.snapshots.pop("learner", None)  # what goes on learning is this one
        self._warm = True

    def _own_states(self) -> list[str]:
        """Names of modules and optimizers beside SAC's."""
        if self.dynamics is None:
            return []
        return ["dynamics", *(["dynamics.optimizer"] if hasattr(self.dynamics, "optimizer") else [])]

    def _put_states(self, states: dict[str, Any]) -> None:
        """Restore modules and optimizers.

        :param states: by the names of :meth:`_own_states`
        """
        for name, state in states.items():
            recursive_getattr(self, name).load_state_dict(state)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *NOT_SAVED]


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
