"""What the arguments of the algorithms may be, SAC's among them; every error names one and what it must be."""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping
from numbers import Real
from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise

from sb3_rpto.dynamics.factory import BACKENDS
from sb3_rpto.dynamics.weights import WEIGHTINGS
from sb3_rpto.effects.names import near
from sb3_rpto.presets import preset_names
from sb3_rpto.ranges import (
    FLAG,
    MAPPING,
    NONE,
    NOT_NEGATIVE,
    SEED,
    SHARE_BELOW_1,
    Rule,
    check,
    is_integer,
    is_number,
    number,
    of_type,
    one_of,
    whole,
)


def _is_temperature(value: Any) -> bool:
    if not isinstance(value, str):
        return is_number(value) and value >= 0
    if value == "auto":
        return True
    try:
        return value.startswith("auto_") and 0 < float(value.removeprefix("auto_")) < float("inf")
    except ValueError:
        return False


def _is_train_freq(value: Any) -> bool:
    if is_integer(value):
        return bool(value >= 1)
    if not (isinstance(value, tuple) and len(value) == 2):
        return False
    length, unit = value
    return is_integer(length) and length >= 1 and getattr(unit, "value", unit) in ("step", "episode")


def _is_callback(value: Any) -> bool:
    if isinstance(value, list):
        return all(isinstance(one, BaseCallback) for one in value)
    return value is None or isinstance(value, BaseCallback) or callable(value)


#: Of SAC's constructor; the learning rate is looked at by :func:`check_learning_rate`.
OF_SAC = {
    "policy": Rule(
        'be "MlpPolicy" or a class derived from SACPolicy',
        lambda x: isinstance(x, type) or (isinstance(x, str) and x in SAC.policy_aliases),
    ),
    "buffer_size": whole(1),
    "learning_starts": whole(0),
    "batch_size": whole(1),
    "tau": number("lie in (0, 1]", lambda x: 0 < x <= 1),
    "gamma": number("lie in [0, 1]", lambda x: 0 <= x <= 1),
    "train_freq": Rule('be a positive integer, or a tuple of one and "step" or "episode"', _is_train_freq),
    "gradient_steps": Rule("be an integer (negative: one a target step)", is_integer),
    "action_noise": of_type("be an ActionNoise", ActionNoise) | NONE,
    "replay_buffer_class": Rule(
        "be a class derived from ReplayBuffer, or None",
        lambda x: x is None or (isinstance(x, type) and issubclass(x, ReplayBuffer)),
    ),
    "replay_buffer_kwargs": MAPPING | NONE,
    "optimize_memory_usage": FLAG,
    "n_steps": whole(1),
    "ent_coef": Rule(
        'be "auto", "auto_0.5" with any number above 0, or a number that is not negative', _is_temperature
    ),
    "target_update_interval": whole(1),
    "target_entropy": Rule(
        'be "auto" or a finite number', lambda x: x == "auto" if isinstance(x, str) else is_number(x)
    ),
    "use_sde": FLAG,
    "sde_sample_freq": whole(-1, says="be an integer from -1, which stands for once a rollout"),
    "use_sde_at_warmup": FLAG,
    "stats_window_size": whole(1),
    "tensorboard_log": of_type("be the path of a folder", str, os.PathLike) | NONE,
    "policy_kwargs": MAPPING | NONE,
    "verbose": Rule("be 0, 1 or 2", lambda x: isinstance(x, bool) or (is_integer(x) and x >= 0)),
    "seed": SEED | NONE,
}
#: Of ours, as they are once a preset has filled in what was not passed.
OURS = {
    "dynamics": one_of(BACKENDS),
    "weighting": one_of((*WEIGHTINGS, None)),
    "rollout_start": one_of(("target", "source", "mix")),
    "real_ratio": SHARE_BELOW_1,
    "weight_floor": NOT_NEGATIVE,
    "source_steps": whole(1),
    "model_train_freq": whole(1),
    "retrain_steps": whole(0),
}
#: As a user passes them.
GIVEN = {
    **OF_SAC,
    **OURS,
    "source_steps": whole(1) | one_of(("auto",)),
    "preset": one_of(preset_names()),
    "dynamics_kwargs": MAPPING | NONE,
    "close_loop": Rule("be True or False (which effects to look for is effects=)", lambda x: isinstance(x, bool)),
}
#: Of ``learn()``.
OF_LEARN = {
    "total_timesteps": whole(1),
    "callback": Rule("be a callback, a list of callbacks, a function or None", _is_callback),
    "log_interval": whole(1, says="be a number of target episodes from 1, or None to log nothing") | NONE,
    "tb_log_name": of_type("be a string", str) | NONE,
    "reset_num_timesteps": FLAG,
    "progress_bar": FLAG,
    "source_timesteps": whole(0) | NONE,
}


def check_given(values: Mapping[str, Any]) -> None:
    """Refuse what a user passed to a constructor or to ``load()``, before anything is made of it.

    :param values: by name, others among them
    :raises ValueError: naming the argument and what it must be
    :raises TypeError: a learning rate that is none
    """
    if "learning_rate" in values:
        check_learning_rate(values["learning_rate"])
    check(GIVEN, values)
    if values.get("device") is not None:
        check_device(values["device"])
    if values.get("policy_kwargs"):
        _check_policy_kwargs(values.get("policy"), values["policy_kwargs"])


def check_learning_rate(learning_rate: Any) -> None:
    """Refuse what stands in the learning rate's place by mistake, and one out of range.

    :raises TypeError: it is neither a number nor a schedule
    :raises ValueError: it is negative or not finite
    """
    if not (callable(learning_rate) or (isinstance(learning_rate, Real) and not isinstance(learning_rate, bool))):
        raise TypeError(
            f"learning_rate must be a number or a schedule, not {type(learning_rate).__name__}; an environment of the "
            "target is passed by name, target_env="
        )
    if not callable(learning_rate):
        check({"learning_rate": NOT_NEGATIVE}, {"learning_rate": learning_rate})


def check_device(device: Any) -> None:
    """Refuse a device that torch cannot use here; "auto" is the GPU where there is one.

    :raises ValueError: naming it and those that there are
    """
    if device == "auto":
        return
    try:
        th.empty(0, device=device)
    except (RuntimeError, AssertionError, TypeError, ValueError) as error:  # torch asserts that it was built for CUDA
        there = ["cpu", *(f"cuda:{i}" for i in range(th.cuda.device_count()))]
        said = (str(error).splitlines() or [""])[0]
        raise ValueError(
            f"device={str(device)!r} cannot be used ({said}); there is 'auto', {', '.join(map(repr, there))}"
        ) from error


def _check_policy_kwargs(policy: Any, kwargs: Mapping[str, Any]) -> None:
    """Refuse arguments that the policy does not take, and widths of layers that are none.

    :param policy: its class or alias; None where a checkpoint tells
    :param kwargs: its arguments
    :raises ValueError: naming the argument
    """
    made_by = SAC.policy_aliases.get(policy) if isinstance(policy, str) else policy
    if isinstance(made_by, type):
        known = inspect.signature(made_by.__init__).parameters  # type: ignore[misc]
        if not any(p.kind is p.VAR_KEYWORD for p in known.values()):
            for name in kwargs:
                if name not in known:
                    meant = near(str(name), list(known)[1:])
                    raise ValueError(f"policy_kwargs: {made_by.__name__} has no argument {name!r}; {meant}")
    arch = kwargs.get("net_arch")
    lists = list(arch.values()) if isinstance(arch, Mapping) else [arch]
    layered = all(isinstance(one, list | tuple) and all(is_integer(n) and n >= 1 for n in one) for one in lists)
    if arch is not None and not (layered and (not isinstance(arch, Mapping) or {"pi", "qf"} <= set(arch))):
        raise ValueError(
            f"policy_kwargs: net_arch must be a list of positive integers, or a dict of two (pi and qf), got {arch!r}"
        )
