"""D_source when the simulator was corrected: whether it is another's, and its transitions as they are there now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_rpto.algorithms.looping import Looping
from sb3_rpto.algorithms.recorded import observe
from sb3_rpto.algorithms.source import copied
from sb3_rpto.buffers import chronological
from sb3_rpto.dynamics.onestep import remembered
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects import Effect
from sb3_rpto.effects.stance import StandingEnv, lifted

#: Another simulator made D_source where the present one errs by so much on the oldest so many of its transitions.
OTHER, OLDEST = 0.02, 500
#: Source steps that are taken anew.
FILL = 1_000
#: Most transitions that are simulated again, the newest.
MOST = 50_000
#: How well the state must account for the observation, as a share of the latter and at least.
SHOWN = 1e-3
#: A longer body may not be in something: by how much deeper than before, as a share of the model's extent.
DEEPER = 0.01


def outdated(model: Looping, dynamics: PhysicalDynamics) -> bool:
    """Whether D_source holds what another simulator than the present one produced.

    Where the oldest transitions were overwritten, the next ones have lost the commands that late motors still act on.
    """
    side, lead = model.replay_buffer.source, 0
    if side.full:
        lead = min(remembered(dynamics.model, dynamics.frame_skip) * int(model.source_steps), side.size() // 2)
    return dynamics.error(model.transitions("source").take(slice(lead + OLDEST)), lead=lead) > OTHER


def renew_source(model: Looping, dynamics: PhysicalDynamics, made_by: Sequence[Effect] = ()) -> None:
    """Simulate again what another simulator produced, and take the first :data:`FILL` steps in the present one.

    They begin with episodes: of one under way the commands before it are dropped too, which late motors still act on.

    :param made_by: effects of the simulator that made D_source so far
    """
    assert model._source_world is not None
    again = relabelled(model, dynamics, made_by)
    count = len(again["actions"])
    model.replay_buffer.source.reset()
    if count:
        model.replay_buffer.append("source", dones=again.pop("terminations"), **again)
    model._source_world.begin_anew()
    model.source_timesteps += count + model._source_world.interact(model, FILL)


def relabelled(model: Looping, dynamics: PhysicalDynamics, made_by: Sequence[Effect] = ()) -> dict[str, np.ndarray]:
    """Transitions from the states of D_source under its actions, as the fitted simulator has them.

    What the policy learned from in another simulator has visited more than a policy that begins to learn in this one,
    whose critic would be lost with nothing else to learn from. A walker is as far from the floor as it was. Left
    out are states that an observation does not tell, and those in which the corrected body would be in something.

    :param model: with D_source
    :param dynamics: the simulator, its effects with their values
    :param made_by: effects of the simulator that made D_source, beside the source itself
    :return: as :func:`sb3_rpto.buffers.chronological`, oldest first; empty where no step ends an episode, so that a
        policy that is lost for a while cannot fall, and its own states are worth more; where a step depends on more
        than the state, as with late motors, or an observation shows something else
    """
    assert model.env is not None
    arrays = {name: values[-MOST:] for name, values in chronological(model.replay_buffer.source).items()}
    before, after = (StandingEnv(copied(model.env), effects) for effects in (made_by, dynamics.effects()))
    actions = model.policy.unscale_action(arrays["actions"])
    none = not arrays["terminations"].any() or _more_than_state(after)
    rows = [] if none else _recovered(dynamics, arrays["observations"])
    before.reset(seed=0)
    earlier: Any = before.unwrapped
    base: Any = after.unwrapped
    found: dict[str, list[Any]] = {name: [] for name in arrays}
    for i, qpos, qvel in rows:
        observation, action = arrays["observations"][i], actions[i]
        shown = observe(before, qpos, qvel, action)
        if not np.allclose(shown, observation, SHOWN, SHOWN):
            continue  # a goal, say, that is not of the state
        after.reset()
        start = observe(after, lifted(qpos, earlier.model, base.model), qvel, action)
        if _depth(after) > _depth(before) + DEEPER * base.model.stat.extent:
            continue
        then, reward, terminated, _, _ = after.step(action)
        step = {"observations": start, "next_observations": then, "actions": arrays["actions"][i]}
        step |= {"rewards": reward, "terminations": terminated}
        if all(np.isfinite(np.asarray(value, dtype=float)).all() for value in step.values()):
            for name, value in step.items():
                found[name].append(value)
    return {
        name: np.array(found[name], dtype=arrays[name].dtype).reshape(-1, *arrays[name].shape[1:]) for name in found
    }


def _more_than_state(env: StandingEnv) -> bool:
    """Whether observations show more than the state, or steps depend on more: what commands came before."""
    env.reset(seed=0)
    env.step(env.action_space.sample())  # what remembers has something to remember now
    return env.alters_observations or env.remembers


def _recovered(dynamics: PhysicalDynamics, observations: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Rows whose states are known but for coordinates that no observation holds, which are as in the model."""
    if not len(observations):
        return []
    states = dynamics.recover(observations.astype(float))
    parts, whole = [], np.ones(len(observations), dtype=bool)
    for values, known, nominal in (
        (states.qpos, states.known_qpos, dynamics.model.qpos0),
        (states.qvel, states.known_qvel, np.zeros(dynamics.model.nv)),
    ):
        seen = known.any(axis=0)
        whole &= known[:, seen].all(axis=1)
        parts.append(np.where(seen, values, nominal))
    return [(int(i), parts[0][i], parts[1][i]) for i in np.flatnonzero(whole)]


def _depth(env: gym.Env) -> float:
    """How deep the deepest contact is, m."""
    base: Any = env.unwrapped
    return float(max(0.0, -base.data.contact.dist.min(initial=0.0)))
