"""A simulator as trainable dynamics: phi is a few named physical constants, with exact gradients."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, Literal, NamedTuple

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions, relative_error
from sb3_rpto.effects.names import near
from sb3_rpto.envs.cartpole import CartPoleParameters, cartpole_reward, cartpole_step, cartpole_termination
from sb3_rpto.envs.task_rules import changing_wrappers
from sb3_rpto.ranges import MAPPING, NONE, POSITIVE, check, whole

#: The constants that may be declared, with their default bounds; None is a tenth to ten times the nominal value.
DECLARABLE: dict[str, tuple[float, float] | None] = {
    "gravity": None,
    "cart_mass": None,
    "pole_mass": None,
    "pole_length": None,
    "force_scale": None,
    "cart_friction": (0.0, 10.0),
    "pole_friction": (0.0, 0.5),
}

#: Directions whose curvature is below this share of the largest count as not identified by the data.
SINGULAR = 1e-8


def is_cartpole(env: gym.Env | VecEnv) -> bool:
    """Whether :func:`cartpole_constants` finds a cart-pole."""
    found = _parameters(env)
    return bool(found) and isinstance(found[0], CartPoleParameters)


def cartpole_constants(env: gym.Env | VecEnv) -> dict[str, float]:
    """The constants of a cart-pole, read through wrappers that leave its steps as they are.

    :param env: a (wrapped or vectorised) :class:`~sb3_rpto.envs.cartpole.ContinuousCartPoleEnv`
    :return: every field of :class:`~sb3_rpto.envs.cartpole.CartPoleParameters`
    :raises ValueError: if there is no cart-pole below the wrappers, several differ, or a wrapper may change what goes
        in or comes out
    """
    found = _parameters(env)
    if not found or not isinstance(found[0], CartPoleParameters):
        raise ValueError(f"env has no cart-pole parameters: {env}; pass a ContinuousCartPoleEnv")
    if any(other != found[0] for other in found[1:]):
        raise ValueError("env holds cart-poles with different constants, and phi is the constants of one; give one")
    strange = changing_wrappers(env)
    if strange:
        raise ValueError(
            f"env: wrapper(s) {', '.join(sorted(strange))} may change observations, actions or rewards, which the "
            "cart-pole's equations know nothing of; leave them out, or pass dynamics='ensemble'"
        )
    return asdict(found[0])


def _parameters(env: gym.Env | VecEnv) -> list[Any]:
    if isinstance(env, VecEnv):
        return env.get_attr("parameters") if env.has_attr("parameters") else []
    return [env.get_wrapper_attr("parameters")] if env.has_wrapper_attr("parameters") else []


class _Linearisation(NamedTuple):
    """The weighted residuals and their derivative at one phi."""

    residual: th.Tensor  # (n, d)
    jacobian: th.Tensor  # (n, d, p)

    @property
    def loss(self) -> float:
        return float(self.residual.pow(2).sum())

    @property
    def gradient(self) -> th.Tensor:  # (p,), of half the loss
        return th.einsum("ndp,nd->p", self.jacobian, self.residual)

    @property
    def hessian(self) -> th.Tensor:  # (p, p), Gauss-Newton's, of half the loss
        return th.einsum("ndp,ndq->pq", self.jacobian, self.jacobian)


class CartPoleDynamics(Dynamics):
    r"""The cart-pole simulator with trainable constants.

    phi is kept as one coordinate per declared constant, zero at its nominal value: log(value / nominal) where the lower
    bound is positive, (value - nominal) / (upper - lower) otherwise. :meth:`fit` minimises the weighted squared error

    .. math:: \sum_i w_i \, \lVert (f_\phi(s_i, a_i) - s'_i) / \sigma \rVert^2 / (d \sum_i w_i)

    (sigma: each dimension's standard one-step change in the data, d: dimensions that change at all) by
    Levenberg-Marquardt steps: Gauss-Newton's direction, its length limited to ``max_step`` so that the source moves
    smoothly towards the target (the curriculum of RTO), and to the point as soon as that is within reach. A step that
    would raise the error is shortened until it does not. Directions that the data do not determine have no component
    in such a step, so phi stays at its nominal value along them. There is no optimizer and no randomness.

    :param observation_space: Box (4,)
    :param action_space: Box (1,)
    :param constants: fields of :class:`~sb3_rpto.envs.cartpole.CartPoleParameters`: the nominal values
        (:func:`cartpole_constants` reads them off an environment); missing ones take their default
    :param declared: names of the constants to train, out of :data:`DECLARABLE`
    :param bounds: (lower, upper) of declared constants in their units; default: :data:`DECLARABLE`'s
    :param max_step: largest change of a coordinate in one step; 0.0025 doubles a constant in about 280 steps
    :param max_steps: bounded steps that a fit takes at most, unless it is told otherwise
    :raises ValueError: for spaces that are not a cart-pole's, unknown or repeated names, bounds that are empty,
        infinite, unphysical or do not hold the nominal value, and ``max_step`` <= 0
    """

    rollout: ClassVar[Literal["branches", "episodes"]] = "episodes"
    fits_newest: ClassVar[int] = 5000  # a handful of constants is known long before

    _lower: th.Tensor
    _upper: th.Tensor
    _nominal: th.Tensor
    _is_log: th.Tensor
    _width: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        constants: Mapping[str, float],
        declared: Sequence[str] = ("pole_length",),
        bounds: Mapping[str, tuple[float, float]] | None = None,
        max_step: float = 0.0025,
        max_steps: int = 2000,
    ) -> None:
        super().__init__(observation_space, action_space)
        if observation_space.shape != (4,) or action_space.shape != (1,):
            raise ValueError(
                f"CartPoleDynamics simulates the cart-pole (4 observations, 1 action), not spaces of shape "
                f"{observation_space.shape} and {action_space.shape}; it is chosen by itself for ContinuousCartPole"
            )
        check({"max_step": POSITIVE, "max_steps": whole(1), "bounds": MAPPING | NONE}, locals())
        self.nominal = _complete(constants)
        self._thresholds = CartPoleParameters(**self.nominal)
        self.declared = _checked_names(declared)
        self.bounds = _checked_bounds(self.declared, self.nominal, bounds or {})
        self.max_step = max_step
        self.max_steps = max_steps

        lower, upper = th.tensor([self.bounds[name] for name in self.declared], dtype=th.float64).T
        nominal = th.tensor([self.nominal[name] for name in self.declared], dtype=th.float64)
        is_log, width = lower > 0, upper - lower
        # The rest follows from the arguments, so the checkpoint holds phi alone.
        for key, value in {
            "_nominal": nominal,
            "_is_log": is_log,
            "_width": width,
            "_lower": th.where(is_log, (lower / nominal).log(), (lower - nominal) / width),
            "_upper": th.where(is_log, (upper / nominal).log(), (upper - nominal) / width),
        }.items():
            self.register_buffer(key, value, persistent=False)
        self.coordinates = nn.Parameter(th.zeros(len(self.declared), dtype=th.float64))

    def values(self, coordinates: th.Tensor) -> th.Tensor:
        """The declared constants in their units, (..., p), at ``coordinates`` (..., p); differentiable."""
        return th.where(self._is_log, self._nominal * coordinates.exp(), self._nominal + self._width * coordinates)

    def simulate(self, observations: th.Tensor, actions: th.Tensor, coordinates: th.Tensor) -> th.Tensor:
        """Next observations (n, 4) in float64 at any phi; differentiable in all arguments.

        :param observations: (n, 4)
        :param actions: (n, 1)
        :param coordinates: (p,), or (n, p) for a world of its own for each transition; see the class
        """
        current = dict(zip(self.declared, self.values(coordinates).unbind(dim=-1)))
        return cartpole_step(observations.double(), actions.double(), {**self.nominal, **current})

    @th.enable_grad()
    def linearise(
        self, observations: th.Tensor, actions: th.Tensor, coordinates: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Next observations (n, 4) and their exact derivative by the coordinates, (n, 4, p), at ``coordinates`` (p,).

        Reverse mode over one copy of phi for each transition: several times faster than ``torch.func.jacfwd`` here.
        """
        copies = coordinates.detach().repeat(len(observations), 1).requires_grad_()
        reached = self.simulate(observations, actions, copies)
        rows = [
            th.autograd.grad(column.sum(), copies, retain_graph=True, allow_unused=True, materialize_grads=True)[0]
            for column in reached.unbind(dim=1)
        ]
        return reached.detach(), th.stack(rows, dim=1)

    @property
    def constants(self) -> dict[str, float]:
        """All constants with the current phi: ``ContinuousCartPoleEnv(**model.constants)`` is the corrected world."""
        return {**self.nominal, **self.describe()}

    def describe(self) -> dict[str, float]:
        """The declared constants by name, in their units."""
        phi = self.coordinates.detach().double()
        lower, upper = th.tensor([self.bounds[name] for name in self.declared], dtype=th.float64, device=phi.device).T
        # exp(log(bound)) may miss the bound by a rounding error, and a friction of -1e-18 is no world.
        values = self.values(phi).clamp(lower, upper)
        values = th.where(phi <= self._lower, lower, th.where(phi >= self._upper, upper, values))
        return dict(zip(self.declared, values.tolist()))

    @th.no_grad()
    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """One step of the simulator, computed in float64 and returned in the observations' type.

        :param observations: (n, 4)
        :param actions: (n, 1), clipped to [-1, 1] as the environment does
        :param deterministic: no effect, the simulator always is
        """
        reached = self.simulate(observations, actions, self.coordinates.double())
        terminations = cartpole_termination(reached, self._thresholds)
        next_observations = reached.to(observations.dtype)
        return Prediction(next_observations, cartpole_reward(next_observations, self._thresholds), terminations)

    @th.no_grad()
    def error(self, data: Transitions) -> float:
        """Root mean squared one-step error on ``data``, in units of each dimension's standard one-step change."""
        return relative_error(self.simulate(data.observations, data.actions, self.coordinates.double()), data)

    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Move phi towards ``data`` by at most ``max_steps`` bounded steps; stops where no step improves.

        :param data: transitions, oldest first; the newest :attr:`fits_newest` with a positive weight are used
        :param weights: (n,), one non-negative weight a transition; None weighs all alike
        :param max_steps: cap of steps; None takes the constructor's
        :return: ``loss`` (mean weighted squared error after the fit), ``steps`` taken, and for every declared constant
            its value and standard error ``<name>_se`` (see :meth:`_standard_errors`; infinite where the data do not
            determine it)
        :raises ValueError: for weights of the wrong shape, negative, not finite or all zero, and data not finite
        """
        data, weight = _checked_data(data, weights)
        change = (data.next_observations - data.observations).double()
        mean = weight @ change
        scale = (weight @ (change - mean).pow(2)).sqrt()
        moving = (scale > 1e-8).nonzero()[:, 0]
        root = (weight / max(len(moving), 1)).sqrt()[:, None]

        def linearise(coordinates: th.Tensor) -> _Linearisation:
            reached, jacobian = self.linearise(data.observations, data.actions, coordinates)
            missed = reached - data.next_observations.double()
            unit = root / scale[moving]
            return _Linearisation(unit * missed[:, moving], unit[:, :, None] * jacobian[:, moving])

        phi = self.coordinates.detach().double()
        here = linearise(phi)
        limit = self.max_steps if max_steps is None else max_steps
        damping, steps = SINGULAR, 0
        while steps < limit:
            candidate = self._propose(phi, here, damping)
            if (candidate - phi).abs().max() < 1e-10:
                break
            there = linearise(candidate)
            if there.loss <= here.loss:
                phi, here, steps, damping = candidate, there, steps + 1, max(damping / 10, SINGULAR)
            else:  # shorter until it improves; where nothing does, it soon is too short to go on
                damping = max(10 * damping, 1e-3)
        with th.no_grad():
            self.coordinates.copy_(phi)

        errors = self._standard_errors(phi, here).tolist()
        log = {"loss": here.loss, "steps": float(steps), **self.describe()}
        return log | {f"{name}_se": error for name, error in zip(self.declared, errors)}

    def _propose(self, phi: th.Tensor, here: _Linearisation, damping: float) -> th.Tensor:
        """The damped Gauss-Newton step from ``phi``, shortened to ``max_step`` and kept in bounds."""
        gradient, hessian = here.gradient, here.hessian
        # A constant that is pressed against its bound stays there; the others are solved for without it.
        pressed = ((phi <= self._lower) & (gradient > 0)) | ((phi >= self._upper) & (gradient < 0))
        free = (~pressed).nonzero()[:, 0]
        curvature = hessian.diagonal()[free]
        if not (curvature > 0).any():
            return phi
        ridge = th.diag(damping * curvature.max().expand(len(free)))
        step = th.zeros_like(phi)
        step[free] = -th.linalg.solve(hessian[free][:, free] + ridge, gradient[free])
        step *= (self.max_step / step.abs().max().clamp(min=self.max_step)).item()
        return (phi + step).clamp(self._lower, self._upper)

    def _standard_errors(self, phi: th.Tensor, here: _Linearisation) -> th.Tensor:
        """Standard errors of the declared constants, (p,), in their units.

        The sandwich H^-1 (sum_i g_i g_i^T) H^-1 · n / (n - p), with H the Gauss-Newton Hessian and g_i the gradient of
        transition i (White, 1980): RTO's weights are not precisions, and not every dimension is equally noisy, so the
        plain sigma² H^-1 would be wrong. Far from the optimum it counts the misfit as noise.
        """
        n, p = len(here.residual), len(phi)
        curvature, directions = th.linalg.eigh(here.hessian)
        known = curvature > SINGULAR * curvature[-1].clamp(min=0)
        if n <= p or not known.any():
            return th.full_like(phi, math.inf)
        inverse = (directions[:, known] / curvature[known]) @ directions[:, known].T
        scores = th.einsum("ndp,nd->np", here.jacobian, here.residual)
        covariance = inverse @ (scores.T @ scores) @ inverse * (n / (n - p))
        unit = th.where(self._is_log, self.values(phi), self._width)
        undetermined = (directions[:, ~known].abs() > 1e-3).any(dim=1)
        return (covariance.diagonal().clamp(min=0).sqrt() * unit).masked_fill(undetermined, math.inf)

    def get_extra_state(self) -> dict[str, Any]:
        """The random stream, and what the saved coordinates refer to."""
        return super().get_extra_state() | self._reference()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` returned.

        :raises ValueError: if it was saved with other constants, declarations or bounds, where phi means another world
        """
        for key, mine in self._reference().items():
            if state[key] != mine:
                raise ValueError(f"saved with {key}={state[key]}, not {mine}; rebuild the model with the saved ones")
        super().set_extra_state(state)

    def _reference(self) -> dict[str, Any]:
        return {"constants": self.nominal, "declared": self.declared, "bounds": self.bounds}


def _complete(constants: Mapping[str, float]) -> dict[str, float]:
    known = list(asdict(CartPoleParameters()))
    for name in constants:
        if name not in known:
            raise ValueError(f"constants has unknown {name!r}; {near(name, known)}")
    return {name: float(value) for name, value in asdict(CartPoleParameters(**constants)).items()}


def _checked_names(declared: Sequence[str]) -> list[str]:
    if isinstance(declared, str) or not declared or len(set(declared)) < len(declared):
        raise ValueError(
            f"declared must be a list of one or more different names out of {list(DECLARABLE)}, not {declared!r}"
        )
    for name in declared:
        if name not in DECLARABLE:
            raise ValueError(f"declared has unknown constant {name!r}; {near(name, list(DECLARABLE))}")
    return list(declared)


def _checked_bounds(
    declared: list[str], nominal: dict[str, float], given: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    for name in given:
        if name not in declared:
            raise ValueError(f"bounds has {name!r}, which is not declared; {near(name, declared)}")
    bounds = {}
    for name in declared:
        value = nominal[name]
        lower, upper = map(float, given.get(name) or DECLARABLE[name] or (value / 10, value * 10))
        for bound in (lower, upper):
            CartPoleParameters(**{**nominal, name: bound})  # raises for bounds that no world can have
        if not (lower < upper and lower <= value <= upper):
            raise ValueError(
                f"bounds of {name} must be (lower, upper) around its nominal value {value}, not ({lower}, {upper}); "
                f"pass bounds={{{name!r}: (..., ...)}}"
            )
        bounds[name] = (lower, upper)
    return bounds


def _checked_data(data: Transitions, weights: th.Tensor | None) -> tuple[Transitions, th.Tensor]:
    """The newest transitions that count, and their weights summing to one."""
    if weights is None:
        weights = data.observations.new_ones(len(data))
    if weights.shape != (len(data),):
        raise ValueError(f"weights must have shape ({len(data)},), one a transition, not {tuple(weights.shape)}")
    if not (weights >= 0).all() or not weights.isfinite().all() or not (weights > 0).any():
        raise ValueError("weights must be finite, non-negative and not all zero (and data not empty)")
    counted = weights.nonzero()[-CartPoleDynamics.fits_newest :, 0]
    data, weights = data.take(counted), weights[counted].double()
    for name in ("observations", "actions", "next_observations"):
        if not getattr(data, name).isfinite().all():
            raise ValueError(f"data.{name} must be finite; drop such transitions or give them weight 0")
    return data, weights / weights.sum()
