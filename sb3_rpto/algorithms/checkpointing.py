"""What a checkpoint holds beyond SB3's zip, so that resuming equals not having stopped.

:func:`capture` takes where both worlds and the random streams stand, :func:`resume` and its siblings put them back.
"""

from __future__ import annotations

import pickle
import random
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_rpto.algorithms import model_zip
from sb3_rpto.algorithms.argument_ranges import check_given
from sb3_rpto.algorithms.interfaces import TwoEnvAgent
from sb3_rpto.algorithms.normalisation import normalises
from sb3_rpto.algorithms.target import OnlineTarget
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.effects.names import near
from sb3_rpto.envs.env_snapshot import reseed, restore_state, restore_statistics, save_state, save_statistics

#: The target's random stream is the seed plus this, so that both worlds never draw the same numbers.
TARGET_SEED_OFFSET = 10_000
#: What a VecNormalize keeps of the last step as it was.
RAW = ("old_obs", "old_reward")
#: Arguments that the saved dynamics, networks and buffers were made by.
FIXED = frozenset(
    {
        *("dynamics", "dynamics_kwargs", "declared", "close_loop", "effects", "preset", "target_data"),
        *("use_sde", "n_steps"),
    }
)


@dataclass(frozen=True)
class ResumePoint:
    """Where the worlds and the random streams of a run stand, as plain data.

    :param algorithm: whose checkpoint it is
    :param streams: of Python, NumPy, torch and the action space
    :param source: the source environment's state; None where it cannot be told
    :param statistics: of the source's VecNormalize; empty where there is none
    :param target: the target environment's state
    :param rollouts: where the episodes in the source stand; None before the first
    :param last_obs: of the target, as the policy sees it
    :param last_original_obs: the same, not normalised; None without a VecNormalize
    :param unstored_step: a target step that was taken and not stored yet
    :param knows_source: whether the policy does
    :param learner: the policy that goes on learning while the best one acts
    :param seed: given to a loaded model, which has not learned since
    :param normalised: whether the policy saw normalised observations; None before it is known
    :param target_size: capacity of the buffer's target side, where the user chose one
    """

    algorithm: str
    streams: dict[str, Any]
    source: dict[str, Any] | None
    statistics: dict[str, Any]
    target: dict[str, Any] | None
    rollouts: dict[str, Any] | None
    last_obs: np.ndarray | None
    last_original_obs: np.ndarray | None
    unstored_step: dict[str, Any] | None
    knows_source: bool
    learner: dict[str, Any] | None
    seed: int | None = None
    normalised: bool | None = None
    target_size: int | None = None

    def without_target(self) -> ResumePoint:
        """Without where that target stood, and a step of it that is not stored."""
        return replace(self, target=None, last_obs=None, unstored_step=None)


def capture(agent: TwoEnvAgent) -> ResumePoint:
    """Where a run stands. A loaded model that has not learned since stands where it was saved first."""
    loaded, normaliser = agent.resume_point, None if agent.env is None else agent.get_vec_normalize_env()
    since: dict[str, Any] = {
        "algorithm": algorithm_of(type(agent)),
        "knows_source": agent.state.knows_source,
        "learner": agent.snapshots.get("learner"),
        "target_size": (agent.replay_buffer_kwargs or {}).get("target_size"),
    }
    if agent.env is not None:
        since["normalised"] = normalises(normaliser)
    if loaded is not None:
        return replace(loaded, seed=agent.new_seed, **since)
    last_obs, last_original_obs = agent.last_target_observation()
    return ResumePoint(
        streams={
            "random": random.getstate(),
            "numpy": np.random.get_state(),
            "torch": th.get_rng_state(),
            "cuda": th.cuda.get_rng_state(agent.device) if agent.device.type == "cuda" else None,
            "actions": agent.action_space.np_random.bit_generator.state,
        },
        source=None if agent.env is None else save_state(agent.env),
        statistics={} if normaliser is None else save_statistics(normaliser),
        target=save_state(agent.target.raw) if isinstance(agent.target, OnlineTarget) else None,
        rollouts=None if agent.rollouts is None else agent.rollouts.get_state(),
        last_obs=last_obs,
        last_original_obs=last_original_obs,
        unstored_step=agent.unstored_step(),
        **since,
    )


def algorithm_of(cls: type) -> str:
    """Whose checkpoints a class goes on with: its own, of a user's class those of what it is derived from."""
    name = next(base.__name__ for base in cls.__mro__ if base.__module__.startswith("sb3_rpto."))
    return "RTO or RPTO" if name in ("RTO", "RPTO") else name


# --- before learn() goes on -------------------------------------------------------------------------------------------


def resume(agent: TwoEnvAgent) -> None:
    """Put the worlds and the random streams back to where the loaded checkpoint left them.

    A world that cannot be put back begins a new episode, and a warning says which.
    """
    point, agent.resume_point = agent.resume_point, None
    if point is None:
        return
    assert agent.env is not None  # learn() has checked both worlds
    target = agent.target if isinstance(agent.target, OnlineTarget) else None
    learned = point.last_obs is not None and target is not None and agent.num_timesteps > target.n_envs
    if learned and agent.replay_buffer.target.size() == 0:
        warnings.warn(
            "the run goes on without its replay buffers, so D_target begins empty: call load_replay_buffer() with what "
            "save_replay_buffer() wrote beside the checkpoint before learn()",
            stacklevel=4,
        )
    restarted = []
    if not _put_source_back(agent, agent.env, point):
        restarted.append("source")
    if target is not None and point.last_obs is not None and not _put_target_back(agent, target, point):
        restarted.append("target")
    if restarted:
        warnings.warn(
            f"the state of the {' and the '.join(restarted)} environment cannot be restored: a new episode begins, "
            "so the resumed run differs from one that never stopped (it can be where the environment is built as it "
            "was when the checkpoint was saved, and is one of gymnasium's or has save_state() and "
            "restore_state(state), see docs/checkpoints.md)",
            stacklevel=4,
        )
    _go_on_drawing(agent, agent.env, point)


def resume_unbegun(agent: TwoEnvAgent) -> None:
    """As :func:`resume`, of a trained model that was saved before its first step here: before all that precedes it."""
    point = agent.resume_point
    online = isinstance(agent.target, OnlineTarget)
    if point is not None and point.last_obs is None and agent.state.knows_source and online:
        resume(agent)


def resume_pretraining(agent: TwoEnvAgent) -> None:
    """Go on with the statistics and random streams of a checkpoint of the source phase, in a new episode."""
    point, agent.resume_point = agent.resume_point, None
    if point is None:
        return
    assert agent.env is not None  # learn() has checked
    if agent.state.pretraining_timesteps > 0 and agent.replay_buffer.source.size() == 0:
        warnings.warn(
            "the source phase goes on without its replay buffers: updates wait for learning_starts new steps; call "
            "load_replay_buffer() with what save_replay_buffer() wrote beside the checkpoint before learn()",
            stacklevel=4,
        )
    _put_env_back(agent.env, agent.get_vec_normalize_env(), point)
    _go_on_drawing(agent, agent.env, point)
    agent.reset_source()


def leave(agent: TwoEnvAgent) -> None:
    """Begin a new run with a loaded model: what the policy needs of its checkpoint stays, and a step not yet stored."""
    point, agent.resume_point = agent.resume_point, None
    if point is None:
        return
    normaliser = agent.get_vec_normalize_env()
    if normaliser is not None:
        restore_statistics(normaliser, point.statistics)
    if isinstance(agent.target, OnlineTarget) and point.unstored_step is not None:
        agent.begin_at(point.last_obs, point.last_original_obs)
        _store_unstored_step(agent, agent.target, point.unstored_step)


def _put_env_back(env: VecEnv, normaliser: VecNormalize | None, point: ResumePoint) -> bool:
    """Restore the source; where its state is unknown, what its VecNormalize has seen all the same, and False."""
    if _put_back(env, point.source):
        return True
    if normaliser is not None:
        restore_statistics(normaliser, point.statistics)
    return False


def _put_source_back(agent: TwoEnvAgent, env: VecEnv, point: ResumePoint) -> bool:
    """Restore the source and its episodes; False where new ones begin."""
    restored = _put_env_back(env, agent.get_vec_normalize_env(), point)
    if not point.rollouts or agent.rollouts is None:  # branches have no episodes
        return restored or point.rollouts == {}
    if restored:
        try:
            agent.rollouts.set_state(point.rollouts)
        except ValueError:  # another number of episodes side by side, or other simulators
            agent.rollouts.begin_anew()
            restored = False
    return restored


def _put_target_back(agent: TwoEnvAgent, target: OnlineTarget, point: ResumePoint) -> bool:
    """Restore the target, and store the step that the checkpoint carries; False where a new episode begins after it."""
    normaliser = target.normaliser
    raw = {} if normaliser is None else {name: getattr(normaliser, name) for name in RAW}
    begun = agent.last_target_observation()
    restored = _put_back(target.raw, point.target)
    target.ledger.begin()
    agent.begin_at(point.last_obs, point.last_original_obs)
    if point.unstored_step is not None:
        _store_unstored_step(agent, target, point.unstored_step)
    if not restored:
        agent.begin_at(*begun)
        if normaliser is not None:
            vars(normaliser).update(raw)
    return restored


def _store_unstored_step(agent: TwoEnvAgent, target: OnlineTarget, step: dict[str, Any]) -> None:
    """Store a step that began at the model's last observation."""
    if target.normaliser is not None:
        vars(target.normaliser).update(step["raw"])
    agent.store_step(step["known"])


def _put_back(env: VecEnv, state: dict[str, Any] | None) -> bool:
    """Restore a world; False, with nothing changed, without a state or with one of a world that is built otherwise."""
    if state is None:
        return False
    try:
        restore_state(env, state)
    except ValueError:
        return False
    return True


def _go_on_drawing(agent: TwoEnvAgent, env: VecEnv, point: ResumePoint) -> None:
    """Draw from the random streams that were saved, or, where a seed was given since, from new ones everywhere."""
    seed = agent.new_seed
    if seed is None:
        _restore_streams(agent, point.streams)
        return
    agent.set_random_seed(seed)  # whatever was drawn since it was given
    reseed(env, seed)
    if agent.target_env is not None:
        reseed(agent.target_env, seed + TARGET_SEED_OFFSET)
    if agent.rollouts is not None:
        agent.rollouts.reseed()


def _restore_streams(agent: TwoEnvAgent, streams: dict[str, Any]) -> None:
    random.setstate(streams["random"])
    np.random.set_state(streams["numpy"])
    th.set_rng_state(streams["torch"])
    if agent.device.type == "cuda" and streams.get("cuda") is not None:  # else it was saved on another kind of device
        th.cuda.set_rng_state(streams["cuda"], agent.device)
    agent.action_space.np_random.bit_generator.state = streams["actions"]


# --- files ------------------------------------------------------------------------------------------------------------


def check_load(name: str, path: Any, args: tuple[Any, ...], kwargs: dict[str, Any], known: set[str]) -> Any:
    """Refuse, before anything is made of it, what ``load()`` cannot take; the zip's file.

    :param name: of the algorithm that loads
    :param path: of the zip
    :param args: as SB3's ``load`` takes them by position
    :param kwargs: likewise by name
    :param known: names of all arguments that it takes
    :raises ValueError: naming the argument, or what the file is instead
    :raises FileNotFoundError: there is no such file
    """
    if args and not isinstance(args[0], str | th.device):
        raise ValueError(f"load() takes {args[0]!r} for the device; pass a target by name, as target_env=")
    fixed = sorted(FIXED & set(kwargs))
    if fixed:
        raise ValueError(
            f"load() does not change {', '.join(fixed)}, which the saved model was made with; begin anew by "
            f"{name}.from_source(...) of the source's SAC"
        )
    for given in kwargs:
        if given not in known:
            raise ValueError(f"load() was given {given!r}, which is no argument; {near(given, known)}")
    check_given({**({"device": args[0]} if args else {}), **kwargs})
    file = model_zip.located(path, "path")
    content = model_zip.look_into(file, "path")
    if "resume_point" not in content:
        misfit = model_zip.misfit_of_sac(content)
        raise ValueError(
            f"{path} was not saved by {name}"
            + (f" ({misfit})" if misfit else "")
            + f"; start from a SAC model by {name}.from_source(path, env, target_env=...)"
        )
    return file


def read_buffer(agent: TwoEnvAgent, path: Any, read: Callable[[], None]) -> None:
    """Let SB3 read both replay buffers; a model keeps its own where they are others'.

    :param path: of the file
    :param read: SB3's, which sets ``agent.replay_buffer``
    :raises ValueError: for the buffer of another algorithm or of other environments
    """
    kept = agent.replay_buffer
    try:
        read()
    except (pickle.UnpicklingError, EOFError, AssertionError) as error:  # SB3 sets it, then asserts that it is one
        agent.replay_buffer = kept
        raise ValueError(f"{path} is no replay buffer; pass what save_replay_buffer() wrote") from error
    if not isinstance(agent.replay_buffer, DualReplayBuffer):
        agent.replay_buffer = kept
        raise ValueError(f"{path} holds one world only; pass it as source_data= of from_source() or as target_data=")
    shapes = [(b.observation_space.shape, b.action_space.shape) for b in (agent.replay_buffer, agent)]
    if shapes[0] != shapes[1]:
        agent.replay_buffer = kept
        raise ValueError(
            f"{path} holds observations and actions of shapes {shapes[0]}, the model's are {shapes[1]}; load the "
            "buffers that were saved beside it"
        )
    asked = (agent.replay_buffer_kwargs or {}).get("target_size")
    if asked is not None:  # load() may have been given another than was saved
        agent.replay_buffer.resize("target", asked)
