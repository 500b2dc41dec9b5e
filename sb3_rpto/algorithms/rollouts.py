"""Step 3 of Algorithm 1: interact with the source world and fill D_source."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_rpto.algorithms.interfaces import Agent, SourceRollouts
from sb3_rpto.algorithms.normalisation import share_normalisation
from sb3_rpto.algorithms.transition_checks import Answers, check_finite, last_observations
from sb3_rpto.dynamics.base import Dynamics, Prediction
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.residual import ResidualDynamics
from sb3_rpto.dynamics.vec_env import DynamicsVecEnv
from sb3_rpto.effects import Effect
from sb3_rpto.effects.walker_reset import StandingEnv
from sb3_rpto.envs.env_copy import must_copy
from sb3_rpto.envs.env_snapshot import reseed, restore_state, save_state, whereabouts

RolloutStart = Literal["target", "source", "mix"]

#: For a trial, phi is moved by so much of its scale: a reset that writes the model's own numbers undoes it.
NUDGE = 1e-3
#: A branch from a state that a simulator does not know begins elsewhere, unless so many draws find no other.
REDRAWN = 100


def make_rollouts(env: VecEnv, dynamics: Dynamics | None, rollout_start: RolloutStart, num_envs: int) -> SourceRollouts:
    """The source as the model's backend rolls it out: itself (no dynamics), branches, or simulated episodes.

    :param env: the real source
    :param dynamics: the trainable source P_phi, if there is one
    :param rollout_start: where branches start
    :param num_envs: number of episodes simulated side by side
    """
    if dynamics is None:
        return EpisodeSource(env)
    if isinstance(dynamics, PhysicalDynamics):
        return SimulatorSource(dynamics, env, num_envs)
    if isinstance(dynamics, ResidualDynamics):
        dynamics.attach(env)
    if dynamics.rollout == "branches":
        return BranchSource(dynamics, rollout_start)
    return EpisodeSource(share_normalisation(DynamicsVecEnv(dynamics, env, num_envs), env))


class EpisodeSource(SourceRollouts):
    """Whole episodes of a source VecEnv: the real simulator (RPO) or one that the dynamics answer.

    :param env: stepped by the current stochastic policy
    :param first_obs: the observation of a reset that was made already; None: reset before the first step
    """

    _STATE = ("_last_obs", "_last_raw", "returns", "lengths")

    def __init__(self, env: VecEnv, first_obs: np.ndarray | None = None) -> None:
        self.env = env
        self._answers = Answers("source")
        self._normaliser = unwrap_vec_normalize(env)
        self.returns: deque[float] = deque(maxlen=100)
        self.lengths: deque[int] = deque(maxlen=100)
        self._last_obs = first_obs
        self._left_at: list[tuple[Any, ...]] | None = whereabouts(env)
        self._last_raw: np.ndarray | None = None if first_obs is None else self._raw(first_obs)

    def interact(self, agent: Agent, n_steps: int, random: bool = False) -> int:
        """Step at least ``n_steps`` times, counted in all environments together, and store every transition.

        :param agent: whose policy acts and whose D_source is filled
        :param n_steps: number of transitions
        :param random: uniform actions instead of the policy's
        :return: the number of transitions stored
        """
        normaliser = self._normaliser
        if self._left_at not in (None, whereabouts(self.env)):  # somebody stepped or reset it: its episodes are lost
            self.begin_anew()
        if self._last_obs is None:
            with self._answers.received():
                self._last_obs = np.asarray(self.env.reset())
            self._last_raw = self._raw(self._last_obs)
        assert self._last_raw is not None  # it comes and goes with _last_obs
        agent.policy.set_training_mode(False)
        steps, held = 0, math.inf  # for how many steps gSDE's noise was held
        while steps < n_steps:
            if random:
                actions = np.array([agent.action_space.sample() for _ in range(self.env.num_envs)])
            else:
                if agent.use_sde and held >= _sde_hold(agent):
                    agent.actor.reset_noise(self.env.num_envs)
                    held = 0
                held += 1
                actions, _ = agent.policy.predict(self._last_obs, deterministic=False)
            with self._answers.received():
                new_obs, rewards, dones, infos = self.env.step(actions)
            raw_obs, raw_next = self._last_raw, self._raw(new_obs)
            self._last_raw = raw_next.copy()
            if normaliser is not None:
                rewards = normaliser.get_original_reward()
            for index, ended in last_observations("source", self.env, dones, infos).items():
                raw_next[index] = ended
            scaled_later = normaliser is not None and normaliser.norm_reward
            self._answers.check(raw_next, np.asarray(rewards), self.env.observation_space.shape or (), scaled_later)
            timeouts = np.array([info.get("TimeLimit.truncated", False) for info in infos])
            scaled = agent.policy.scale_action(actions)
            agent.replay_buffer.append("source", raw_obs, raw_next, scaled, rewards, dones, timeouts, infos)
            if dones.any() and _draws_by_episode(agent):
                held = math.inf
            for info in infos:
                if "episode" in info:
                    self.returns.append(info["episode"]["r"])
                    self.lengths.append(info["episode"]["l"])
            self._last_obs = np.asarray(new_obs)
            steps += self.env.num_envs
            agent.state.source_timesteps += self.env.num_envs  # each as it is taken: the rest may be interrupted
        self._left_at = whereabouts(self.env)
        return steps

    def _raw(self, obs: Any) -> np.ndarray:
        """The observations that the environments just gave, not normalised; a copy."""
        return np.array(obs if self._normaliser is None else self._normaliser.get_original_obs())

    def log(self) -> dict[str, float]:
        """Mean return and length of the last 100 source episodes."""
        if not self.returns:
            return {}
        return {"ep_rew_mean": float(np.mean(self.returns)), "ep_len_mean": float(np.mean(self.lengths))}

    def begin_anew(self) -> None:
        """See :meth:`SourceRollouts.begin_anew`."""
        self._last_obs = self._last_raw = None

    def get_state(self) -> dict[str, Any]:
        """Where the episodes stand; see :meth:`SourceRollouts.get_state`."""
        inner = self.env.unwrapped
        model = inner.get_state() if isinstance(inner, DynamicsVecEnv) else None
        return {"model": model, **{name: getattr(self, name) for name in self._STATE}}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`get_state` was called."""
        if state["model"] is not None:
            self.env.unwrapped.set_state(state["model"])  # type: ignore[attr-defined]
        for name in self._STATE:
            setattr(self, name, state[name])
        self._left_at = None  # the source itself is put back elsewhere


class DrawnEnv(StandingEnv):
    """A simulator with other effects in each episode, drawn before it begins: it starts as the machine that it is.

    :param env: as of :class:`~sb3_rpto.effects.walker_reset.StandingEnv`
    :param effects: until its first reset
    :param draw: the next episode's
    """

    def __init__(self, env: gym.Env, effects: Sequence[Effect], draw: Callable[[], Sequence[Effect]]) -> None:
        self._draw = draw
        super().__init__(env, effects)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of another machine."""
        self.set_effects(self._draw())
        return super().reset(seed=seed, options=options)


class SimulatorSource(EpisodeSource):
    """Whole episodes of copies of the source with phi in it; rewards, terminations and resets are the source's own.

    :param dynamics: whose phi the copies have, at every call the newest
    :param env: the real source, of whose first environment copies are made
    :param num_envs: how many
    :raises ValueError: it cannot be copied
    """

    def __init__(self, dynamics: PhysicalDynamics, env: VecEnv, num_envs: int) -> None:
        self.dynamics = dynamics
        self.copies = [self._simulator(copied(env)) for _ in range(num_envs)]
        # What episodes earn is told by a Monitor, which SB3 puts around single environments, not around a VecEnv's.
        told = [copy if is_wrapped(copy, Monitor) else Monitor(copy) for copy in self.copies]
        makers: list[Callable[[], gym.Env]] = [lambda copy=copy: copy for copy in told]  # type: ignore[misc]
        stacked = DummyVecEnv(makers)
        # Copies of one environment would draw the same numbers.
        stacked.seed(self._draw())
        self._phi: tuple[Any, ...] = self._current()
        self._rng = np.random.default_rng(self._draw())
        super().__init__(share_normalisation(stacked, env))

    def reseed(self) -> None:
        """See :meth:`SourceRollouts.reseed`."""
        reseed(self.env, self._draw())
        self._rng = np.random.default_rng(self._draw())

    def _draw(self) -> int:
        return int(th.randint(2**31 - 1, (1,), generator=self.dynamics.generator))

    def _current(self) -> tuple[Any, ...]:
        return (*self.dynamics.names, *self.dynamics.values.tolist())

    def interact(self, agent: Agent, n_steps: int, random: bool = False) -> int:
        """As in :class:`EpisodeSource`; episodes under way go on where they are when phi has moved."""
        if self._current() != self._phi:
            self._phi = self._current()
            for copy in self.copies:
                copy.set_effects(self.dynamics.effects(self._rng))
        return super().interact(agent, n_steps, random)

    def _simulator(self, copy: gym.Env) -> StandingEnv:
        effects = self.dynamics.effects()
        if self.dynamics.randomise == 0:
            return StandingEnv(copy, effects)
        return DrawnEnv(copy, effects, lambda: self.dynamics.effects(self._rng))

    def get_state(self) -> dict[str, Any]:
        """Where the episodes stand, the simulators included."""
        phis = [[effect.values for effect in copy.effects] for copy in self.copies]
        inner = {"simulators": save_state(self.env.unwrapped), "phis": phis, "phi": self._phi}
        streams = {"rng": self._rng.bit_generator.state, "seeds": self.dynamics.generator.get_state()}
        return {**super().get_state(), **inner, **streams}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`get_state` was called; episodes begin anew where the simulators cannot be restored."""
        effects = self.dynamics.effects()
        for copy, values in zip(self.copies, state["phis"]):
            if list(map(len, values)) == [len(e.values) for e in effects]:  # else a trace has changed them since
                copy.set_effects([e.with_values(v) for e, v in zip(effects, values)])
        self._phi, self._rng.bit_generator.state = state["phi"], state["rng"]
        self.dynamics.generator.set_state(state["seeds"])  # this source was built anew, and drew some
        if state["simulators"] is not None:
            restore_state(self.env.unwrapped, state["simulators"])
            super().set_state(state)


def try_source(env: VecEnv, dynamics: Dynamics | None, single_steps: bool) -> None:
    """Refuse now what ``learn()`` would refuse: a copy of the source begins an episode with phi in it.

    :param env: the real source; untouched
    :param dynamics: the trainable source; only simulators of MuJoCo need a copy
    :param single_steps: whether they are asked for one-step answers, too
    :raises ValueError: it cannot be copied, phi cannot act in it, or it answers from more than its state
    """
    physical = dynamics.physical if isinstance(dynamics, ResidualDynamics) else dynamics
    if not isinstance(physical, PhysicalDynamics):
        return
    if single_steps or physical is not dynamics:
        physical.attach(env)
    simulation = physical.simulation
    moved = np.clip(physical.values + NUDGE * physical.scale, simulation.lower, simulation.upper)
    phi = [effect.with_values(moved[rows]) for effect, rows in zip(simulation.effects, simulation.slices)]
    trial = StandingEnv(copied(env), phi)
    trial.action_space.seed(0)
    trial.reset(seed=0)
    trial.step(trial.action_space.sample())


def copied(env: VecEnv) -> gym.Env:
    """A copy of the first environment.

    :raises ValueError: it cannot be copied
    """
    try:
        return must_copy(env)
    except Exception as error:  # whatever the contents of a user's environment raise
        raise ValueError(
            f"env {env} cannot be copied ({error}), which dynamics='physical' needs; give it a DummyVecEnv of gym.make "
            "whose environment holds nothing that copy.deepcopy refuses"
        ) from error


class BranchSource(SourceRollouts):
    """One-step branches of the learned dynamics (horizon 1) from states of the target, the source, or both.

    :param dynamics: answers the step
    :param rollout_start: "target" (states of D_target), "source" (states of the real source), "mix" (half of each)
    """

    def __init__(self, dynamics: Dynamics, rollout_start: RolloutStart) -> None:
        self.dynamics = dynamics
        self.rollout_start = rollout_start

    def interact(self, agent: Agent, n_steps: int) -> int:
        """Branch ``n_steps`` times, all at once, but not more often than D_source holds."""
        n_steps = min(n_steps, agent.replay_buffer.source.buffer_size)
        starts = self._starts(agent, n_steps)
        normaliser = agent.get_vec_normalize_env()
        seen = starts if normaliser is None else normaliser.normalize_obs(starts)
        agent.policy.set_training_mode(False)
        scaled = sample_policy(agent, th.as_tensor(seen, device=agent.device).float())
        actions = agent.unscale_actions(scaled)
        answer = self.answer(agent, th.as_tensor(starts, device=agent.device), actions)
        next_obs, rewards = answer.next_observations.cpu().numpy(), answer.rewards.cpu().numpy()
        check_finite("modelled source", observation=next_obs, reward=rewards)
        next_obs = next_obs.clip(agent.observation_space.low, agent.observation_space.high)
        terminations = answer.terminations.cpu().numpy()
        agent.replay_buffer.append("source", starts, next_obs, scaled.cpu().numpy(), rewards, terminations)
        agent.state.source_timesteps += n_steps
        return n_steps

    def answer(self, agent: Agent, observations: th.Tensor, actions: th.Tensor) -> Prediction:
        """What follows each branch's observation (n, observation_dim) and action (n, action_dim), in their units."""
        return self.dynamics.step(observations, actions, deterministic=False)

    def target_rows(self, agent: Agent, n: int) -> np.ndarray:
        """Rows of D_target to branch from, (n,)."""
        return np.random.randint(agent.replay_buffer.target.size(), size=n)

    def _starts(self, agent: Agent, n: int) -> np.ndarray:
        """Observations to branch from, (n, observation_dim), raw."""
        buffer = agent.replay_buffer
        odd = int(np.random.randint(2)) if self.rollout_start == "mix" and n % 2 else 0
        n_target = {"target": n, "source": 0, "mix": n // 2 + odd}[self.rollout_start]
        if buffer.target.size() == 0:
            n_target = 0  # before the first target transition only the source has states
        pools = []
        if n_target > 0:
            pools.append(self._known(n_target, lambda k: buffer.target.observations[self.target_rows(agent, k), 0]))
        if n > n_target:
            rows = len(buffer.source_starts)
            pools.append(self._known(n - n_target, lambda k: buffer.source_starts[np.random.randint(rows, size=k)]))
        # In turns, so that those which D_source forgets first are of both.
        order = np.argsort(np.concatenate([np.arange(len(pool)) / len(pool) for pool in pools]), kind="stable")
        return np.concatenate(pools)[order]

    def _known(self, n: int, draw: Callable[[int], np.ndarray]) -> np.ndarray:
        """``n`` observations, drawn again where the dynamics do not know the state: at most :data:`REDRAWN` times."""
        found = draw(n)
        for _ in range(REDRAWN):
            unknown = ~self.dynamics.knows(found)
            if not unknown.any():
                break
            found[unknown] = draw(int(unknown.sum()))
        return found


def sample_policy(agent: Agent, observations: th.Tensor) -> th.Tensor:
    """Actions of the stochastic policy in [-1, 1], (n, action_dim), each with noise of its own under gSDE, too.

    :param observations: as the policy sees them, (n, observation_dim)
    """
    if agent.use_sde:
        agent.actor.reset_noise(len(observations))
    with th.no_grad():
        return agent.policy(observations, deterministic=False)


def _sde_hold(agent: Agent) -> float:
    """For how many steps gSDE's noise is held, as in the target: SB3 draws anew with each rollout, or more often."""
    held = math.inf if _draws_by_episode(agent) else agent.train_freq.frequency
    return min(held, agent.sde_sample_freq if agent.sde_sample_freq > 0 else math.inf)


def _draws_by_episode(agent: Agent) -> bool:
    """Whether a rollout, and with it gSDE's noise, lasts for episodes."""
    return agent.train_freq.unit == TrainFrequencyUnit.EPISODE
