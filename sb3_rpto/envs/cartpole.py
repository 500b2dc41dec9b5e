"""The cart-pole with a continuous force: one physics for the environment and for the trainable model of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.classic_control.utils import maybe_parse_reset_bounds

T = TypeVar("T", float, th.Tensor)


@dataclass(frozen=True)
class CartPoleParameters:
    """Every constant of the cart-pole, in SI units; the defaults are those of gymnasium's CartPole-v1.

    :param gravity: acceleration of gravity (m/s², > 0)
    :param cart_mass: mass of the cart (kg, > 0)
    :param pole_mass: mass of the pole, uniform along its length (kg, > 0)
    :param pole_length: full length of the pole (m, > 0); gymnasium's ``length`` is half of it
    :param force_scale: force on the cart at action 1 (N, > 0)
    :param cart_friction: viscous friction between cart and track (N·s/m, >= 0)
    :param pole_friction: viscous friction in the pole's hinge (N·m·s/rad, >= 0)
    :param dt: time between two steps (s, > 0)
    :param x_threshold: distance from the centre beyond which an episode terminates (m, > 0)
    :param theta_threshold: angle from upright beyond which an episode terminates (rad, > 0)
    :raises ValueError: for a value that is not finite or outside of the range above
    """

    gravity: float = 9.8
    cart_mass: float = 1.0
    pole_mass: float = 0.1
    pole_length: float = 1.0
    force_scale: float = 10.0
    cart_friction: float = 0.0
    pole_friction: float = 0.0
    dt: float = 0.02
    x_threshold: float = 2.4
    theta_threshold: float = math.radians(12)

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            may_vanish = name in ("cart_friction", "pole_friction")
            if not (math.isfinite(value) and (value > 0 or (may_vanish and value == 0))):
                remedy = "zero or a positive" if may_vanish else "a positive"
                raise ValueError(f"{name} must be {remedy} finite number, not {value!r}")


def _euler(state: tuple[T, T, T, T], sin: T, cos: T, action: T, p: Mapping[str, Any]) -> tuple[T, T, T, T]:
    """Advance by one explicit Euler step; written in operators alone, so that floats and tensors share it."""
    x, x_dot, theta, theta_dot = state
    half_length = p["pole_length"] / 2
    mass = p["cart_mass"] + p["pole_mass"]
    moment = p["pole_mass"] * half_length
    force = p["force_scale"] * action - p["cart_friction"] * x_dot
    push = (force + moment * theta_dot * theta_dot * sin) / mass
    torque = p["gravity"] * sin - cos * push - p["pole_friction"] * theta_dot / moment
    theta_acc = torque / (half_length * (4.0 / 3.0 - p["pole_mass"] * cos * cos / mass))
    x_acc = push - moment * theta_acc * cos / mass
    dt = p["dt"]
    return x + dt * x_dot, x_dot + dt * x_acc, theta + dt * theta_dot, theta_dot + dt * theta_acc


def cartpole_step(state: th.Tensor, action: th.Tensor, parameters: Mapping[str, th.Tensor | float]) -> th.Tensor:
    r"""One step of ``n`` cart-poles, differentiable in the state, the action and the parameters.

    With M, m the masses of cart and pole, l half the pole's length, F the force (action · ``force_scale``), b and c the
    friction of cart and hinge, and theta measured from upright:

    .. math::
        (M + m)\,\ddot x + m l\,(\ddot\theta\cos\theta - \dot\theta^2\sin\theta) &= F - b\,\dot x \\
        \tfrac43 m l^2\,\ddot\theta + m l\,\ddot x\cos\theta - m g l\sin\theta &= -c\,\dot\theta

    These are the equations of Barto, Sutton & Anderson (1983) as solved by Florian (2007, "Correct equations for the
    dynamics of the cart-pole system"), with viscous friction on the cart instead of Coulomb's. They are integrated by
    explicit Euler, as gymnasium's CartPole-v1 does.

    :param state: (n, 4): position (m), velocity (m/s), angle (rad), angular velocity (rad/s)
    :param action: (n, 1), clipped to [-1, 1]
    :param parameters: the fields of :class:`CartPoleParameters` as numbers or scalar tensors (thresholds are not used)
    :return: (n, 4), the next state, in the type of ``state``
    """
    x, x_dot, theta, theta_dot = state.unbind(dim=1)
    clipped = action[:, 0].to(state.dtype).clamp(-1.0, 1.0)
    return th.stack(_euler((x, x_dot, theta, theta_dot), theta.sin(), theta.cos(), clipped, parameters), dim=1)


def _outside(x: T, theta: T, parameters: CartPoleParameters) -> T | bool:
    return (abs(x) > parameters.x_threshold) | (abs(theta) > parameters.theta_threshold)


def cartpole_termination(state: th.Tensor, parameters: CartPoleParameters) -> th.Tensor:
    """Whether an episode ends on reaching ``state``: the cart left the track or the pole fell.

    :param state: (n, 4)
    :param parameters: only the thresholds matter
    :return: (n,), bool
    """
    outside = _outside(state[:, 0].double(), state[:, 2].double(), parameters)
    return th.as_tensor(outside)


def _closeness(x: T, theta: T, parameters: CartPoleParameters) -> T:
    return 1.0 - 0.5 * ((x / parameters.x_threshold) ** 2 + (theta / parameters.theta_threshold) ** 2)


def cartpole_reward(state: th.Tensor, parameters: CartPoleParameters) -> th.Tensor:
    """How close the cart is to the centre and the pole to upright: 1 - ((x / x_max)^2 + (theta / theta_max)^2) / 2.

    CartPole-v1's constant 1 says nothing of a slow drift until the cart leaves the track hundreds of steps later; SAC's
    critic resolves that badly: in development its policies mostly drifted off after 150 to 300 steps.

    :param state: (n, 4), the state that was reached
    :param parameters: only the thresholds matter
    :return: (n,), 1 at the centre, 0 where both thresholds are reached
    """
    return _closeness(state[:, 0].double(), state[:, 2].double(), parameters).to(state.dtype)


class ContinuousCartPoleEnv(gym.Env[np.ndarray, np.ndarray]):
    """Balance a pole on a cart by a continuous force.

    Observations are [position (m), velocity (m/s), angle from upright (rad), angular velocity (rad/s)], actions a share
    in [-1, 1] of ``force_scale`` (values outside are clipped), rewards at most 1 a step: :func:`cartpole_reward`.
    With the default constants and actions of ±1 it moves and ends exactly as gymnasium's CartPole-v1. See
    :func:`cartpole_step` for the equations.

    ``reset(options={"low": -0.1, "high": 0.1})`` sets the range of the uniform start state (default ±0.05).

    >>> env = ContinuousCartPoleEnv(pole_length=2.0)
    >>> env.parameters.pole_length
    2.0

    :param render_mode: None or ``"rgb_array"``
    :param constants: any field of :class:`CartPoleParameters`
    :raises ValueError: for a constant outside its range or an unknown render mode
    :raises TypeError: for a constant that does not exist
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 50}  # type: ignore[misc]

    def __init__(self, *, render_mode: str | None = None, **constants: float) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, not {render_mode!r}")
        self.render_mode = render_mode
        self._parameters = CartPoleParameters(**constants)
        self._constants = asdict(self._parameters)
        # Unbounded, so that worlds with other thresholds share one space and no start state lies outside of it.
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._state: tuple[float, float, float, float] | None = None

    @property
    def parameters(self) -> CartPoleParameters:
        """The physical constants of this world."""
        return self._parameters

    def scale(self, factors: Mapping[str, float]) -> None:
        """Multiply constants from now on; an episode under way goes on in the other world.

        :param factors: by name of the constant
        :raises ValueError: for a constant that leaves its range
        """
        constants = {name: self._constants[name] * factor for name, factor in factors.items()}
        self._parameters = CartPoleParameters(**{**self._constants, **constants})
        self._constants = asdict(self._parameters)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode near upright, from the same states as CartPole-v1 with the same seed.

        :param seed: seeds ``np_random`` when given
        :param options: ``low`` and ``high`` of the uniform start state, default ±0.05
        """
        super().reset(seed=seed)
        low, high = maybe_parse_reset_bounds(options, -0.05, 0.05)
        x, x_dot, theta, theta_dot = self.np_random.uniform(low=low, high=high, size=4).tolist()
        self._state = (x, x_dot, theta, theta_dot)
        return np.array(self._state, dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply ``action`` for ``dt`` seconds.

        :param action: (1,), clipped to [-1, 1]
        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        if self._state is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        theta = self._state[2]
        push = min(max(float(action[0]), -1.0), 1.0)
        # On plain floats: a batch of one in torch costs twenty times as much.
        self._state = _euler(self._state, math.sin(theta), math.cos(theta), push, self._constants)
        x, theta = self._state[0], self._state[2]
        terminated = bool(_outside(x, theta, self._parameters))
        return np.array(self._state, dtype=np.float32), _closeness(x, theta, self._parameters), terminated, False, {}

    def reward_fn(self, obs: th.Tensor, act: th.Tensor, next_obs: th.Tensor) -> th.Tensor:
        """Rewards (n,) of ``n`` transitions; see :func:`cartpole_reward`."""
        return cartpole_reward(next_obs, self._parameters)

    def termination_fn(self, obs: th.Tensor, act: th.Tensor, next_obs: th.Tensor) -> th.Tensor:
        """Whether each of ``n`` transitions ended the episode, (n,) bool; see :func:`cartpole_termination`."""
        return cartpole_termination(next_obs, self._parameters)

    def get_state(self) -> dict[str, Any]:
        """Everything that later steps and resets depend on, for :meth:`set_state`."""
        return {"physics": self._state, "np_random": self.np_random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue exactly where :meth:`get_state` was called.

        :param state: what :meth:`get_state` returned
        """
        self._state = state["physics"]
        self.np_random.bit_generator.state = state["np_random"]

    def render(self) -> np.ndarray | None:
        """Draw the state: (400, 600, 3), uint8; None without ``render_mode`` or before the first reset."""
        if self.render_mode is None or self._state is None:
            return None
        height, width = 400, 600
        x, _, theta, _ = self._state
        metres = 2 * self._parameters.x_threshold / width  # of one pixel
        # World coordinates of the pixels' centres, with the hinge at height 0 and the track over the whole width.
        across = (np.arange(width) + 0.5 - width / 2)[None, :] * metres - x
        up = (300 - np.arange(height) - 0.5)[:, None] * metres
        along = np.clip(across * math.sin(theta) + up * math.cos(theta), 0.0, self._parameters.pole_length)
        to_pole = np.hypot(across - along * math.sin(theta), up - along * math.cos(theta))
        frame = np.full((height, width, 3), 255, dtype=np.uint8)
        frame[300:302] = 0
        frame[(np.abs(across) <= 25 * metres) & (np.abs(up) <= 15 * metres)] = 0
        frame[to_pole <= 5 * metres] = (202, 152, 101)
        return frame
