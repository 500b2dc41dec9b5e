"""Is the target the machine whose simulator is fitted to it?"""

from __future__ import annotations

import math
import warnings
from itertools import zip_longest
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms.interfaces import LoopController
from sb3_rpto.algorithms.rollouts import try_source
from sb3_rpto.algorithms.run_state import RunState
from sb3_rpto.dynamics.base import Dynamics, Transitions
from sb3_rpto.dynamics.cartpole import CartPoleDynamics, cartpole_constants
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.residual import ResidualDynamics
from sb3_rpto.dynamics.simulator import check_source
from sb3_rpto.effects import Declared
from sb3_rpto.effects.model_numbers import differing, sites_act
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.observations import layers, mujoco_model, single_env, state_map
from sb3_rpto.sysid.data.columns import columns_of

#: A fitted simulator should err by less than this share of a standard one-step change. Shifted tasks end below 0.15
#: (tests and benchmarks; observation noise of a hundredth included), joints in another order above 0.53.
LARGE = 0.5
#: Of an error above so much (smaller ones bias phi little) each undoes more than this share of the one before it where
#: observations are noisy: half of it. What a simulator lacks lasts, and random forces leave each to itself.
SMALL, UNDONE = 0.05, 0.35
#: Exact transitions, of which none undoes the one before, are met to rounding by what is right: an error of more than
#: so much of a standard one-step change is something that the simulator lacks.
EXACT = 1e-3
#: Transitions from which on noise is told from what lasts, see :meth:`PhysicalDynamics.undone`.
ENOUGH = 100
#: A known reward is another one where it errs by so much of the rewards' deviation, a float's rounding apart, on more
#: than this share of all transitions; a termination where it errs on more than this share of what ends by either.
FAR, ROUNDING, MANY, MOST = 0.1, 1e-3, 0.1, 0.5
#: And on more transitions than these.
FEW = 2
#: States that observation wrappers are shown, and how often in a row: sensors that are late show the last of them.
DRAWN, HELD = 64, 16


def check_machine(source: VecEnv, target: VecEnv) -> None:
    """Refuse a MuJoCo target whose observations and steps a simulator of the source cannot account for.

    Joints by name and order, and the length of a step, must agree; numbers and wrappers may differ, but
    observations must hold the state as the source's do. A target that shows no MuJoCo model (hardware, other
    processes) passes.

    :raises ValueError: naming the first joint that differs, both lengths, or the wrapper
    """
    try:
        envs = [single_env(env) for env in (source, target)]
        ours, theirs = (columns_of(mujoco_model(env)).qpos for env in envs)
    except ValueError:
        return
    for mine, other in zip_longest(ours, theirs):
        if mine != other:
            raise ValueError(
                f"target_env has {_joint(other)} where env has {_joint(mine)}: phi would be fitted to the states of "
                "another machine; give both the same joints in the same order, or pass dynamics='ensemble'"
            )
    mine, other = (getattr(env.unwrapped, "dt", None) for env in envs)
    if mine is not None and other is not None and not math.isclose(mine, other, rel_tol=1e-6):
        raise ValueError(
            f"a step of target_env takes {other:g} s, one of env {mine:g} s, which no number of the model makes up "
            "for; build both with the same frame_skip times timestep"
        )
    _check_observations(*envs)


def _check_observations(source: gym.Env, target: gym.Env) -> None:
    """Refuse observation wrappers of the target with which they no longer hold its state as the source's do.

    Those of a copy are shown drawn states: the target itself is not touched. Noise passes, and so does what is late.
    """
    copied = copy_env(target)
    wrappers = [layer for layer in layers(copied or target) if isinstance(layer, gym.ObservationWrapper)]
    if copied is None or not wrappers or not all(hasattr(copied.unwrapped, name) for name in ("_get_obs", "data")):
        return  # what cannot be read, or copied, is judged by its errors later: :func:`doubt`
    try:
        recover = state_map(source)
    except ValueError:
        return
    twin: Any = copied.unwrapped
    model, data = mujoco_model(twin), twin.data
    rng = np.random.default_rng(0)
    plain: list[np.ndarray] = []
    seen: list[np.ndarray] = []
    for _ in range(DRAWN):
        data.qpos[:] = model.qpos0
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-0.2, 0.2, model.nv), 1.0)
        data.qvel[:] = rng.uniform(-0.5, 0.5, model.nv)
        mujoco.mj_forward(model, data)
        plain.append(twin._get_obs())
        for _ in range(HELD):
            observation = twin._get_obs()
            for wrapper in reversed(wrappers):
                observation = wrapper.observation(observation)
        seen.append(observation)
    true, read = (np.concatenate(recover(np.array(shown))[:2], axis=1) for shown in (plain, seen))
    # Coordinates that were exchanged err by 1.4 times what they vary by; unknown ones are NaN.
    far = np.sqrt(np.mean((read - true) ** 2, axis=0)) > np.std(true, axis=0)
    if far.any():
        names = [*columns_of(model).qpos, *(f"the speed of {name}" for name in columns_of(model).qvel)]
        raise ValueError(
            f"target_env: with {' and '.join(type(w).__name__ for w in wrappers)} its observations do not hold "
            f"{names[int(far.argmax())]} as those of env do: phi would be fitted to wrong states; leave out what "
            "changes units or order, wrap env alike and register a state map, or pass dynamics='ensemble'"
        )


def check_simulator(source: VecEnv, dynamics: Dynamics | None, single_steps: bool) -> None:
    """Warn where a new source is another simulator than the one that phi is the numbers of.

    :param source: which was set, or with which a checkpoint was loaded
    :param dynamics: which were built from an earlier one
    :param single_steps: as of :func:`~sb3_rpto.algorithms.rollouts.try_source`
    :raises ValueError: it does more than its model and phi do, as one that was corrected already; phi cannot act in it
    """
    physical = dynamics.physical if isinstance(dynamics, ResidualDynamics) else dynamics
    if isinstance(physical, PhysicalDynamics):
        check_source(source)
        try_source(source, dynamics, single_steps)
        model = mujoco_model(single_env(source))
        # Places that nothing acts at are marks, such as a goal's, which a task may move.
        found = [n for n in differing(physical.mj_model, model) if not n.startswith("site_") or sites_act(model)]
    elif isinstance(physical, CartPoleDynamics):
        found = [name for name, value in cartpole_constants(source).items() if value != physical.nominal[name]]
    else:
        return
    if found:
        warnings.warn(
            f"env simulates another model than the one that phi was fitted for ({', '.join(found[:3])} differ): "
            "source episodes and fits will not agree; give the source that the model was made with, or begin anew",
            stacklevel=3,
        )


def _joint(name: str | None) -> str:
    return "no further joint" if name is None else f"the joint {name!r}"


def check_fit(dynamics: Dynamics, error: float, data: Transitions, state: RunState, loop: LoopController) -> None:
    """Say once what speaks against the target: after the first fit, with the loop closed after the first trace.

    :param dynamics: after a fit
    :param error: its one-step error on D_target
    :param data: D_target
    :param state: which checks were made
    :param loop: what fits of the simulator are traced by
    """
    state.rules_checked = state.rules_checked or doubt_rules(dynamics, data)
    if not loop.closed and not state.residual_checked:
        state.residual_checked = doubt_what_is_left(dynamics, error, data)
    if state.fit_checked or loop.awaits_trace():
        return
    state.fit_checked = True
    doubt(dynamics, 0.0 if loop.freezes_dynamics else error, data)  # which is mostly noise there


def doubt(dynamics: Dynamics, error: float, data: Transitions) -> None:
    """Warn of what speaks against a simulator that was just fitted.

    :param dynamics: after a fit; only MuJoCo simulators are judged
    :param error: its one-step error on D_target
    :param data: D_target
    """
    if not isinstance(dynamics, PhysicalDynamics | ResidualDynamics):
        return
    physical = dynamics.physical if isinstance(dynamics, ResidualDynamics) else dynamics
    found = [f"{name} lies at its bound" for name in physical.declared_at_bounds()]
    if error > LARGE:
        found.append(f"the one-step error is still {error:.2g} of a typical step's change")
    if error > SMALL and physical.undone(data) > UNDONE:
        warnings.warn(
            "each one-step error undoes a part of the one before it, as where sensors are noisy: "
            "phi is biased then, by more than its standard errors say; declare fewer numbers, or give "
            "close_loop=True (effects=[...] says what to look for, which may be nothing), with "
            "dynamics_kwargs={'observation_noise': ...}: its traces reckon with noise",
            stacklevel=3,
        )
    if found:
        warnings.warn(
            f"after the fit {' and '.join(found)}: do the target's observations hold the model's joints in its "
            "order and units? If so, wider bounds, further declared numbers or an effect that is missing "
            "(close_loop=True looks for it) may account for it",
            stacklevel=3,
        )


def doubt_what_is_left(dynamics: Dynamics, error: float, data: Transitions) -> bool:
    """Warn where a fit that came to its end misses exact data by more than rounding: a declared number makes up for it.

    :param dynamics: after a fit; only MuJoCo simulators are judged
    :param error: its one-step error on D_target
    :param data: D_target
    :return: whether it could be judged: the fit has ended, and noise could be told from what lasts
    """
    if not isinstance(dynamics, PhysicalDynamics):
        return True
    if not dynamics.settled or len(data) < ENOUGH:
        return False
    if error > EXACT and dynamics.undone(data) < UNDONE:
        firm = [e.label for e in dynamics.simulation.effects if isinstance(e, Declared) and e.firm]
        gives_way = (
            f"; {', '.join(firm)} is 0 in the model and is fitted as friction that holds at rest, where MuJoCo's own "
            "gives way over 20 ms: of a simulated target give it a small value in the MJCF"
            if firm
            else ""
        )
        warnings.warn(
            f"after the fit the one-step error is still {error:.2g} of a typical step's change, and sensor noise does "
            "not explain it: something differs that was not declared, and the declared numbers may have moved away "
            "from the truth to make up for it; declare further numbers (of a mass the inertia, too), or pass "
            f"close_loop=True, which looks for what is missing{gives_way}",
            stacklevel=3,
        )
    return True


def doubt_rules(dynamics: Dynamics, data: Transitions) -> bool:
    """Warn of a known rule that is not the target's, and say whether there is one.

    Few that differ may be those at a threshold, where observations are rounded or noisy.

    :param dynamics: with ``reward_fn`` and ``termination_fn``, where they are known
    :param data: D_target
    """
    given, said = (data.observations, data.actions, data.next_observations), []
    for name, recorded in (("reward_fn", data.rewards), ("termination_fn", data.terminations)):
        rule = getattr(dynamics, name, None)
        if rule is None or not len(data):
            continue
        answers = rule(*given).reshape(len(data)).to(recorded)
        if name == "termination_fn":
            far, enough = 0.5, MOST * int(((answers > 0) | (recorded > 0)).sum())
        else:
            far, enough = FAR * float(recorded.std(correction=0)) + ROUNDING, MANY * len(data)
        wrong = int(((answers - recorded).abs() > far + ROUNDING * recorded.abs()).sum())
        if wrong > max(FEW, enough):
            said.append(f"{name} is not that of {wrong} of {len(data)} target transitions")
    if said:
        name = said[0].partition(" ")[0]
        warnings.warn(
            f"what is known of the source's task does not hold in the target: {' and '.join(said)}; pass the target's "
            f"rule by dynamics_kwargs={{'{name}': ...}}, or None to have it learned (very noisy sensors look alike)",
            stacklevel=3,
        )
    return bool(said)
