"""Does a policy from a zip earn in its source what the zip remembers of its training?"""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_rpto.algorithms.normalisation import PASS, normalises
from sb3_rpto.envs.env_copy import must_copy
from sb3_rpto.envs.observations import layers, single_env

#: The newest episodes that a zip remembers are of about its policy; fewer tell nothing.
RECENT, FEWEST = 10, 5
#: Episodes that the policy plays, and steps in all of them.
EPISODES, STEPS = 5, 5_000
#: It earns clearly less below so many standard deviations of the remembered returns.
BELOW = 2.0
#: Of what training has gained over random actions it has lost more than this share.
LOST = 0.5
#: Episodes that were cut off below this share of the remembered length cannot be compared.
CUT = 0.9
#: Of the resets of the copies.
SEED = 40_000


def doubt_returns(sac: SAC, env: GymEnv) -> bool:
    """Warn where a policy earns clearly less in the source than its zip remembers; whether that was said.

    It plays a few episodes in copies of the source, as its mean and then as it explored, and random actions play some
    where it earns less. It must be clearly below by both, and have lost most of what its training had gained. Nothing
    is said where the zip remembers few episodes, the source cannot be copied or its episodes are of another length. No
    step is counted, and neither the source nor any random stream moves.

    :param sac: the source model
    :param env: the source, in the VecNormalize by which the policy is to see
    """
    remembered = list(sac.ep_info_buffer or ())[-RECENT:]
    if len(remembered) < FEWEST:
        return False
    returns, lengths = (np.array([float(episode[name]) for episode in remembered]) for name in ("r", "l"))
    normaliser = unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None
    try:
        with _undisturbed(sac.device):
            earned = _lost(sac, env, normaliser, returns, lengths)
    except Exception:  # whatever a user's environment raises in a copy: nothing is claimed then
        return False
    if earned is None:
        return False
    how = (
        "raw observations, or some normalised by other statistics than those of env's VecNormalize?"
        if normalises(normaliser)
        else "observations normalised by VecNormalize?"
    )
    warnings.warn(
        f"source_model earns {earned:.4g} in env, where its zip remembers {returns.mean():.4g} (means of a few "
        f"episodes now and the last {len(returns)} of its training): did it see {how} Pass {PASS}, "
        "or a raw env; else env is not the source that it was trained in",
        stacklevel=3,
    )
    return True


def _lost(
    sac: SAC, env: GymEnv, normaliser: VecNormalize | None, returns: np.ndarray, lengths: np.ndarray
) -> float | None:
    """What the policy earns, where that is clearly less than it did; None where it is not, or cannot be compared."""
    longest = int(lengths.max())
    count = min(EPISODES, STEPS // longest)
    first = single_env(env)
    if count < 1 or first.observation_space.shape != sac.observation_space.shape:
        return None
    copies = [must_copy(first) for _ in range(count)]

    def act(deterministic: bool) -> Callable[[np.ndarray], np.ndarray]:
        def policy(seen: np.ndarray) -> np.ndarray:
            shown = seen if normaliser is None else normaliser.normalize_obs(seen)
            return sac.policy.predict(shown, deterministic=deterministic)[0]

        return policy

    best, spread = -np.inf, float(returns.std(ddof=1))
    for deterministic in (True, False):
        earned = _play(copies, act(deterministic), longest, CUT * float(lengths.mean()))
        if earned is None or earned.mean() >= returns.mean() - BELOW * spread:
            return None
        best = max(best, float(earned.mean()))
    chance, space = np.random.default_rng(SEED), sac.action_space
    assert isinstance(space, spaces.Box)  # SAC has no other
    by_chance = _play(copies, lambda seen: chance.uniform(space.low, space.high, (len(seen), *space.shape)), longest, 0)
    if by_chance is None:
        return None
    gain = float(returns.mean() - by_chance.mean())
    learned = gain > max(spread, float(by_chance.std()))
    return best if learned and best < returns.mean() - LOST * gain else None


def _play(
    copies: Sequence[gym.Env], act: Callable[[np.ndarray], np.ndarray], longest: int, shortest: float
) -> np.ndarray | None:
    """Returns of an episode in each copy, of its first ``longest`` steps; as SB3's Monitor counts where there is one.

    :return: None where one was cut off by a limit before ``shortest`` steps
    """
    seen = np.array([np.asarray(copy.reset(seed=SEED + i)[0]) for i, copy in enumerate(copies)])
    monitors = [next((layer for layer in layers(copy) if isinstance(layer, Monitor)), None) for copy in copies]
    totals, running = np.zeros(len(copies)), np.ones(len(copies), dtype=bool)
    for step in range(1, longest + 1):
        actions = act(seen)
        for i in map(int, np.flatnonzero(running)):
            seen[i], reward, terminated, truncated, _ = copies[i].step(actions[i].astype(np.float32))
            monitor = monitors[i]
            totals[i] += float(reward) if monitor is None else monitor.rewards[-1]
            if truncated and not terminated and step < shortest:
                return None
            running[i] = not (terminated or truncated)
        if not running.any():
            break
    return totals


@contextmanager
def _undisturbed(device: th.device) -> Iterator[None]:
    """Inside, random numbers may be drawn and warnings raised that nobody else sees."""
    python, numpy = random.getstate(), np.random.get_state()
    cuda: list[Any] = [device] if device.type == "cuda" else []
    try:
        with th.random.fork_rng(devices=cuda), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)
