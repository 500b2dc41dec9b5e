"""Where the worlds and the random streams stand: taken into a checkpoint, and put back from one."""

from __future__ import annotations

import random
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_rpto.algorithms.target import find_ledger
from sb3_rpto.algorithms.two_env_sac import STEP, TARGET_SEED_OFFSET
from sb3_rpto.envs.env_snapshot import reseed, restore_state, restore_statistics, save_state, save_statistics

if TYPE_CHECKING:
    from sb3_rpto.algorithms.checkpointing import Resumable

#: What a VecNormalize keeps of the last step as it was.
RAW = ("old_obs", "old_reward")


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
