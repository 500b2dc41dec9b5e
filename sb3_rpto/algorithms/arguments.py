"""What users pass, looked at before anything expensive; every error names the argument and the remedy."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Real
from typing import TYPE_CHECKING, Any

from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.monitor import Monitor

from sb3_rpto.algorithms import argument_ranges
from sb3_rpto.algorithms.two_env_sac import TwoWorlds
from sb3_rpto.effects import Declared, Effect
from sb3_rpto.effects.names import near
from sb3_rpto.ranges import check

if TYPE_CHECKING:
    from sb3_rpto.algorithms.closed_loop.controller import LoopCloser

#: Arguments that only an algorithm with trainable dynamics has a use for.
DYNAMICS_ARGUMENTS = frozenset(
    {
        "target_data",
        "dynamics",
        "dynamics_kwargs",
        "declared",
        "close_loop",
        "retrain_steps",
        "weighting",
        "weight_floor",
        "rollout_start",
        "model_train_freq",
    }
)
#: What stands for target steps in an offline run has no use for these.
ONLINE = frozenset({"action_noise", "train_freq"})
#: Policy updates that are too few for anything to be learned.
FEW_UPDATES = 1_000
#: Goals, Dict observations and n-step returns (SB3's HerReplayBuffer is a DictReplayBuffer).
UNSUPPORTED_BUFFERS = (DictReplayBuffer, NStepReplayBuffer)


def set_among(function: Callable[..., Any], received: Mapping[str, Any]) -> frozenset[str]:
    """Names of the arguments that were received with another value than the function's default.

    :param function: whose they are
    :param received: values by name, others among them
    """

    def is_default(value: Any, default: Any) -> bool:
        return value is default or (type(value) is type(default) and isinstance(value, str | Real) and value == default)

    known = inspect.signature(function).parameters
    return frozenset(
        name for name, value in received.items() if name in known and not is_default(value, known[name].default)
    )


def check_supported(n_steps: int, optimize_memory_usage: bool, replay_buffer_class: type[ReplayBuffer] | None) -> None:
    """Refuse arguments of SAC's that the algorithms are not written for.

    :raises NotImplementedError: for n-step returns, overlapping storage, buffers of goals or Dicts
    """
    if n_steps != 1 or optimize_memory_usage:
        raise NotImplementedError(
            "n_steps > 1 and optimize_memory_usage=True are not supported (branches are one step): leave both out"
        )
    if isinstance(replay_buffer_class, type) and issubclass(replay_buffer_class, UNSUPPORTED_BUFFERS):
        raise NotImplementedError(
            f"replay_buffer_class={replay_buffer_class.__name__} is not supported; leave it out or pass a subclass of "
            "ReplayBuffer for flat observations and single steps"
        )


def check_one_target(target_env: Any, target_data: Any) -> None:
    """Refuse a target environment and a log of it at once.

    :raises ValueError: when both are given
    """
    if target_env is not None and target_data is not None:
        raise ValueError("target_env and target_data exclude each other: pass the target or a log of it")


def check_offline(passed: Collection[str]) -> None:
    """Refuse what acts on steps in the target where a log stands in for it.

    :param passed: names of the arguments that the user passed
    :raises ValueError: naming them
    """
    unused = sorted(ONLINE & set(passed))
    if unused:
        raise ValueError(f"target_data: no step is taken in a target, so {', '.join(unused)} has no use; leave it out")


def plain_effects(kwargs: dict[str, Any]) -> dict[str, Any]:
    """``dynamics_kwargs`` with effects as they are kept: an :class:`~sb3_rpto.effects.Effect` may be passed, too.

    :raises TypeError: for what is neither, or a single one
    """
    effects = kwargs.get("effects")
    if effects is None:
        return dict(kwargs)
    if not isinstance(effects, list | tuple):
        raise TypeError(f"dynamics_kwargs['effects'] must be a list of effects, not {type(effects).__name__}")
    plain = [e.to_json() if isinstance(e, Effect) else e for e in effects]
    for effect in plain:
        if isinstance(effect, Mapping) and effect.get("kind") == Declared.kind:
            raise ValueError(
                f"dynamics_kwargs['effects'] holds declared numbers, {', '.join(effect.get('values', ()))}: known "
                "effects belong here; name those in declared= and leave them out"
            )
        if not isinstance(effect, Mapping):
            raise TypeError(f"dynamics_kwargs['effects'] must hold effects or their to_json(), not {effect!r}")
    return {**kwargs, "effects": plain}


def constructor_names(cls: type) -> set[str]:
    """Names that a class's constructor takes, its parents' included."""
    constructors = [vars(parent)["__init__"] for parent in cls.__mro__ if "__init__" in vars(parent)]
    return {name for function in constructors[:-1] for name in inspect.signature(function).parameters}


def list_of_names(declared: Sequence[str]) -> tuple[str, ...]:
    """``declared=`` as a tuple.

    :raises TypeError: for a single name, which would come apart into letters, and for what is no list of names
    """
    if isinstance(declared, str):
        raise TypeError(f"declared must be a list of names, not the string {declared!r}; write [{declared!r}]")
    if isinstance(declared, Mapping):
        raise TypeError(
            "declared must be a list of names, not a mapping; bounds are part of a name: 'pole.length=0.1:1'"
        )
    if not isinstance(declared, Sequence) or not all(isinstance(name, str) for name in declared):
        remedy = (
            "in YAML put a name that begins with '?' in quotes" if _holds_mapping(declared) else "write [] for none"
        )
        raise TypeError(f"declared must be a list of names, not {declared!r}; {remedy}")
    return tuple(declared)


def _holds_mapping(declared: Any) -> bool:
    return isinstance(declared, Sequence) and any(isinstance(name, Mapping) for name in declared)


def check_names(cls: type, passed: Collection[str]) -> None:
    """Refuse an argument that a class's constructor does not take.

    :param passed: names of the arguments
    :raises TypeError: saying the near names
    """
    known = constructor_names(cls)
    for name in passed:
        if name not in known:
            raise TypeError(f"{cls.__name__} has no argument {name!r}; {near(name, sorted(known - {'self'}))}")


def check_applicable(algorithm: str, updates_dynamics: bool, passed: Collection[str]) -> None:
    """Refuse arguments that the algorithm has no use for.

    :param algorithm: its name
    :param updates_dynamics: whether it trains the source's dynamics
    :param passed: names of the arguments that the user passed
    :raises ValueError: naming those that do not apply
    """
    inapplicable = sorted(set() if updates_dynamics else DYNAMICS_ARGUMENTS & set(passed))
    if inapplicable:
        raise ValueError(f"{algorithm} does not use {inapplicable}; leave them out or use RPTO")


def check_values_of(model: TwoWorlds) -> None:
    """Refuse values out of range in a model that is made: a preset, a subclass or a checkpoint may have set them.

    :raises ValueError: naming the argument and what it must be
    """
    rules = {**argument_ranges.OF_SAC, **argument_ranges.OURS}
    check(rules, {**vars(model), "dynamics": model.dynamics_backend, "policy": model.policy_class})


@contextmanager
def one_kind_of_temperature(settings: Mapping[str, Any]) -> Iterator[None]:
    """While a zip is loaded with other settings: its temperature and theirs are either learned or fixed.

    :raises ValueError: one is fixed where the other is learned
    """
    try:
        yield
    except AttributeError as error:  # of an optimizer of the temperature, in the zip alone or in the model alone
        if "ent_coef" not in settings:
            raise
        raise ValueError(
            "ent_coef: of the zip and what is asked for one fixes the temperature and the other learns it; leave it out"
        ) from error


def begin_temperature(model: SAC, ent_coef: Any) -> None:
    """Let a learned temperature begin where ``ent_coef="auto_0.5"`` says, also where a zip has brought another.

    :param model: whose parameters were loaded
    :param ent_coef: as it was asked for now; others than ``"auto_"`` and a number change nothing
    """
    _, given, begin = str(ent_coef).partition("auto_")
    if given and model.log_ent_coef is not None:
        model.log_ent_coef.data.fill_(math.log(float(begin)))


def check_ready(model: TwoWorlds, total_timesteps: int, source_timesteps: int | None, **others: Any) -> None:
    """Refuse to learn without both worlds or with a budget that makes no sense; arguments as those of ``learn()``.

    :raises ValueError: naming what is missing or wrong
    """
    check(
        argument_ranges.OF_LEARN, {"total_timesteps": total_timesteps, "source_timesteps": source_timesteps, **others}
    )
    if model.env is None:
        raise ValueError("learn() needs the source environment: pass env= to load(), or call set_env()")
    if model.env.env_is_wrapped(Monitor)[0] and not model.env.get_attr("allow_early_resets", indices=[0])[0]:
        raise ValueError("env is in a Monitor(allow_early_resets=False), but is reset between phases; leave it True")
    if model.target_env is None and not model._offline:
        raise ValueError(
            "learn() needs the target: pass target_env= (an environment to interact with) or target_data= "
            "(recorded transitions, RTO and RPTO) to the constructor, or call set_target_env()"
        )
    if model.target_env is not None and total_timesteps < model.target_env.num_envs:
        raise ValueError(
            f"total_timesteps={total_timesteps} is less than one step of target_env's {model.target_env.num_envs} "
            "environments; raise it or use fewer"
        )
    if model._offline and not model._traces_log and model.replay_buffer.target.size() == 0:
        raise ValueError("D_target is empty: a checkpoint does not hold the target_data; call load_replay_buffer()")
    _warn_of_little(model, total_timesteps)
    capacity = model.replay_buffer.target.buffer_size
    if model.target_env is not None and total_timesteps > capacity:
        warnings.warn(
            f"D_target holds {capacity} transitions, fewer than the budget of {total_timesteps}; pass "
            'replay_buffer_kwargs={"target_size": ...} to keep them all',
            stacklevel=3,
        )


def warn_of_idle_source_phase(model: TwoWorlds, source_timesteps: int) -> None:
    """Say so where the source phase ends before its first update, and an untrained policy goes into the target.

    :param source_timesteps: its length; 0: nobody wants one
    """
    if 0 < source_timesteps <= model.learning_starts:
        warnings.warn(
            f"the source phase of {source_timesteps:,} steps ends before its first update (learning_starts="
            f"{model.learning_starts:,}), so an untrained policy goes into the target; give learn() more "
            "source_timesteps, a smaller learning_starts, or begin from a trained SAC by from_source()",
            stacklevel=3,
        )


def _warn_of_little(model: TwoWorlds, total_timesteps: int) -> None:
    """Say so where the budget ends before the dynamics are fitted, or with next to no updates."""
    if model._offline:
        steps = model._steps_of_round()
        rounds = -(-total_timesteps // steps)
        updates = rounds * model.updates_per_step
        if not model._n_updates and 0 < updates < FEW_UPDATES <= total_timesteps:  # one that goes on was told
            warnings.warn(
                f"total_timesteps={total_timesteps} source steps are {rounds} rounds of {steps} (source_steps="
                f"{model.source_steps}) with {model.updates_per_step} updates each by gradient_steps="
                f"{model.gradient_steps}, {updates} in all; raise gradient_steps or total_timesteps",
                stacklevel=4,
            )
    elif model.loop is not None and _first_trace(model, model.loop) > total_timesteps:
        warnings.warn(
            f"total_timesteps={total_timesteps} ends before the closed loop's first trace, for which it waits "
            f"{_first_trace(model, model.loop)} target steps, until a fit (model_train_freq={model.model_train_freq}); "
            "raise it",
            stacklevel=4,
        )
    elif model.updates_dynamics and total_timesteps + model.replay_buffer.target.size() < model.model_train_freq:
        warnings.warn(
            f"total_timesteps={total_timesteps} ends before the first fit of the dynamics, after "
            f"{model.model_train_freq} target steps; raise it, or lower model_train_freq",
            stacklevel=4,
        )


def _first_trace(model: TwoWorlds, loop: LoopCloser) -> int:
    """After how many target steps the first trace is made: with enough of them, at a fit; 0 where it was."""
    wait, done = loop.first_comes_after(model), model._since_fit
    return max(wait, 0) and -(-(wait + done) // model.model_train_freq) * model.model_train_freq - done
