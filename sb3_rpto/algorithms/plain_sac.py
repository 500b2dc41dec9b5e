"""A SAC of Stable-Baselines3 alone: out of a model of ours, and of the weights in a zip whose pickles nobody runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_rpto.algorithms import model_zip

#: Constructor arguments that a warm start takes over from the source model, unless the user passes them.
CARRIED = (
    *("learning_rate", "batch_size", "tau", "gamma", "ent_coef", "target_entropy", "target_update_interval"),
    *("use_sde", "sde_sample_freq", "use_sde_at_warmup"),
)


def carried_arguments(sac: SAC) -> dict[str, Any]:
    """Constructor arguments that a warm start takes over from the source model."""
    policy_kwargs = {name: value for name, value in sac.policy_kwargs.items() if name != "use_sde"}
    return {**{name: getattr(sac, name) for name in CARRIED}, "policy_kwargs": policy_kwargs}


def sac_of_model(model: SAC) -> SAC:
    """A plain SAC with the networks, the temperature and the optimisers of a model that is derived from it.

    :param model: any; without its environment, buffers and whatever else it has
    """
    sac = _built(
        model.policy_class,
        model.observation_space,
        model.action_space,
        {
            **carried_arguments(model),
            **{"buffer_size": model.buffer_size, "learning_starts": model.learning_starts, "verbose": model.verbose},
        },
        model.device,
    )
    sac.set_parameters(model.get_parameters(), device=model.device)  # type: ignore[arg-type]
    _set_temperature(sac, {"log_ent_coef": model.log_ent_coef})
    sac.num_timesteps, sac._n_updates = model.num_timesteps, model._n_updates
    return sac


def sac_of_weights(path: Any, env: Any, policy_kwargs: Mapping[str, Any] | None, device: Any) -> SAC:
    """A SAC from its zip without running a pickle, so that the file may be a stranger's.

    Read are tensors, by ``torch.load(weights_only=True)``, and those settings that the zip holds as JSON; others,
    schedules and classes among them, are left at SAC's defaults.

    :param path: of the zip
    :param env: the environment that it learned in: the spaces in the zip are pickles
    :param policy_kwargs: of its policy; None: what the zip tells
    :param device: to put it on
    :raises ValueError: for what is no SAC's zip, and for networks that are not those of the ``policy_kwargs``
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"source_model must be the path of a zip where weights_only=True, not {type(path).__name__}")
    file = model_zip.located(path, "source_model")
    content = model_zip.look_into(file, "source_model")
    misfit = model_zip.misfit_of_sac(content)
    if misfit:
        raise ValueError(f"source_model={str(path)!r} is not the zip of a SAC ({misfit})")
    settings = {name: content[name] for name in CARRIED if isinstance(content.get(name), bool | int | float | str)}
    told = content.get("policy_kwargs", {}) if policy_kwargs is None else policy_kwargs
    if ":serialized:" in told:
        raise ValueError(
            f"source_model={str(path)!r} holds its policy_kwargs as a pickle, which weights_only=True does not run; "
            "pass policy_kwargs="
        )
    told = {name: value for name, value in told.items() if name != "use_sde"}
    settings["policy_kwargs"] = dict(told)  # to which SB3 adds
    sac = _built("MlpPolicy", env.observation_space, env.action_space, settings, device)
    _, parameters, variables = load_from_zip_file(file, load_data=False, device=sac.device)
    try:
        sac.set_parameters(parameters, device=sac.device)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"source_model={str(path)!r} holds other networks than policy_kwargs={told} make for env "
            f"({' '.join(str(error).split())[:300]}); pass those of the agent"
        ) from error
    _set_temperature(sac, variables or {})
    return sac


def _built(
    policy: Any, observation_space: spaces.Space, action_space: spaces.Space, settings: Mapping[str, Any], device: Any
) -> SAC:
    """A SAC of these spaces without an environment, as SB3's ``load()`` makes one."""
    sac = SAC(policy, None, **settings, device=device, _init_setup_model=False)  # type: ignore[arg-type]
    sac.observation_space, sac.action_space, sac.n_envs = observation_space, action_space, 1
    sac._setup_model()
    return sac


def _set_temperature(sac: SAC, variables: Mapping[str, Any]) -> None:
    """A learned temperature; one that is fixed is an argument."""
    value = variables.get("log_ent_coef")
    if sac.log_ent_coef is not None and value is not None:
        sac.log_ent_coef.data = value.data.detach().clone().to(sac.device)
