"""Callbacks: the relativity gap as a running diagnostic, and the best policy as judged by evaluations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_rpto.algorithms.recorded_data import as_transitions
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.buffers import rows_in_order
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.evaluation.relativity_gap import Estimate, dynamics_gap_estimate, policy_gap_estimate

#: States of the newest one-step branches that stand in for the source's occupancy.
BRANCH_STATES = 2_000


class TransferCallback(BaseCallback):
    """A callback of RPO, RTO or RPTO.

    :raises TypeError: when it is given to another algorithm
    """

    model: TransferAlgorithm

    def _init_callback(self) -> None:
        if not isinstance(self.model, TransferAlgorithm):
            raise TypeError(f"{type(self).__name__} needs RPO, RTO or RPTO, got {type(self.model).__name__}")

    def _on_step(self) -> bool:
        return True


class RelativityGapCallback(TransferCallback):
    """Log both parts of Lemma 1's relativity gap from what the run has stored; never takes a step in either world.

    ``gap/dynamics`` is J(P', pi) - J(P_phi, pi), estimated by
    :func:`~sb3_rpto.evaluation.relativity_gap.dynamics_gap_estimate` on the newest whole episodes in
    D_target with the critic of the source. ``gap/policy`` is J(P_phi, pi) - J(P_phi, pi'), with pi' the policy as it
    came from the source (``snapshots["source"]``) and its critic, estimated by
    :func:`~sb3_rpto.evaluation.relativity_gap.policy_gap_estimate` on the newest whole episodes in D_source.
    One-step branches are no episodes: there it is the mean advantage over the newest branches' states, divided by
    1 - gamma, which takes these states for the discounted occupancy of pi. ``gap/dynamics_se`` and ``gap/policy_se``
    are the standard errors.

    All are gaps of soft returns (entropy bonus included; that of the policy gap at the temperature of pi') on the
    critic's reward scale, which VecNormalize may have changed. They are as good as the critics, and the episodes are
    those of the policies that collected them, not of the current one alone: read a trend, not a certificate. Recorded
    target data (``target_data``) hold no episodes of pi, so they give no ``gap/dynamics``.

    The run is the same with and without this callback: the random stream is put back.

    :param frequency: target steps between two estimates
    :param n_episodes: newest whole episodes of each world to estimate from; fewer are closer to the current policy,
        more have a smaller standard error
    :param verbose: as in SB3
    :raises ValueError: for a number below 1; at the start of training for gamma = 1, where the sums have no end
    :raises TypeError: at the start of training of SLBO, whose policy is not SAC's
    """

    def __init__(self, frequency: int = 1_000, n_episodes: int = 10, verbose: int = 0) -> None:
        super().__init__(verbose)
        for name, value in (("frequency", frequency), ("n_episodes", n_episodes)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.frequency = frequency
        self.n_episodes = n_episodes
        self._n_due = 0
        self._old: tuple[dict[str, Any], SACPolicy] | None = None

    def _init_callback(self) -> None:
        super()._init_callback()
        if self.model.gamma >= 1:
            raise ValueError(f"{type(self).__name__} needs gamma below 1, the model's is {self.model.gamma}")
        if hasattr(self.model, "trpo"):
            raise TypeError(f"{type(self).__name__} compares SAC's policies; SLBO acts by TRPO's")

    def _on_training_start(self) -> None:
        self._n_due = self.num_timesteps // self.frequency

    def _on_step(self) -> bool:
        n_due = self.num_timesteps // self.frequency
        if n_due > self._n_due:
            self._n_due = n_due
            self.model.policy.set_training_mode(False)
            with self._same_noise():
                estimates = {"dynamics": self.dynamics_gap(), "policy": self.policy_gap()}
            for name, estimate in estimates.items():
                if estimate is not None:
                    self.logger.record(f"gap/{name}", estimate.mean)
                    self.logger.record(f"gap/{name}_se", estimate.standard_error)
        return True

    def dynamics_gap(self) -> Estimate | None:
        """J(P', pi) - J(P_phi, pi) from D_target; None as long as that holds no whole episode."""
        if self.model.target_env is None:
            return None
        side = self.model.replay_buffer.target
        episodes = newest_episodes(side, self.model.target_env.num_envs, self.n_episodes)
        if not episodes:
            return None
        data = self.model.with_critic_rewards(self._transitions(side, np.concatenate(episodes)))
        return dynamics_gap_estimate(
            _split(data.rewards, episodes),
            _split(self.model.soft_value(data.next_observations), episodes),
            _split(self.model.q_value(data.observations, data.actions), episodes),
            _split(data.terminations, episodes),
            self.model.gamma,
        )

    def policy_gap(self) -> Estimate | None:
        """J(P_phi, pi) - J(P_phi, pi') from D_source; None as long as that holds nothing to estimate from.

        ``n_episodes`` of the answer counts states where the source is rolled out in branches.
        """
        side, world, gamma = self.model.replay_buffer.source, self.model.rollouts, self.model.gamma
        if isinstance(world, EpisodeSource):
            episodes = newest_episodes(side, world.env.num_envs, self.n_episodes)
            if not episodes:
                return None
            q, v = self._old_values(side.observations[np.concatenate(episodes), 0])
            return policy_gap_estimate(_split(q, episodes), _split(v, episodes), gamma)
        newest = rows_in_order(side)[-BRANCH_STATES:]
        if len(newest) < 2:
            return None
        q, v = self._old_values(side.observations[newest, 0])
        advantage = (q - v).double().cpu().numpy() / (1 - gamma)
        n = len(advantage)
        return Estimate(float(advantage.mean()), float(advantage.std(ddof=1) / np.sqrt(n)), n)

    @th.no_grad()
    def _old_values(self, observations: np.ndarray) -> tuple[th.Tensor, th.Tensor]:
        """Q'(s, a) - alpha' log pi(a|s) with a ~ pi, and V'(s), of the policy pi' that came from the source.

        Both actors draw the same noise: the estimate is exactly 0 where the policies agree.

        :param observations: (n, observation_dim), raw
        :return: two tensors (n,)
        """
        seen = self.model.normalise_observations(th.as_tensor(observations, device=self.model.device))
        old, temperature = self._old_policy()
        values = []
        for policy in (self.model.policy, old):
            with self._same_noise(), _noise_of_each(policy.actor, len(seen)):
                actions, log_prob = policy.actor.action_log_prob(seen)
            q = th.cat(old.critic_target(seen, actions), dim=1).min(dim=1)[0]
            values.append(q - temperature * log_prob.reshape(-1))
        return values[0], values[1]

    def _old_policy(self) -> tuple[SACPolicy, float]:
        """The policy as it came from the source, built once, and its temperature."""
        snapshot = self.model.snapshots["source"]
        if self._old is None or self._old[0] is not snapshot:
            policy = type(self.model.policy)(**self.model.policy._get_constructor_parameters()).to(self.model.device)
            policy.load_state_dict(snapshot["policy"])
            policy.set_training_mode(False)
            self._old = snapshot, policy
        return self._old[1], snapshot["temperature"]

    def _transitions(self, side: ReplayBuffer, rows: np.ndarray) -> Transitions:
        names = ("observations", "actions", "rewards", "next_observations")
        arrays = {name: getattr(side, name)[rows, 0] for name in names}
        arrays["terminations"] = side.dones[rows, 0] * (1 - side.timeouts[rows, 0])
        return as_transitions(arrays, self.model.policy, self.model.device)

    def _same_noise(self) -> AbstractContextManager[None]:
        """A block after which torch's random stream is where it was."""
        return th.random.fork_rng(devices=[self.model.device] if self.model.device.type == "cuda" else [])


@contextmanager
def _noise_of_each(actor: Actor, n: int) -> Iterator[None]:
    """With gSDE, a block in which each of n states has an exploration matrix of its own, as each action has its noise.

    The one that the actor explores by comes back.
    """
    held = vars(actor.action_dist).copy()
    if actor.use_sde:
        actor.reset_noise(n)
    try:
        yield
    finally:
        vars(actor.action_dist).update(held)


class KeepBest(TransferCallback):
    """Let an ``EvalCallback`` decide which policy ``rollback("best")`` goes back to.

    ``EvalCallback(eval_env, callback_on_new_best=KeepBest())``. While it is there, the returns of training episodes,
    which are of a stochastic policy and not comparable, no longer count; a policy kept by them stays only until the
    first evaluation.

    :raises ValueError: outside of an ``EvalCallback``, when ``learn()`` begins
    """

    #: what it must be in; learn() checks it, since in a list a callback knows its parent only after it is initialised
    must_be_inside = EvalCallback

    def _init_callback(self) -> None:
        super()._init_callback()
        self.model.snapshots.best_by = "evaluation"

    def _on_step(self) -> bool:
        assert isinstance(self.parent, EvalCallback)
        self.model.keep_if_best(float(self.parent.best_mean_reward))
        return True


def newest_episodes(side: ReplayBuffer, n_envs: int, n_episodes: int) -> list[np.ndarray]:
    """Rows of the newest whole episodes in one side of a :class:`~sb3_rpto.buffers.DualReplayBuffer`.

    Left out are the episodes under way, those whose start the ring may have overwritten, and where a new ``learn()``
    cut an episode off (a row does not begin where the one before it ended) that episode and the one after it.

    :param side: filled by ``n_envs`` environments in turn
    :param n_envs: number of environments
    :param n_episodes: number of episodes wanted
    :return: at most ``n_episodes`` arrays of row indices, oldest episode first
    """
    rows = rows_in_order(side)
    rows = rows[len(rows) % n_envs :].reshape(-1, n_envs)
    found: list[tuple[int, np.ndarray]] = []
    for stream in rows.T:
        ends = np.flatnonzero(side.dones[stream, 0])
        starts = np.append(0, ends + 1)
        spans = list(zip(starts, ends))[side.full :]
        whole = ((end, stream[start : end + 1]) for start, end in reversed(spans))
        found += islice((item for item in whole if _continuous(side, item[1])), n_episodes)
    found.sort(key=lambda item: item[0])
    return [episode for _, episode in found[-n_episodes:]]


def _continuous(side: ReplayBuffer, rows: np.ndarray) -> bool:
    return np.array_equal(side.observations[rows[1:]], side.next_observations[rows[:-1]])


def _split(column: th.Tensor, episodes: list[np.ndarray]) -> list[np.ndarray]:
    """A column of all rows as one array an episode."""
    return np.split(column.cpu().numpy(), np.cumsum([len(rows) for rows in episodes])[:-1])
