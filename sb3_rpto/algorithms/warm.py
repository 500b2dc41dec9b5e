"""Before the first target step: a policy, its critic and phi_0 that know the source."""

from __future__ import annotations

import copy
import pathlib
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.sac.policies import SACPolicy

from sb3_rpto.algorithms.source import EpisodeSource
from sb3_rpto.buffers import World, load_transitions

if TYPE_CHECKING:
    from sb3_rpto.algorithms.transfer import TransferAlgorithm

Model = TypeVar("Model", bound="TransferAlgorithm")

#: Source steps that fit phi_0 when no source data are given, and the cap of gradient steps of that fit.
PHI_0_STEPS, PHI_0_UPDATES = 25_000, 5_000
#: Source steps that fill D_source before the first target step when nothing else did.
FIRST_SOURCE_STEPS = 5_000
#: What a warm start takes over from the source model, unless the user passes it.
CARRIED = ("learning_rate", "batch_size", "tau", "gamma", "ent_coef", "target_entropy", "use_sde", "sde_sample_freq")


def from_source(
    cls: type[Model],
    source_model: SAC | str | pathlib.Path,
    env: GymEnv | str,
    target_env: GymEnv | str | None,
    source_data: ReplayBuffer | str | pathlib.Path | None,
    kwargs: dict[str, Any],
) -> Model:
    """See :meth:`TransferAlgorithm.from_source`."""
    sac = source_model if isinstance(source_model, SAC) else SAC.load(source_model, device=kwargs.get("device", "auto"))
    carried = {name: getattr(sac, name) for name in CARRIED}
    carried["policy_kwargs"] = {name: value for name, value in sac.policy_kwargs.items() if name != "use_sde"}
    model = cls(cast(type[SACPolicy], sac.policy_class), env, target_env=target_env, **{**carried, **kwargs})
    for name in ("observation_space", "action_space"):
        ours, theirs = getattr(model, name), getattr(sac, name)
        if ours.shape != theirs.shape:
            raise ValueError(f"source_model has {name} {theirs}, env has {ours}; pass the agent of this environment")
    try:
        model.policy.load_state_dict(sac.policy.state_dict())
    except RuntimeError as error:
        raise ValueError(f"source_model's networks do not fit policy_kwargs={model.policy_kwargs}: {error}") from error
    _carry_optimizers(sac, model)
    if source_data is not None:
        arrays = _checked(load_transitions(source_data), model, "source_data")
        _fill_source(model, arrays)
    model._warm = True
    return model


def fill_target(model: TransferAlgorithm, target_data: ReplayBuffer | str | pathlib.Path) -> None:
    """Put recorded target transitions into D_target."""
    arrays = _checked(load_transitions(target_data), model, "target_data")
    n = min(len(arrays["rewards"]), model.replay_buffer.target.buffer_size)
    _append(model, "target", {name: array[-n:] for name, array in arrays.items()})


def begin_in_source(model: TransferAlgorithm, source_timesteps: int, progress_bar: bool) -> None:
    """Bring policy, D_source and phi_0 to where Algorithm 1 starts; counts no target step.

    A model that knows nothing of the source first trains there by plain SAC. D_source then holds source transitions,
    and phi_0 is fitted to them.
    """
    if not model._warm and source_timesteps > 0:
        _train_in_source(model, source_timesteps, progress_bar)
    model._warm = True
    if not model.snapshots:
        model.take_snapshot("source")
    assert model.env is not None  # learn() has checked
    network = model.dynamics if model.dynamics is not None and model.dynamics.rollout == "branches" else None
    if len(model.replay_buffer.source_starts) == 0 and (network is not None or model.replay_buffer.source.size() == 0):
        needed = PHI_0_STEPS if network is not None else FIRST_SOURCE_STEPS
        real = EpisodeSource(model.env)
        model.source_timesteps += real.interact(model, min(needed, model.replay_buffer.source.buffer_size))
        model.env.reset()
    if network is not None:
        if len(model.replay_buffer.source_starts) == 0:
            model.replay_buffer.source_starts = model.transitions("source").observations.cpu().numpy()[-PHI_0_STEPS:]
        if not network.fitted:
            for name, value in network.fit(model.transitions("source"), max_steps=PHI_0_UPDATES).items():
                model.logger.record(f"dynamics/phi_0_{name}", value)


def _train_in_source(model: TransferAlgorithm, source_timesteps: int, progress_bar: bool) -> None:
    """Plain SAC in the real source, one update per step; resumes where a checkpoint left it."""
    assert model.env is not None  # learn() has checked
    bar = None
    if progress_bar:
        from tqdm.rich import tqdm

        bar = tqdm(total=source_timesteps, initial=model._pretrained_steps, desc="source")
    source = EpisodeSource(model.env, model._source_first_obs)
    model._pretraining = True
    report_every = max(source_timesteps // 10, 1)
    next_report = (model._pretrained_steps // report_every + 1) * report_every
    try:
        while model._pretrained_steps < source_timesteps:
            warming_up = model._pretrained_steps < model.learning_starts
            explores = model.use_sde and model.use_sde_at_warmup
            steps = source.interact(model, 1, random=warming_up and not explores)
            model._pretrained_steps += steps
            model.source_timesteps += steps
            if model._pretrained_steps > model.learning_starts:
                model.train(steps, model.batch_size)
            if bar is not None:
                bar.update(steps)
            if model._pretrained_steps >= next_report:
                next_report += report_every
                _report(model, source)
    finally:
        model._pretraining = False
        if bar is not None:
            bar.close()
    model.env.reset()


def _report(model: TransferAlgorithm, source: EpisodeSource) -> None:
    """Log the source phase in a group of its own and leave a checkpoint where the logger has a folder."""
    for name, value in {"timesteps": model._pretrained_steps, **source.log()}.items():
        model.logger.record(f"pretrain/{name}", value)
    model.logger.dump(step=0)
    if model.logger.dir is not None:
        folder = pathlib.Path(model.logger.dir)
        model.save(folder / "pretrain.zip")
        model.save_replay_buffer(folder / "pretrain_replay_buffer.pkl")


def _carry_optimizers(sac: SAC, model: TransferAlgorithm) -> None:
    """Take over the temperature and the state of every optimiser."""
    pairs: list[tuple[Any, Any]] = [
        (sac.actor.optimizer, model.actor.optimizer),
        (sac.critic.optimizer, model.critic.optimizer),
    ]
    if sac.log_ent_coef is not None and model.log_ent_coef is not None:
        model.log_ent_coef.data.copy_(sac.log_ent_coef.data)
        pairs.append((sac.ent_coef_optimizer, model.ent_coef_optimizer))
    elif model.log_ent_coef is None and sac.log_ent_coef is None:
        model.ent_coef_tensor = sac.ent_coef_tensor.clone().to(model.device)
    for theirs, ours in pairs:
        ours.load_state_dict(copy.deepcopy(theirs.state_dict()))


def _checked(arrays: dict[str, np.ndarray], model: TransferAlgorithm, name: str) -> dict[str, np.ndarray]:
    for array, space in (("observations", model.observation_space), ("actions", model.action_space)):
        if arrays[array].shape[1:] != space.shape:
            raise ValueError(
                f"{name} holds {array} of shape {arrays[array].shape[1:]}, the environment's is {space.shape}"
            )
    if np.abs(arrays["actions"]).max() > 1 + 1e-3:
        raise ValueError(
            f"{name} holds actions outside [-1, 1]; scale them by policy.scale_action, as SB3's buffers do"
        )
    return arrays


def _fill_source(model: TransferAlgorithm, arrays: dict[str, np.ndarray]) -> None:
    n = min(len(arrays["rewards"]), model.replay_buffer.source.buffer_size)
    _append(model, "source", {name: array[-n:] for name, array in arrays.items()})
    model.replay_buffer.source_starts = arrays["observations"].astype(model.observation_space.dtype)


def _append(model: TransferAlgorithm, world: World, arrays: dict[str, np.ndarray]) -> None:
    model.replay_buffer.append(
        world,
        arrays["observations"],
        arrays["next_observations"],
        arrays["actions"],
        arrays["rewards"],
        arrays["terminations"],
    )
