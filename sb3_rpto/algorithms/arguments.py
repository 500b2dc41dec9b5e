"""What users pass, looked at before anything expensive; every error names the argument and the remedy."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from numbers import Real
from typing import Any, Literal

import cloudpickle
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms import argument_ranges
from sb3_rpto.algorithms.interfaces import Agent
from sb3_rpto.dynamics.factory import is_mujoco
from sb3_rpto.effects import LIBRARY, Declared, Effect, from_json
from sb3_rpto.effects.library import given as check_declared
from sb3_rpto.effects.mjcf import PlainModel
from sb3_rpto.effects.names import near
from sb3_rpto.envs.corrected import check_carries
from sb3_rpto.envs.observations import single_env
from sb3_rpto.envs.task_rules import misfit
from sb3_rpto.ranges import check

#: Arguments that only an algorithm with trainable dynamics has a use for.
DYNAMICS_ARGUMENTS = frozenset(
    {
        "target_data",
        "dynamics",
        "dynamics_kwargs",
        "declared",
        "close_loop",
        "effects",
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


def check_values_of(model: Agent) -> None:
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


def check_ready(agent: Agent, total_timesteps: int, source_timesteps: int | None, **others: Any) -> None:
    """Refuse to learn without both worlds or with a budget that makes no sense; arguments as those of ``learn()``.

    :raises ValueError: naming what is missing or wrong
    """
    check(
        argument_ranges.OF_LEARN, {"total_timesteps": total_timesteps, "source_timesteps": source_timesteps, **others}
    )
    if agent.env is None:
        raise ValueError("learn() needs the source environment: pass env= to load(), or call set_env()")
    if agent.env.env_is_wrapped(Monitor)[0] and not agent.env.get_attr("allow_early_resets", indices=[0])[0]:
        raise ValueError("env is in a Monitor(allow_early_resets=False), but is reset between phases; leave it True")
    if agent.target is None:
        raise ValueError(
            "learn() needs the target: pass target_env= (an environment to interact with) or target_data= "
            "(recorded transitions, RTO and RPTO) to the constructor, or call set_target_env()"
        )
    if total_timesteps < agent.target.n_envs:
        raise ValueError(
            f"total_timesteps={total_timesteps} is less than one step of target_env's {agent.target.n_envs} "
            "environments; raise it or use fewer"
        )
    side = agent.replay_buffer.target
    if agent.target_env is None and not agent.target.is_traced and side.size() == 0:
        raise ValueError("D_target is empty: a checkpoint does not hold the target_data; call load_replay_buffer()")
    warn_of_little(agent, total_timesteps)
    if agent.target_env is not None and total_timesteps > side.buffer_size:
        warnings.warn(
            f"D_target holds {side.buffer_size} transitions, fewer than the budget of {total_timesteps}; pass "
            'replay_buffer_kwargs={"target_size": ...} to keep them all',
            stacklevel=3,
        )


def warn_of_idle_source_phase(agent: Agent, source_timesteps: int) -> None:
    """Say so where the source phase ends before its first update, and an untrained policy goes into the target.

    :param source_timesteps: its length; 0: nobody wants one
    """
    if 0 < source_timesteps <= agent.learning_starts:
        warnings.warn(
            f"the source phase of {source_timesteps:,} steps ends before its first update (learning_starts="
            f"{agent.learning_starts:,}), so an untrained policy goes into the target; give learn() more "
            "source_timesteps, a smaller learning_starts, or begin from a trained SAC by from_source()",
            stacklevel=4,
        )


def warn_of_little(agent: Agent, total_timesteps: int) -> None:
    """Say so where the budget ends before the dynamics are fitted, or with next to no updates."""
    first_trace = _first_trace(agent)
    if agent.target_env is None:
        steps = agent.source_steps_per_target_step()
        rounds = -(-total_timesteps // steps)
        updates = rounds * agent.updates_per_step
        if not agent.n_updates and 0 < updates < FEW_UPDATES <= total_timesteps:  # one that goes on was told
            warnings.warn(
                f"total_timesteps={total_timesteps} source steps are {rounds} rounds of {steps} (source_steps="
                f"{agent.source_steps}) with {agent.updates_per_step} updates each by gradient_steps="
                f"{agent.gradient_steps}, {updates} in all; raise gradient_steps or total_timesteps",
                stacklevel=4,
            )
    elif first_trace > total_timesteps:
        warnings.warn(
            f"total_timesteps={total_timesteps} ends before the closed loop's first trace, for which it waits "
            f"{first_trace} target steps, until a fit (model_train_freq={agent.model_train_freq}); raise it",
            stacklevel=4,
        )
    elif agent.updates_dynamics and total_timesteps + agent.replay_buffer.target.size() < agent.model_train_freq:
        warnings.warn(
            f"total_timesteps={total_timesteps} ends before the first fit of the dynamics, after "
            f"{agent.model_train_freq} target steps; raise it, or lower model_train_freq",
            stacklevel=4,
        )


def _first_trace(agent: Agent) -> int:
    """After how many target steps the first trace is made: with enough of them, at a fit; 0 where it was."""
    wait, done = agent.loop.first_trace_after(agent), agent.state.steps_since_fit
    return max(wait, 0) and -(-(wait + done) // agent.model_train_freq) * agent.model_train_freq - done


# --- the dynamics and the closed loop ---------------------------------------------------------------------------------


def check_effects(effects: Literal["all"] | Sequence[str]) -> None:
    """Refuse kinds of effects that no trace can look for.

    :param effects: "all", or the kinds of effects to look for
    :raises TypeError: for a single kind, and for what is no kind
    :raises ValueError: for a kind that is not in the library
    """
    if effects == "all":
        return
    if isinstance(effects, str):
        raise TypeError(f'effects must be "all" or a list of kinds, not a string; write [{effects!r}]')
    if not isinstance(effects, Sequence | Set):
        raise TypeError(f'effects must be "all" or a list of kinds, not {effects!r}; leave it out')
    for kind in effects:
        if not isinstance(kind, str):
            raise TypeError(
                f"effects holds kinds of effects to look for, such as 'coulomb_friction', not {kind!r}; effects "
                "that are known beforehand are dynamics_kwargs={'effects': [...]}"
            )
        if kind not in LIBRARY:
            raise ValueError(f"effects: no effect {kind!r} is registered; {near(kind, LIBRARY)}")


def check_backend(config: dict[str, Any], close_loop: bool, traces_log: bool, given: Collection[str]) -> None:
    """Refuse what a backend has no use for, or would lose.

    :param config: of the dynamics
    :param close_loop: whether transitions are traced
    :param traces_log: measurements stand in for the target
    :param given: names of the arguments that the user passed
    :raises ValueError: with the remedy
    """
    if close_loop and not (config["backend"] == "physical" and is_mujoco(config)):
        raise ValueError(
            "close_loop=True traces what a MuJoCo simulator lacks: pass dynamics='physical' and a gymnasium MuJoCo env"
        )
    if "effects" in given and not close_loop:
        raise ValueError("effects says what to look for where the loop is closed: pass close_loop=True, too")
    if config.get("observation_noise") is not None and (not close_loop or traces_log):
        raise ValueError(
            "dynamics_kwargs['observation_noise'] is for traces of a closed loop on transitions of the target; leave "
            "it out, "
            + (
                "recordings tell their own: Measurements.from_replay(..., noise=...) where it is known"
                if traces_log
                else "or pass dynamics='physical' and close_loop=True on a MuJoCo env"
            )
        )
    if config["backend"] == "physical" and "rollout_start" in given:
        raise ValueError(
            "rollout_start is for one-step branches; dynamics='physical' simulates whole episodes: leave it out"
        )
    residual = config["backend"] == "residual"
    late = [e.label for e in map(from_json, config.get("effects", ())) if e.remembers] if residual else []
    if late:
        raise ValueError(
            f"dynamics='residual' answers each step from its observation alone, where {', '.join(late)} would be lost; "
            "pass dynamics='physical', which simulates whole episodes"
        )


def check_carried(env: VecEnv, effects: Literal["all"] | Sequence[str]) -> None:
    """Refuse a source in which nothing that a trace may find could act: the target steps would be spent by then.

    :param env: the source, a MuJoCo environment
    :param effects: "all", or the kinds of effects to look for
    :raises ValueError: with the remedy
    """
    kinds = [kind for kind, effect in LIBRARY.items() if effect.offered] if effects == "all" else effects
    try:
        check_carries(single_env(env), kinds)
    except ValueError as error:
        raise ValueError(
            f"effects={effects!r}: {error}; or pass effects=[...] with kinds that are numbers of the model alone"
        ) from error


def check_something_to_fit(
    config: dict[str, Any], close_loop: bool, effects: Literal["all"] | Sequence[str], traces_log: bool
) -> None:
    """Refuse a MuJoCo simulator without parameters, and those that a trace would refuse after many target steps.

    :param config: of the dynamics
    :param close_loop: whether transitions are traced
    :param effects: "all", or the kinds of effects to look for
    :param traces_log: measurements stand in for the target
    :raises ValueError: with the remedy
    """
    if config["backend"] != "physical" or not is_mujoco(config):
        return
    if close_loop or traces_log:
        model = config["mj_model"]
        compiled = model.compile() if isinstance(model, PlainModel) else model
        check_declared(
            compiled, config.get("declared", ()), [from_json(stored) for stored in config.get("effects", ())]
        )
    if not (close_loop and effects) and not config.get("declared") and not config.get("effects"):
        raise ValueError(
            "dynamics='physical' has nothing to fit: pass declared=[...], names of the model's numbers such as "
            "'hinge.damping' or '*.mass', or close_loop=True"
        )


def check_rules(kwargs: dict[str, Any], observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Refuse rules of the user's that answer in another form than the dynamics read.

    :param kwargs: of the dynamics
    :param observation_space: both worlds'
    :param action_space: both worlds'
    :raises ValueError: naming the rule and what it gave
    """
    for name in ("reward_fn", "termination_fn"):
        if kwargs.get(name) is None:
            continue
        try:
            cloudpickle.dumps(kwargs[name])
        except Exception as error:  # whatever an object's own pickling raises
            raise ValueError(
                f"dynamics_kwargs[{name!r}] does not pickle ({error}), and checkpoints hold it; give a function of the "
                "tensors alone"
            ) from error
        found = misfit(kwargs[name], observation_space, action_space)
        if found is not None:
            raise ValueError(
                f"dynamics_kwargs[{name!r}] must answer n observations, actions and next observations by a tensor of "
                f"shape (n,); of two it made {found}"
            )
