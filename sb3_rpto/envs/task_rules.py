"""What is known of a task's reward and termination, as batched torch functions.

A rule that is known need not be learned: the model then predicts states only. Every rule here is either the
environment's own or a function of (observation, action, next observation) that agrees with gymnasium's
implementation of the task; where the observation does not determine it, or an unknown wrapper stands between, there
is none.
"""

from __future__ import annotations

import copy
import re
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

Rule = Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]

# Wrappers that pass observations, actions and rewards on unchanged; by name, since a subprocess tells no more.
HARMLESS_WRAPPERS = {
    *("TimeLimit", "OrderEnforcing", "PassiveEnvChecker", "Autoreset", "Monitor", "RecordEpisodeStatistics"),
    *("RecordVideo", "RenderCollection", "HumanRendering", "DynamicsEnv", "CorrectedEnv", "ShiftedEnv", "StandingEnv"),
    "PatchedTimeLimit",  # rl_zoo3's
}
# The action of the buffer is not the one that the task's reward sees; its termination does not mind.
_CHANGES_ACTIONS = {"ClipAction", "RescaleAction"}
# Methods of a task that neither pay nor end episodes.
_NOT_RULES = {"__init__", "reset", "reset_model", "render", "close", "_get_reset_info"}
HARMLESS_VEC_WRAPPERS = (VecNormalize, VecMonitor, VecCheckNan)  # VecNormalize: buffers hold raw data


class TaskRules(NamedTuple):
    """The known part of a task; each function maps (observations, actions, next_observations) to (n,)."""

    reward_fn: Rule | None  # in the observations' dtype
    termination_fn: Rule | None  # bool


def task_rules(env: gym.Env | VecEnv) -> TaskRules:
    """Find the reward and termination rules of ``env`` (of the first environment of a VecEnv).

    The environment's own ``reward_fn`` and ``termination_fn`` methods come first, then what is known of gymnasium's
    continuous tasks, with the thresholds of this very instance (a shifted environment has its own). A next
    observation that is not finite is terminal under every rule. Rules of known tasks pickle and hold plain numbers
    only; a rule that belongs to the environment pickles if the environment does.

    :param env: an environment or a VecEnv, also one in subprocesses; VecNormalize is looked through
    :return: the rules, None for each that is not known
    """
    inner = env
    while isinstance(inner, VecEnvWrapper):
        if not isinstance(inner, HARMLESS_VEC_WRAPPERS):
            return TaskRules(None, None)
        inner = inner.venv
    view = _View(inner)
    reward, termination = _known_task(view)
    own_termination = view.own_rule("termination_fn")
    if own_termination is not None:
        termination = partial(or_not_finite, own_termination)
    return TaskRules(view.own_rule("reward_fn") or reward, termination)


def changing_wrappers(env: gym.Env | VecEnv) -> set[str]:
    """Names of the wrappers of (the first environment of) ``env`` that may change what goes in or comes out."""
    return _View(env).strange


def misfit(rule: Rule, observation_space: gym.Space, action_space: gym.Space) -> str | None:
    """What a function answers two transitions by, where that is not what a rule does; None for a rule.

    :param rule: to be asked
    :param observation_space: of both worlds, flat
    :param action_space: likewise
    """
    seen, actions = (th.zeros(2, *space.shape) for space in (observation_space, action_space) if space.shape)
    try:
        answer = rule(seen, actions, seen)
    except Exception as error:  # whatever a function of other arguments raises
        return f"{type(error).__name__}: {error}"
    if not isinstance(answer, th.Tensor):
        return type(answer).__name__
    return None if answer.shape == (2,) else f"a tensor of shape {tuple(answer.shape)}"


def env_id(env: VecEnv) -> str | None:
    """Id of the first environment's specification, also of one in a subprocess whose specification does not pickle."""
    if isinstance(env.unwrapped, DummyVecEnv):
        spec = env.get_attr("spec", indices=[0])[0]
        return spec.id if spec else None
    return _View(env).id


class _View:
    """Reads one environment, here or in a subprocess, without ever sending the environment itself."""

    def __init__(self, env: gym.Env | VecEnv) -> None:
        self.vec_env = env if isinstance(env, VecEnv) else None
        #: None where the environment lives in another process
        self.env: gym.Env | None = env if isinstance(env, gym.Env) else None
        if isinstance(env, DummyVecEnv):
            self.env = env.envs[0]
        # For example <TimeLimit<OrderEnforcing<HopperEnv<Hopper-v5>>>>, or <HopperEnv instance> without a spec.
        text = self._call("__str__")
        parts = re.fullmatch(r"((?:<\w+)*)<(\w+)(?:<([^<>]+)>| instance)>+", text)
        self.understood = parts is not None
        self.wrappers = set(re.findall(r"\w+", parts[1])) if parts else set()
        self.id: str | None = parts[3] if parts else None
        self.kind: str | None = parts[2] if parts else None

    @property
    def strange(self) -> set[str]:
        """Names of the wrappers that may change observations, actions, rewards or terminations."""
        return self.wrappers - HARMLESS_WRAPPERS if self.understood else {"of another kind"}

    def _call(self, method: str) -> Any:
        if self.env is not None:
            return self.env.get_wrapper_attr(method)()
        return self.vec_env.env_method(method, indices=0)[0]  # type: ignore[union-attr]

    def has(self, name: str) -> bool:
        """Whether the environment or a wrapper has the attribute."""
        if self.env is not None:
            return self.env.has_wrapper_attr(name)
        return self.vec_env.has_attr(name)  # type: ignore[union-attr]

    def __getitem__(self, name: str) -> Any:
        if not self.has(name):  # asked for an attribute that it lacks, a subprocess would die
            raise KeyError(name)
        if self.env is not None:
            return self.env.get_wrapper_attr(name)
        return self.vec_env.get_attr(name, indices=0)[0]  # type: ignore[union-attr]

    @property
    def sensed(self) -> bool:
        """Whether the observation is not the state's, but what effects in the sensors make of it."""
        return self.has("alters_observations") and self["alters_observations"]

    def own_rule(self, name: str) -> Rule | None:
        """The environment's own rule, unless a wrapper may change what goes into or comes out of it."""
        if not self.has(name) or self.sensed or self._changing(name):
            return None
        env = self.env or self._twin()
        rule = env.get_wrapper_attr(name) if env is not None and env.has_wrapper_attr(name) else None
        if env is None or not callable(rule):
            return None
        found = misfit(rule, env.observation_space, env.action_space)
        if found is not None:
            warnings.warn(
                f"{name} of {env} is not taken for the task's rule: it answers two observations, actions and next "
                f"observations by {found}, not by a tensor of shape (2,)",
                stacklevel=2,
            )
        return rule if found is None else None

    def _changing(self, name: str) -> bool:
        """Whether a wrapper outside of what has the rule may change what the rule is about; an unknown one may."""
        if self.env is None:
            return bool(self.strange)
        layer = self.env
        while isinstance(layer, gym.Wrapper) and not hasattr(layer, name):
            steps = type(layer).step is not gym.Wrapper.step and type(layer).__name__ not in HARMLESS_WRAPPERS
            if steps and not (name == "termination_fn" and isinstance(layer, gym.RewardWrapper)):
                return True
            layer = layer.env
        return False

    def _twin(self) -> gym.Env | None:
        """An environment made as the one in the subprocess was; a bound method cannot be sent without its env."""
        if self.id not in gym.registry or not isinstance(gym.spec(self.id).entry_point, str):
            return None
        spec = copy.deepcopy(self["spec"])
        spec.additional_wrappers = ()
        return gym.make(spec)


def _known_task(view: _View) -> TaskRules:
    """The rules of a gymnasium task, or none."""
    find = _TASKS.get(_task_name(view) or "")
    known = view.understood and view.wrappers <= (HARMLESS_WRAPPERS | _CHANGES_ACTIONS)
    if find is None or not known or view.sensed:
        return TaskRules(None, None)
    try:
        rules = find(view)
    except KeyError:  # an older or another implementation than the one known here
        return TaskRules(None, None)
    return rules._replace(reward_fn=None) if view.wrappers & _CHANGES_ACTIONS else rules


def _task_name(view: _View) -> str | None:
    """The task's gymnasium name: by class for gymnasium's and our own environments, in a subprocess by id and name."""
    if view.env is not None:
        family = type(view.env.unwrapped).__mro__
        for i, cls in enumerate(family):
            if cls.__module__.startswith(("gymnasium.envs.mujoco.", "gymnasium.envs.classic_control.")):
                name = cls.__name__.removesuffix("Env")
                heirs = [heir for heir in family[:i] if not heir.__module__.startswith(("gymnasium.", "sb3_rpto."))]
                if any(_changes_task(heir, cls) for heir in heirs):
                    return None
                return "MountainCarContinuous" if name == "Continuous_MountainCar" else name
        if not family[0].__module__.startswith(("gymnasium.", "sb3_rpto.")):
            return None  # somebody's own task, whatever it is called
    # Ours may be targets: rpto/Hopper-gravity-x0.5-v0.
    ours = re.fullmatch(r"rpto/(\w+)(?:-[\w.-]+)?-v\d+", view.id or "")
    task = ours or re.fullmatch(r"(\w+)-v\d+", view.id or "")
    if task is None or (ours is None and view.kind not in (f"{task[1]}Env", "Continuous_MountainCarEnv")):
        return None
    return task[1]


def _changes_task(heir: type, task: type) -> bool:
    """Whether a class has a method of its own in the place of one that a known task's rules are about."""
    methods = {name for name, value in vars(task).items() if callable(value) or isinstance(value, property)}
    return bool((methods - _NOT_RULES) & vars(heir).keys())


# --- terminations -----------------------------------------------------------------------------------------------


def not_finite(observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor) -> th.Tensor:
    """The task never ends, but a state that is not finite has no successor."""
    return ~th.isfinite(next_observations).all(dim=-1)


def or_not_finite(rule: Rule, observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor) -> th.Tensor:
    """``rule``, and a next observation that is not finite is terminal too."""
    ended = rule(observations, actions, next_observations).bool().reshape(len(next_observations))
    return ended | not_finite(observations, actions, next_observations)


def outside(
    observations: th.Tensor,
    actions: th.Tensor,
    next_observations: th.Tensor,
    *,
    ranges: tuple[tuple[int, int | None, float, float], ...],
    closed: bool = False,
) -> th.Tensor:
    """Terminal where a coordinate has left its range.

    :param ranges: (first column, last column + 1, low, high) each
    :param closed: whether the bounds themselves are still healthy
    """
    ended = not_finite(observations, actions, next_observations)
    for start, stop, low, high in ranges:
        values = next_observations[:, start:stop]
        healthy = (values >= low) & (values <= high) if closed else (values > low) & (values < high)
        ended = ended | ~healthy.all(dim=-1)
    return ended


def _healthy(view: _View, names: tuple[str, ...], hidden: int = 1, closed: bool = False) -> TaskRules:
    """A walker: height, then the pitch angle, then all that follows the height.

    ``healthy_state_range`` bounds the true velocities, which Hopper's observation clips at 10: a range beyond that
    (100 by default) is checked as far as the observation shows it.

    :param names: the ranges that the task has
    :param hidden: position coordinates that precede the height and that the observation leaves out by default
    """
    first = 0 if view["_exclude_current_positions_from_observation"] else hidden
    columns = {"z": (first, first + 1), "angle": (first + 1, first + 2), "state": (first + 1, None)}
    if not view["_terminate_when_unhealthy"]:
        return TaskRules(None, not_finite)
    bounds = {name: view[f"_healthy_{name}_range"] for name in names}
    ranges = tuple((*columns[name], float(low), float(high)) for name, (low, high) in bounds.items())
    return TaskRules(None, partial(outside, ranges=ranges, closed=closed))


def _endless(view: _View) -> TaskRules:
    return TaskRules(None, not_finite)


# --- tasks whose reward the observation determines ----------------------------------------------------------------


def _pendulum(view: _View) -> TaskRules:
    return TaskRules(partial(pendulum_reward, max_torque=float(view["max_torque"])), not_finite)


def pendulum_reward(
    observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor, *, max_torque: float
) -> th.Tensor:
    """Minus the squared angle, speed and torque at the beginning of the step (Pendulum-v1)."""
    angle = th.atan2(observations[:, 1], observations[:, 0])
    torque = actions[:, 0].clamp(-max_torque, max_torque)
    return -(angle**2 + 0.1 * observations[:, 2] ** 2 + 0.001 * torque**2)


def _mountain_car(view: _View) -> TaskRules:
    # The environment compares in float32.
    goal: dict[str, Any] = {name: float(np.float32(view[f"goal_{name}"])) for name in ("position", "velocity")}
    return TaskRules(partial(mountain_car_reward, **goal), partial(mountain_car_goal, **goal))


def mountain_car_goal(
    observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor, *, position: float, velocity: float
) -> th.Tensor:
    """Terminal on the hill (MountainCarContinuous-v0)."""
    reached = (next_observations[:, 0] >= position) & (next_observations[:, 1] >= velocity)
    return reached | not_finite(observations, actions, next_observations)


def mountain_car_reward(
    observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor, *, position: float, velocity: float
) -> th.Tensor:
    """100 on the hill, minus the squared action (MountainCarContinuous-v0)."""
    reached = mountain_car_goal(observations, actions, next_observations, position=position, velocity=velocity)
    return 100.0 * reached.to(next_observations.dtype) - 0.1 * actions[:, 0] ** 2


def _inverted_pendulum(view: _View) -> TaskRules:
    termination = partial(outside, ranges=((1, 2, -0.2, 0.2),), closed=True)
    # Up to v4, which lacks this attribute, the last step was rewarded too.
    reward = partial(alive_reward, termination=termination) if view.has("_reset_noise_scale") else None
    return TaskRules(reward, termination)


def alive_reward(
    observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor, *, termination: Rule
) -> th.Tensor:
    """1 for a step that does not end the episode."""
    return (~termination(observations, actions, next_observations)).to(next_observations.dtype)


def _inverted_double_pendulum(view: _View) -> TaskRules:
    """The tip's place follows from the joint angles.

    The simulation rewards the place in its last integration stage, which differs by about 1e-4, and joint speeds
    that the observation clips at 10 rad/s, which healthy poles do not reach.
    """
    model = view["model"]
    if (model.nq, model.nsite, model.nbody) != (3, 1, 4):
        return TaskRules(None, None)
    base = model.body_pos[1] + model.body_pos[2]
    links = tuple((float(offset[0]), float(offset[2])) for offset in (base, model.body_pos[3], model.site_pos[0]))
    # Another kinematic chain than cart, pole, pole (turned bodies, moved axes) fails this comparison.
    data = mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(-1, 1, size=(4, 3)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        observation = th.as_tensor(np.concatenate([q[:1], np.sin(q[1:]), np.cos(q[1:])]))[None]
        if not np.allclose(th.stack(_tip(observation, links)).ravel(), data.site_xpos[0, [0, 2]], atol=1e-9):
            return TaskRules(None, None)
    termination = partial(tip_low, links=links)
    reward = partial(double_pendulum_reward, links=links, healthy_reward=float(view["_healthy_reward"]))
    return TaskRules(reward, termination)


_Links = tuple[tuple[float, float], ...]  # (x, z) of the first joint at the origin and of each link's end


def _tip(observations: th.Tensor, links: _Links) -> tuple[th.Tensor, th.Tensor]:
    """The tip of the second pole, (x, height), from [x, sin a, sin b, cos a, cos b, ...]."""
    sin_a, sin_b, cos_a, cos_b = observations[:, 1:5].unbind(dim=-1)
    x, z = observations[:, 0] + links[0][0], th.full_like(sin_a, links[0][1])
    turns = (sin_a, cos_a), (sin_a * cos_b + cos_a * sin_b, cos_a * cos_b - sin_a * sin_b)
    for (sin, cos), (along, up) in zip(turns, links[1:]):
        x, z = x + along * cos + up * sin, z + up * cos - along * sin
    return x, z


def tip_low(observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor, *, links: _Links) -> th.Tensor:
    """Terminal when the tip is at height 1 or below (InvertedDoublePendulum)."""
    return (_tip(next_observations, links)[1] <= 1) | not_finite(observations, actions, next_observations)


def double_pendulum_reward(
    observations: th.Tensor,
    actions: th.Tensor,
    next_observations: th.Tensor,
    *,
    links: _Links,
    healthy_reward: float,
) -> th.Tensor:
    """Alive bonus minus the tip's distance and the joint speeds, which are observed up to 10 rad/s (v5)."""
    x, height = _tip(next_observations, links)
    alive = ~tip_low(observations, actions, next_observations, links=links)
    speeds = 1e-3 * next_observations[:, 6] ** 2 + 5e-3 * next_observations[:, 7] ** 2
    return healthy_reward * alive.to(x.dtype) - 0.01 * x**2 - (height - 2) ** 2 - speeds


def _reacher(view: _View) -> TaskRules:

    model = view["model"]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    # All joints move in the plane, so that the height difference (0 by default) is the model's constant.
    height = data.body("fingertip").xpos[2] - data.body("target").xpos[2]
    near, control = float(view["_reward_dist_weight"]), float(view["_reward_control_weight"])
    return TaskRules(partial(reacher_reward, height=float(height), near=near, control=control), not_finite)


def reacher_reward(
    observations: th.Tensor,
    actions: th.Tensor,
    next_observations: th.Tensor,
    *,
    height: float,
    near: float,
    control: float,
) -> th.Tensor:
    """Minus the distance of fingertip and target and the squared action (Reacher-v5)."""
    distance = (next_observations[:, 8:10].square().sum(dim=-1) + height**2).sqrt()
    return -near * distance - control * actions.square().sum(dim=-1)


def _pusher(view: _View) -> TaskRules:
    near, far, control = (float(view[f"_reward_{name}_weight"]) for name in ("near", "dist", "control"))
    return TaskRules(partial(pusher_reward, near=near, far=far, control=control), not_finite)


def pusher_reward(
    observations: th.Tensor,
    actions: th.Tensor,
    next_observations: th.Tensor,
    *,
    near: float,
    far: float,
    control: float,
) -> th.Tensor:
    """Minus the distances arm to object and object to goal, and the squared action (Pusher-v5)."""
    arm, thing, goal = next_observations[:, 14:17], next_observations[:, 17:20], next_observations[:, 20:23]
    distance = near * (thing - arm).norm(dim=-1) + far * (thing - goal).norm(dim=-1)
    return -distance - control * actions.square().sum(dim=-1)


_TASKS: dict[str, Callable[[_View], TaskRules]] = {
    "Ant": partial(_healthy, names=("z",), hidden=2, closed=True),
    "HalfCheetah": _endless,
    "Hopper": partial(_healthy, names=("z", "angle", "state")),
    "Humanoid": partial(_healthy, names=("z",), hidden=2),
    "HumanoidStandup": _endless,
    "InvertedDoublePendulum": _inverted_double_pendulum,
    "InvertedPendulum": _inverted_pendulum,
    "MountainCarContinuous": _mountain_car,
    "Pendulum": _pendulum,
    "Pusher": _pusher,
    "Reacher": _reacher,
    "Swimmer": _endless,
    "Walker2d": partial(_healthy, names=("z", "angle")),
}
