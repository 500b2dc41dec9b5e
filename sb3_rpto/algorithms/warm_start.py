"""Before the first target step: a policy, its critic and phi_0 that know the source."""

from __future__ import annotations

import copy
import os
import pathlib
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv

from sb3_rpto.algorithms import model_zip, offline_target
from sb3_rpto.algorithms.checkpointing import Resumable
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.algorithms.transition_checks import check_rewards
from sb3_rpto.algorithms.update import as_transitions
from sb3_rpto.buffers import World, load_transitions
from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.effects import Effect
from sb3_rpto.envs.observations import single_env
from sb3_rpto.envs.task_rules import task_rules
from sb3_rpto.sysid import Measurements

#: Source steps that fit phi_0 when no source data are given, and the cap of gradient steps of that fit.
PHI_0_STEPS, PHI_0_UPDATES = 25_000, 5_000
#: Source steps that fill D_source before the first target step when nothing else did.
FIRST_SOURCE_STEPS = 5_000
#: Options of an optimizer that do not decide what it keeps of each parameter.
FREE_OPTIONS = ("params", "lr", "weight_decay", "betas", "eps", "foreach", "fused", "capturable", "differentiable")


def load_sac(source_model: SAC | str | pathlib.Path, device: Any) -> SAC:
    """The source model itself, or from its zip.

    :raises TypeError: for a model of another kind
    :raises ValueError: for a zip that SAC cannot load, and for SLBO
    :raises FileNotFoundError: there is none
    """
    if isinstance(source_model, SAC):
        if getattr(source_model, "trpo", None) is not None:
            raise ValueError("source_model is an SLBO, which acts by TRPO's policy; its SAC has learned nothing since")
        return source_model
    if not isinstance(source_model, str | os.PathLike):
        raise TypeError(f"source_model must be a SAC or the path of its zip, not {type(source_model).__name__}")
    file = model_zip.located(source_model, "source_model")
    misfit = model_zip.misfit_of_sac(model_zip.look_into(file, "source_model"))
    try:
        if misfit:
            raise ValueError(misfit)
        # Its seed is that of its own training, and SB3 would seed the whole process with it.
        return SAC.load(file, device=device, custom_objects={"seed": None})
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"source_model={str(source_model)!r} is not the zip of a SAC ({error}); a model of this package goes on "
            "with its own class's load(), and what that loads may be a source_model"
        ) from error


def check_source_spaces(sac: SAC, env: GymEnv) -> None:
    """Require that a source model is one of this environment.

    :raises ValueError: naming the space that differs
    """
    for name in ("observation_space", "action_space"):
        ours, theirs = getattr(env, name), getattr(sac, name)
        if ours.shape != theirs.shape:
            raise ValueError(f"source_model has {name} {theirs}, env has {ours}; pass the agent of this environment")


def carry_over(sac: SAC, model: Resumable, temperature: bool = True) -> None:
    """Take over actor, critics, their targets, the temperature and the state of every optimiser of the same kind.

    :param temperature: whether to take over the temperature, too
    :raises ValueError: when the source model's networks are not the model's
    """
    if sac.action_space != model.action_space:
        warnings.warn(
            f"source_model was trained with {sac.action_space}, env has {model.action_space}: the same output of the "
            "policy is another action now",
            stacklevel=3,
        )
    try:
        model.policy.load_state_dict(sac.policy.state_dict())
    except RuntimeError as error:
        raise ValueError(f"source_model's networks do not fit policy_kwargs={model.policy_kwargs}: {error}") from error
    for theirs, ours in ((sac.actor.optimizer, model.actor.optimizer), (sac.critic.optimizer, model.critic.optimizer)):
        _carry_optimizer(theirs, ours)
    if temperature:
        _carry_temperature(sac, model)
    model._warm = True


def fill_source(model: Resumable, source_data: ReplayBuffer | str | pathlib.Path) -> None:
    """Put recorded source transitions into D_source; branches may start from their states."""
    arrays = _loaded(source_data, model, "source_data")
    model.replay_buffer.resize("source", max(model.buffer_size, len(arrays["rewards"])))
    _append_newest(model, "source", arrays)
    model.replay_buffer.source_starts = arrays["observations"].astype(model.observation_space.dtype)


def fill_target(model: Resumable, target_data: ReplayBuffer | str | pathlib.Path | Measurements) -> None:
    """Put recorded target transitions into D_target, with rewards by :func:`_with_rewards`."""
    if isinstance(target_data, Measurements):
        fill_recorded(model, target_data)
        return
    arrays = _loaded(target_data, model, "target_data", world="target", rewards_optional=True)
    _append_newest(model, "target", _with_rewards(model, arrays))


def fill_recorded(model: Resumable, measured: Measurements, effects: Sequence[Effect] = ()) -> None:
    """Let D_target hold what a robot's log tells, and nothing else.

    :param model: with its source
    :param measured: the log
    :param effects: what is known to be in the machine beside the source
    :raises ValueError: a log of another machine; none of its steps is one of the task where phi is fitted to steps;
        rewards that are not known where they are needed
    """
    assert model.env is not None
    rules = {name: model.dynamics_kwargs.get(name) for name in ("reward_fn", "termination_fn")}
    arrays = offline_target.transitions(measured, single_env(model.env), effects, **rules)
    model.replay_buffer.reset()
    model.replay_buffer.estimated = model._traces_log
    if not len(arrays["actions"]):
        message = "target_data holds no whole step that begins where the task goes on"
        if not model._traces_log:
            raise ValueError(f"{message}: record motion of the task, for longer than a step without gaps")
        warnings.warn(f"{message}: it corrects the simulator, and the policy learns there alone", stacklevel=4)
        return
    _append_newest(model, "target", _with_rewards(model, arrays))


def begin_in_source(model: Resumable, source_timesteps: int, progress_bar: bool) -> None:
    """Bring policy, D_source and phi_0 to where Algorithm 1 starts; counts no target step.

    A model that knows nothing of the source first trains there by plain SAC. D_source then holds source transitions,
    and phi_0 is fitted to them. While all this goes on D_source is as large as it takes; the transfer begins with the
    newest ``buffer_size`` of them.
    """
    buffer = model.replay_buffer
    if not model._warm and source_timesteps > 0:
        buffer.resize("source", max(buffer.source.buffer_size, source_timesteps))
        _train_in_source(model, source_timesteps, progress_bar)
    model._warm = True
    if "source" not in model.snapshots:
        model.take_snapshot("source")
    # A network must be fitted to describe the source; a physical model comes with the source's constants.
    learned = model.dynamics if model.dynamics is not None and model.dynamics.rollout == "branches" else None
    # Neither source_data nor an earlier run gave any. A run that goes on keeps what a closed loop left it.
    if len(buffer.source_starts) == 0 and (model.num_timesteps == 0 or buffer.source.size() == 0):
        fits = learned is not None and not learned.fitted
        wanted = PHI_0_STEPS if fits else min(FIRST_SOURCE_STEPS, model.buffer_size)
        buffer.resize("source", max(buffer.source.buffer_size, wanted))
        _collect_in_source(model, wanted - buffer.source.size())
        if learned is not None:
            buffer.source_starts = model.transitions("source").observations.cpu().numpy()[-PHI_0_STEPS:]
    if learned is not None and not learned.fitted:
        _fit_phi_0(model, learned)
    buffer.resize("source", model.buffer_size)


def _collect_in_source(model: Resumable, n_steps: int) -> None:
    """Act in the source and fill D_source, in the real one for branches; nothing for ``n_steps`` <= 0."""
    assert model.env is not None  # learn() has checked
    if n_steps <= 0:
        return
    if model.dynamics is not None and model.dynamics.rollout == "episodes":  # phi may have moved: its own source
        assert model._source_world is not None
        model._source_world.interact(model, n_steps)
        return
    EpisodeSource(model.env).interact(model, n_steps)
    model.env.reset()


def phi_0_updates(model: Resumable) -> int:
    """Gradient steps that fit phi_0 at most: a number of the user's bounds every fit, a preset's the later ones."""
    return min(PHI_0_UPDATES, model.fit_bound or PHI_0_UPDATES)


def _fit_phi_0(model: Resumable, dynamics: Dynamics) -> None:
    """Let the learned dynamics describe the source before the first target step (Algorithm 1's input)."""
    data = model.transitions("source")
    if model.verbose:
        print(f"fitting the model of the source to {len(data):,} transitions, which may take minutes on a CPU")
    for name, value in dynamics.fit(data, max_steps=phi_0_updates(model)).items():
        model.logger.record(f"dynamics/phi_0_{name}", value)


def _train_in_source(model: Resumable, source_timesteps: int, progress_bar: bool) -> None:
    """Plain SAC in the real source, one update per step; resumes where a checkpoint left it."""
    assert model.env is not None  # learn() has checked
    bar = None
    if progress_bar:
        from tqdm.rich import tqdm

        bar = tqdm(total=source_timesteps, initial=model._pretrained_steps, desc="source")
    source = EpisodeSource(model.env, model._source_first_obs)
    model._source_first_obs = None  # a phase that is interrupted goes on elsewhere
    model._pretraining = True
    report_every = max(source_timesteps // 10, 1)
    next_report = (model._pretrained_steps // report_every + 1) * report_every
    try:
        while model._pretrained_steps < source_timesteps:
            warming_up = model._pretrained_steps < model.learning_starts
            explores = model.use_sde and model.use_sde_at_warmup
            steps = source.interact(model, 1, random=warming_up and not explores)
            model._pretrained_steps += steps
            # Also where it goes on without its buffers: the policy would be fitted to a handful of transitions.
            if model.replay_buffer.source.size() > model.learning_starts:
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


def _report(model: Resumable, source: EpisodeSource) -> None:
    """Log the source phase in a group of its own and leave a checkpoint where the user gave the logger a folder."""
    for name, value in {"timesteps": model._pretrained_steps, **source.log()}.items():
        model.logger.record(f"pretrain/{name}", value)
    # As in every row of SB3's: readers of its files draw the rest against this one.
    model.logger.record("time/total_timesteps", model.num_timesteps, exclude="tensorboard")
    model.logger.dump(step=model.num_timesteps)
    given = model._custom_logger or model.tensorboard_log is not None or "SB3_LOGDIR" in os.environ
    if given and model.logger.dir is not None:
        folder = pathlib.Path(model.logger.dir)
        # A process killed between the two leaves transitions of steps that the zip has not, not steps without any.
        model.save_replay_buffer(folder / "pretrain_replay_buffer.pkl")
        model.save(folder / "pretrain.zip")


def _carry_temperature(sac: SAC, model: Resumable) -> None:
    """Take over the temperature and, where both learn it, its optimiser's state."""
    if model.log_ent_coef is None:
        learned = None if sac.log_ent_coef is None else sac.log_ent_coef.detach().exp().reshape(())
        model.ent_coef_tensor = (sac.ent_coef_tensor if learned is None else learned).clone().to(model.device)
    elif sac.log_ent_coef is None and float(sac.ent_coef_tensor) == 0.0:
        return  # what is learned is a logarithm, which 0 has not: it begins where ent_coef says
    elif sac.log_ent_coef is None:
        model.log_ent_coef.data.fill_(float(sac.ent_coef_tensor.log()))
    else:
        assert model.ent_coef_optimizer is not None
        assert sac.ent_coef_optimizer is not None
        model.log_ent_coef.data.copy_(sac.log_ent_coef.data)
        _carry_optimizer(sac.ent_coef_optimizer, model.ent_coef_optimizer)


def _carry_optimizer(theirs: th.optim.Optimizer, ours: th.optim.Optimizer) -> None:
    """Take over what an optimizer has learned of its parameters, where ours is one that goes on with it.

    Its options stay those of our ``policy_kwargs``.
    """
    options = [
        [{n: v for n, v in group.items() if n not in FREE_OPTIONS} for group in o.param_groups] for o in (theirs, ours)
    ]
    if type(theirs) is type(ours) and options[0] == options[1]:
        state = copy.deepcopy(theirs.state_dict())
        ours.load_state_dict({**state, "param_groups": ours.state_dict()["param_groups"]})


def _loaded(data: Any, model: Resumable, name: str, **how: Any) -> dict[str, np.ndarray]:
    """The recorded transitions, unless they are not of this model's environments.

    :param name: of the argument that they were passed as
    :param how: as of :func:`~sb3_rpto.buffers.load_transitions`
    :raises ValueError: for what holds none, for other shapes and for actions that are not on the buffers' scale
    """
    try:
        arrays = load_transitions(data, **how)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    of_observation, of_action = model.observation_space.shape, model.action_space.shape
    expected = {"observations": of_observation, "next_observations": of_observation, "actions": of_action}
    for array, values in arrays.items():
        if values.shape[1:] != expected.get(array, ()):
            raise ValueError(
                f"{name} holds {array} of shape {values.shape[1:]}, the environment's is {expected.get(array, ())}"
            )
        if len(values) != len(arrays["observations"]):
            raise ValueError(f"{name} holds {len(values)} {array} and {len(arrays['observations'])} observations")
    if np.abs(arrays["actions"]).max() > 1 + 1e-3:
        raise ValueError(
            f"{name} holds actions outside [-1, 1]; scale them by policy.scale_action, as SB3's buffers do"
        )
    if "rewards" in arrays:
        check_rewards(f"{name} holds", arrays["rewards"])
    if not np.isin(arrays["terminations"], (0, 1)).all():
        raise ValueError(f"{name} holds values of done other than 0 and 1 (terminal, not a time limit); mend them")
    return arrays


def _with_rewards(model: Resumable, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Recorded transitions with rewards: their own, those of a known rule, or zeros where nothing is to read them.

    A share of target transitions in the critic's batches that nobody asked for is left out as long as these are there.

    :raises ValueError: there are none, and something needs them
    """
    if "rewards" in arrays:
        return arrays
    assert model.env is not None  # target_data is an argument of the constructor, which has one
    reward_fn = model.dynamics_kwargs.get("reward_fn") or task_rules(model.env).reward_fn
    if reward_fn is not None:
        data = as_transitions({**arrays, "rewards": arrays["terminations"]}, model.policy, model.device)
        rewards = reward_fn(data.observations, data.actions, data.next_observations).cpu().numpy()
        return {**arrays, "rewards": rewards}
    need = _need_of_rewards(model)
    if need:
        raise ValueError(f"target_data holds no rewards, and the task's are not known: {need}")
    model.replay_buffer.unrewarded = True
    if model.real_ratio > 0 and model.updates_policy and not model._traces_log:  # where the critic needs none
        warnings.warn(
            "target_data holds no rewards, and the task's are not known: the critic learns from the source's "
            f"transitions alone, without the share real_ratio={model.real_ratio} of the target's",
            stacklevel=5,
        )
    return {**arrays, "rewards": np.zeros(len(arrays["actions"]))}


def _need_of_rewards(model: Resumable) -> str:
    """What needs the target's rewards, and the remedy; empty where nothing does."""
    rule = "{'reward_fn': f} with f(observations, actions, next_observations) -> (n,)"
    if model.dynamics_backend == "ensemble":
        return (
            f"dynamics='ensemble' would learn them; pass dynamics_kwargs={rule}, record them (rew), or take "
            "dynamics='physical' or 'residual', which earn the source's own"
        )
    if model.weighting is not None and not model._traces_log:
        return "RTO's weight is made of them; pass weighting=None or record them (rew)"
    if model.real_ratio > 0 and "real_ratio" in model._passed:
        return "real_ratio is the share of the critic's batches that holds them; pass real_ratio=0 or leave it out"
    return ""


def _append_newest(model: Resumable, world: World, arrays: dict[str, np.ndarray]) -> None:
    """Add as many of the newest transitions as that side of the buffer holds."""
    capacity, given = model.replay_buffer.side(world).buffer_size, len(arrays["actions"])
    if given > capacity:
        warnings.warn(
            f"of {given} {world} transitions the buffer takes the newest {capacity}; pass "
            + ('replay_buffer_kwargs={"target_size": ...}' if world == "target" else "buffer_size="),
            stacklevel=4,
        )
    newest = {name: array[-capacity:] for name, array in arrays.items()}
    model.replay_buffer.append(world, dones=newest.pop("terminations"), **newest)
