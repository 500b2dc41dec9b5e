"""Baselines that are SAC or TRPO with another start, other data or another simulator."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_rpto.algorithms import pretraining
from sb3_rpto.algorithms.arguments import begin_temperature, one_kind_of_temperature
from sb3_rpto.algorithms.environment_checks import check_spaces
from sb3_rpto.algorithms.plain_sac import carried_arguments
from sb3_rpto.algorithms.recorded_data import as_transitions
from sb3_rpto.algorithms.rollouts import EpisodeSource, make_rollouts
from sb3_rpto.baselines.policy_distillation import SquashedMeanPolicy, clone, clone_kwargs
from sb3_rpto.baselines.regression import regress
from sb3_rpto.buffers import DualReplayBuffer, World, chronological, load_transitions
from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.factory import dynamics_config, make_dynamics

#: Gradient steps of each critic that is added to a source model's two.
CRITIC_STEPS = 2_000
STEP_BY_STEP = TrainFreq(1, TrainFrequencyUnit.STEP)


def fine_tuned_sac(
    source_model: str | pathlib.Path, target: GymEnv, seed: int, device: str = "cpu", **settings: Any
) -> SAC:
    """SAC-warm: the source's SAC, ready to go on in the target from its first step, with an empty replay buffer.

    It collects step by step, so that a budget is met exactly, with as many updates per step as in the source
    (a step of several environments side by side counts once), and not less than one.

    :param source_model: zip of the SAC that was trained in the source
    :param target: the target
    :param seed: of the run
    :param device: to learn on
    :param settings: attributes to change, e.g. ``gradient_steps``
    :raises ValueError: for another ``train_freq``, ``use_sde`` or ``n_steps`` than the source model's, or an
        ``ent_coef`` that is fixed where the source's is learned
    """
    check_step_by_step(settings)
    _check_made_so(source_model, settings)
    with one_kind_of_temperature(settings):
        model = SAC.load(source_model, env=target, device=device, **settings)
    begin_temperature(model, settings.get("ent_coef"))
    if isinstance(model.replay_buffer, NStepReplayBuffer):
        model.replay_buffer.gamma = model.gamma
    model.set_random_seed(seed)
    model.learning_starts = 0
    frequency, unit = cast(TrainFreq, model.train_freq)
    if "gradient_steps" not in settings and model.gradient_steps > 0:
        in_steps = unit == TrainFrequencyUnit.STEP
        model.gradient_steps = max(round(model.gradient_steps / frequency), 1) if in_steps else 1
    model.train_freq = STEP_BY_STEP  # type: ignore[assignment]  # as SB3's own conversion does
    return model


def _check_made_so(source_model: str | pathlib.Path, settings: Mapping[str, Any]) -> None:
    """Refuse what a zip is made with, its networks or its replay buffer, where another is asked for.

    :raises ValueError: with the remedy
    """
    asked = {name: settings[name] for name in ("use_sde", "n_steps") if name in settings}
    data = (load_from_zip_file(source_model, device="cpu")[0] or {}) if asked else {}
    for name, value in asked.items():
        had = data.get(name, {"use_sde": False, "n_steps": 1}[name])  # n_steps is newer than some zips
        if value != had:
            raise ValueError(
                f"{name} is {value!r} and the source model's {had!r}, which its zip is made with; leave it out, or "
                "train a source model so"
            )


def check_step_by_step(settings: Mapping[str, Any]) -> None:
    """Refuse a ``train_freq`` that would overrun a budget of target steps.

    :raises ValueError: with the remedy
    """
    if settings.get("train_freq", 1) not in (1, STEP_BY_STEP):
        raise ValueError(
            f"train_freq is {settings['train_freq']!r}, and a budget of target steps is met step by step: give 1, and "
            "the updates for each step as gradient_steps"
        )


def source_transitions(
    source_model: str | pathlib.Path, source: GymEnv, seed: int, source_data: Any = None
) -> tuple[dict[str, np.ndarray], int]:
    """Transitions of the source, for methods that need some: those given, else fresh ones of the source policy.

    :param source_model: zip of the SAC that was trained in the source
    :param source: the source
    :param seed: of the run
    :param source_data: recorded transitions, as :func:`~sb3_rpto.buffers.load_transitions` takes them
    :return: arrays as :func:`~sb3_rpto.buffers.chronological` gives them, and how many source steps they cost now
    """
    if source_data is not None:
        return load_transitions(source_data), 0
    settings: dict[str, Any] = {"gradient_steps": 0, "buffer_size": pretraining.PHI_0_STEPS}
    recorder = fine_tuned_sac(source_model, source, seed, **settings).learn(pretraining.PHI_0_STEPS)
    assert recorder.replay_buffer is not None  # learn() has filled it
    return chronological(recorder.replay_buffer), pretraining.PHI_0_STEPS


# ---------------------------------------------------------------------- many updates


def with_more_critics(
    source_model: str | pathlib.Path,
    target: GymEnv,
    seed: int,
    n_critics: int,
    data: dict[str, np.ndarray],
    device: str = "cpu",
    **settings: Any,
) -> SAC:
    """SAC-warm with more critics than the source model had, as methods with many updates a step use them.

    The source's critics are taken over. Each further one starts at random and is regressed on one of them: copies
    would stay equal for ever.

    :param source_model: zip of the SAC that was trained in the source
    :param target: the target
    :param seed: of the run
    :param n_critics: how many there shall be, at least as many as there are
    :param data: source transitions
    :param device: to learn on
    :param settings: arguments of SAC that win over the source model's
    :raises ValueError: for fewer critics than the source model has, or another ``train_freq`` than 1
    """
    check_step_by_step(settings)
    _check_made_so(source_model, settings)
    source = fine_tuned_sac(source_model, target, seed, device)
    check_critics(source, n_critics)
    old = source.critic.q_networks
    fixed = {"learning_starts": 0, "n_steps": source.n_steps, "seed": seed, "device": device}
    arguments = {**carried_arguments(source), **fixed, **settings}
    arguments["policy_kwargs"] = {**arguments["policy_kwargs"], "n_critics": n_critics}
    model = SAC("MlpPolicy", target, **arguments)
    model.actor.load_state_dict(source.actor.state_dict())
    if model.log_ent_coef is not None and source.log_ent_coef is not None:
        model.log_ent_coef.data.copy_(source.log_ent_coef.data)
        begin_temperature(model, settings.get("ent_coef"))
    seen = _as_seen(data["observations"], model)
    inputs = th.as_tensor(np.concatenate([seen, data["actions"]], axis=1), device=model.device).float()
    for i, network in enumerate(model.critic.q_networks):
        teacher = old[i % len(old)]
        if i < len(old):
            network.load_state_dict(teacher.state_dict())
            continue
        with th.no_grad():
            goals = teacher(inputs)
        regress(network, th.optim.Adam(network.parameters(), lr=1e-3), inputs, goals, CRITIC_STEPS)
    model.critic_target.load_state_dict(model.critic.state_dict())
    return model


def _as_seen(observations: np.ndarray, model: Any) -> np.ndarray:
    """Raw observations as a model sees them."""
    normaliser = model.get_vec_normalize_env()
    return observations if normaliser is None else np.asarray(normaliser.normalize_obs(observations))


def check_critics(source: SAC, n_critics: int) -> None:
    """Refuse a number of critics that does not begin with the source model's own.

    :raises ValueError: with the remedy
    """
    old = len(source.critic.q_networks)
    if not isinstance(n_critics, int) or n_critics < old:
        raise ValueError(f"n_critics must be an integer, at least the source model's {old}, got {n_critics!r}")


# ---------------------------------------------------------------------- mixed buffers


class MixedReplayBuffer(DualReplayBuffer):
    """Each batch is half of the source, half of the target; the odd one is the target's."""

    def sample(
        self, batch_size: int, env: VecNormalize | None = None, world: World | None = None
    ) -> ReplayBufferSamples:
        """Draw from both worlds, or from one.

        :param batch_size: transitions
        :param env: as in SB3
        :param world: None: half and half
        """
        if world is not None:
            return super().sample(batch_size, env, world)
        source = super().sample(batch_size // 2, env, "source")
        target = super().sample(batch_size - batch_size // 2, env, "target")
        return ReplayBufferSamples(*(th.cat(pair) for pair in zip(source[:5], target[:5])))


def mixed_sac(
    source_model: str | pathlib.Path,
    target: GymEnv,
    seed: int,
    data: dict[str, np.ndarray],
    device: str = "cpu",
    **settings: Any,
) -> SAC:
    """SAC-warm that learns from source and target transitions half and half.

    :param source_model: zip of the SAC that was trained in the source
    :param target: the target
    :param seed: of the run
    :param data: source transitions
    :param device: to learn on
    :param settings: attributes to change
    """
    model = fine_tuned_sac(source_model, target, seed, device, **settings)
    check_spaces(model.observation_space, model.action_space)
    assert isinstance(model.observation_space, spaces.Box)  # as just checked
    assert isinstance(model.action_space, spaces.Box)
    buffer = MixedReplayBuffer(len(data["rewards"]), model.observation_space, model.action_space, model.device)
    arrays = {name: array for name, array in data.items() if name != "terminations"}
    buffer.append("source", dones=data["terminations"], **arrays)
    model.replay_buffer = buffer
    return model


# ---------------------------------------------------------------------- TRPO


def rollout_length(budget: int, longest: int) -> int:
    """Steps of a TRPO rollout: at most ``longest``, and so that whole rollouts make up the budget.

    :param budget: target steps
    :param longest: what is wanted
    :return: the largest divisor of the budget that fits and is above 1, else the budget itself
    """
    return max((n for n in range(2, min(longest, budget) + 1) if budget % n == 0), default=budget)


def trpo_steps(budget: int, n_steps: int | None) -> int:
    """Steps of each of TRPO's rollouts.

    :param budget: target steps
    :param n_steps: those that are asked for; None: 2048, for small budgets a quarter
    :raises ValueError: for what is no divisor of the budget above 1: TRPO would overspend it
    """
    if n_steps is None:
        return rollout_length(budget, min(2048, max(budget // 4, 2)))
    if not isinstance(n_steps, int) or n_steps < 2 or budget % n_steps:
        raise ValueError(
            f"n_steps={n_steps!r} must be an integer above 1 that divides the budget of {budget} target steps, or TRPO "
            "overspends it"
        )
    return n_steps


def cloned_trpo(
    source_model: str | pathlib.Path,
    target: GymEnv,
    seed: int,
    budget: int,
    states: np.ndarray,
    device: str = "cpu",
    **settings: Any,
) -> Any:
    """TRPO-warm: ``sb3_contrib.TRPO`` that starts from a clone of the source's SAC policy.

    :param source_model: zip of the SAC that was trained in the source
    :param target: the target
    :param seed: of the run
    :param budget: target steps, a multiple of ``n_steps``; by default 2048, for small budgets a quarter
    :param states: of the source, raw, (n, observation_dim)
    :param device: to learn on
    :param settings: arguments of TRPO
    :raises ValueError: for a budget that is no multiple of ``n_steps``: TRPO would overspend it
    """
    from sb3_contrib import TRPO  # an extra

    teacher = SAC.load(source_model, device=device)
    n_steps = trpo_steps(budget, settings.pop("n_steps", None))
    defaults = {
        "gamma": teacher.gamma,
        "batch_size": rollout_length(n_steps, 128),
        "policy_kwargs": clone_kwargs(teacher),
    }
    model = TRPO(SquashedMeanPolicy, target, n_steps=n_steps, seed=seed, device=device, **{**defaults, **settings})
    clone(model.policy, teacher, _as_seen(states, model))
    return model


# ---------------------------------------------------------------------- identify, then retrain


def unfitted_source(source: VecEnv, declared: Sequence[str], dynamics_kwargs: dict[str, Any] | None = None) -> Dynamics:
    """The source simulator before its declared numbers are fitted; parameters as of :func:`identified_source`.

    :raises ValueError: a source that is no simulator, names that it does not have, wrong arguments
    """
    # The fit is no curriculum here: it may go all the way at once.
    config = dynamics_config("physical", source, {"max_step": 0.1, **(dynamics_kwargs or {})}, declared)
    observation_space, action_space = source.observation_space, source.action_space
    assert isinstance(observation_space, spaces.Box)  # dynamics_config would have refused the source
    assert isinstance(action_space, spaces.Box)
    return make_dynamics(config, observation_space, action_space)


def identified_source(
    recorded: ReplayBuffer,
    recorder: SAC,
    source: VecEnv,
    declared: Sequence[str],
    seed: int,
    max_steps: int = 100,
    dynamics_kwargs: dict[str, Any] | None = None,
) -> tuple[VecEnv, dict[str, float]]:
    """The source simulator with its declared numbers fitted to target transitions, once.

    :param recorded: target transitions
    :param recorder: whose actions they hold
    :param source: the source
    :param declared: names of the numbers, as ``dynamics="physical"`` takes them
    :param seed: of the run
    :param max_steps: of the fit
    :param dynamics_kwargs: further arguments of the physical model
    :return: environments to train in, and what was found
    """
    dynamics = unfitted_source(source, declared, dynamics_kwargs)
    dynamics.seed(seed)
    dynamics.fit(as_transitions(chronological(recorded), recorder.policy, recorder.device), max_steps=max_steps)
    world = make_rollouts(source, dynamics, "source", 1)
    assert isinstance(world, EpisodeSource)  # physical models are rolled out in whole episodes
    return world.env, dynamics.describe()
