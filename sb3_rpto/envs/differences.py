"""The null-shift check: whether a target differs from its source, and in what."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_rpto.effects.model_numbers import differing, numbers
from sb3_rpto.effects.names import object_names
from sb3_rpto.effects.wrapper import beyond_model
from sb3_rpto.envs.cartpole import ContinuousCartPoleEnv
from sb3_rpto.envs.env_copy import EnvSource, make_env, must_copy

#: What tasks keep beside the model that decides on resets and ends.
_TASK = ("init_qpos", "init_qvel", "_healthy_z_range", "_healthy_angle_range", "_healthy_state_range")
#: Actions are held for so many steps: joints then reach the ends of their ranges.
HELD = 10


@dataclass(frozen=True)
class Difference:
    """What distinguishes a target from its source; true where an agent could tell.

    :param numbers: by field of the compiled model (those that follow from others left out), the objects that differ;
        constants of the cart-pole
    :param task: attributes of the task that differ: start state, healthy ranges
    :param effects: effects in one of them that are no numbers of the model
    :param start: whether a reset with the same seed differs
    :param step: the first step from the same state under the same actions with another answer; None: there is none
    :param steps: how many were compared
    """

    numbers: dict[str, tuple[str, ...]]
    task: tuple[str, ...]
    effects: tuple[str, ...]
    start: bool
    step: int | None
    steps: int

    def __bool__(self) -> bool:
        return self.start or self.step is not None

    def __str__(self) -> str:
        lines = [
            f"{field}: {', '.join(objects)}" if objects else field for field, objects in sorted(self.numbers.items())
        ]
        lines += [f"task: {', '.join(self.task)}"] if self.task else []
        lines += [f"effects: {', '.join(self.effects)}"] if self.effects else []
        lines += ["the start differs"] if self.start else []
        moves = f"step {self.step} differs" if self.step is not None else f"no step of {self.steps:,} differs"
        return "\n".join([*lines, f"{moves} from the same state under the same actions"])


def differs(source: EnvSource, target: EnvSource, *, seed: int = 0, steps: int = 2_000) -> Difference:
    """Compare compiled models, and trajectories from the same states under the same actions.

    Random actions, each held for :data:`HELD` steps, go to copies of both until the first answer (observation, reward
    or termination) that differs by a bit; after an episode that ended in both, another begins. Where a MuJoCo task
    starts otherwise, which is told apart, the target is put where the source starts.

    :param source: an environment, its id, or a function that makes it
    :param target: likewise
    :param seed: of the resets and the actions
    :param steps: compared at most
    :raises ValueError: spaces that differ, or an environment that cannot be copied
    """
    one, other = must_copy(make_env(source, "source")), must_copy(make_env(target, "target"))
    space = one.action_space
    if space != other.action_space or one.observation_space != other.observation_space:
        raise ValueError("source and target have different spaces, so there are no same actions")
    start, step = _first_difference(one, other, seed, steps)
    mine, theirs = _task(one), _task(other)
    task = tuple(name for name in _TASK if not _equal(mine.get(name), theirs.get(name)))
    effects = tuple(sorted(_effects(one) ^ _effects(other)))
    return Difference(_numbers(one.unwrapped, other.unwrapped), task, effects, start, step, steps)


def _first_difference(one: gym.Env, other: gym.Env, seed: int, steps: int) -> tuple[bool, int | None]:
    """Whether a reset differs, and the first step that does."""
    space: Any = one.action_space
    rng = np.random.default_rng(seed)
    begun = _begin(one, other, seed)
    for step in range(1, steps + 1):
        if step % HELD == 1:
            action = rng.uniform(space.low, space.high).astype(space.dtype)
        answers = [env.step(action)[:4] for env in (one, other)]
        if not all(map(_equal, *answers)):
            return begun, step
        if answers[0][2] or answers[0][3]:
            begun |= _begin(one, other, None)
    return begun, None


def _begin(one: gym.Env, other: gym.Env, seed: int | None) -> bool:
    """Whether a reset differs; both begin in the same state afterwards."""
    if _equal(one.reset(seed=seed)[0], other.reset(seed=seed)[0]):
        return False
    mine, theirs = one.unwrapped, other.unwrapped
    if hasattr(mine, "data") and hasattr(theirs, "data") and mine.data.qpos.shape == theirs.data.qpos.shape:
        theirs.set_state(mine.data.qpos, mine.data.qvel)  # type: ignore[attr-defined]
    return True


def _equal(one: Any, other: Any) -> bool:
    return (one is None) == (other is None) and (one is None or np.array_equal(one, other, equal_nan=True))


def _task(env: gym.Env) -> dict[str, Any]:
    return {name: getattr(env.unwrapped, name) for name in _TASK if hasattr(env.unwrapped, name)}


def _effects(env: gym.Env) -> set[str]:
    if not hasattr(env.unwrapped, "model"):
        return set()
    return set(beyond_model(env))


def _numbers(one: Any, other: Any) -> dict[str, tuple[str, ...]]:
    """What differs in the compiled models, or in the cart-poles' constants."""
    if isinstance(one, ContinuousCartPoleEnv):
        mine, theirs = asdict(one.parameters), asdict(other.parameters)
        return {name: () for name in mine if mine[name] != theirs[name]}
    if not hasattr(one, "model"):
        return {}
    mine, theirs = numbers(one.model), numbers(other.model)
    return {
        name: _objects(one.model, name, mine[name] != theirs[name])
        if np.shape(mine[name]) == np.shape(theirs[name])
        else ()
        for name in differing(one.model, other.model)
    }


def _objects(model: Any, name: str, unequal: np.ndarray) -> tuple[str, ...]:
    """Names of the objects whose rows of a field are unequal; none for a field of the whole model."""
    kind = {"body": "body", "geom": "geom", "jnt": "joint", "dof": "joint", "actuator": "actuator"}.get(
        name.partition("_")[0]
    )
    if kind is None:
        return ()
    rows = np.flatnonzero(unequal.reshape(len(unequal), -1).any(axis=1))
    if name.startswith("dof"):
        rows = np.unique(model.dof_jntid[rows])
    names = object_names(model, kind)
    return tuple(names[i] for i in rows) if len(unequal) <= len(names) or kind == "joint" else ()
