"""Policy-adapted Dynamics Model Learning: data of policies like the present one count more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_rpto.algorithms.interfaces import Agent, SourceRollouts
from sb3_rpto.algorithms.rollouts import BranchSource
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.envs.env_copy import EnvSource
from sb3_rpto.ranges import SHARE_BELOW_1, check, whole

#: Distances between policies are means over at most so many of the newest states of D_target.
STATES = 5_000


@dataclass(frozen=True)
class Block:
    """Some consecutive target steps, and the policy at their end."""

    size: int
    actor: dict[str, th.Tensor]  # its state_dict, on the CPU


def gaussian_distance(
    mean: th.Tensor, log_std: th.Tensor, other_mean: th.Tensor, other_log_std: th.Tensor
) -> th.Tensor:
    """Pinsker's bound of the total variation between diagonal Gaussians, sqrt(KL(first || second) / 2), (n,).

    The squashing of SAC's actions changes neither side of it.

    :param mean: (n, d); so are the others
    :param log_std: its logarithmic standard deviations
    :param other_mean: of the second
    :param other_log_std: of the second
    """
    ratio = (2 * (log_std - other_log_std)).exp()
    shift = ((mean - other_mean) / other_log_std.exp()).square()
    divergence = 0.5 * (ratio + shift - 1.0 - 2 * (log_std - other_log_std)).sum(dim=1)
    return (divergence.clamp(min=0.0) / 2).sqrt()


def block_shares(distances: Sequence[float], newest_share: float) -> np.ndarray:
    """How often each block of D_target is drawn.

    An older block weighs 1 / distance. The newest one, whose distance is 0, weighs rho / (1 - rho) of all others
    together, and no less than the heaviest of them.

    :param distances: of the present policy to those at the ends of the older blocks, oldest first
    :param newest_share: rho
    :return: (len(distances) + 1,), the newest last, sum 1
    """
    older = 1.0 / np.maximum(np.asarray(distances, dtype=np.float64), 1e-8)
    newest = max(newest_share / (1.0 - newest_share) * older.sum(), older.max()) if len(older) else 1.0
    weights = np.append(older, newest)
    return weights / weights.sum()


class AdaptedBranches(BranchSource):
    """Branches that start more often where policies like the present one have been."""

    def target_rows(self, agent: Agent, n: int) -> np.ndarray:
        """Rows of D_target, drawn by :meth:`PDML.row_weights`."""
        assert isinstance(agent, PDML)
        side = agent.replay_buffer.target
        size = side.size()
        chosen = np.random.choice(size, size=n, p=agent.row_weights(size))
        return (chosen + side.pos) % size if side.full else chosen


class PDML(MBPO):
    """Policy-adapted Dynamics Model Learning, warm-started: MBPO with a sampler that follows the policy.

    Paper: https://arxiv.org/abs/2207.12141 (Wang, Wongkamjan, Jia, Huang: Live in the Moment: Learning Dynamics Model
    Adapted to Evolving Policy, ICML 2023).

    The target steps are cut into blocks. Each keeps the policy at its end, and weighs 1 / its distance from the present
    policy, see :func:`block_shares`. The weights feed the model's fits and the starts of the branches.

    :param args: as those of :class:`~sb3_rpto.baselines.mbpo.MBPO`
    :param block_steps: target steps of a block
    :param newest_share: rho, by which the newest block is guaranteed rho / (1 - rho) of the others' weight
    :param kwargs: as those of :class:`~sb3_rpto.baselines.mbpo.MBPO`
    :raises ValueError: for numbers out of range, and for ``target_data``, which no policy of this run has collected
    :raises NotImplementedError: for gSDE, whose distribution is not a Gaussian of the observation alone
    """

    def __init__(self, *args: Any, block_steps: int = 250, newest_share: float = 0.02, **kwargs: Any) -> None:
        self.block_steps, self.newest_share = block_steps, newest_share
        #: whole blocks, oldest first; what each weighs now; target steps since the last of them ended
        self.blocks: list[Block] = []
        self.shares = np.ones(1)
        self.steps_since_block = 0
        super().__init__(*args, **kwargs)

    def _check_arguments(self, offline: bool) -> None:
        super()._check_arguments(offline)
        if "target_data" in self.given_arguments:
            raise ValueError("target_data: PDML weighs blocks by the policies that collected them; pass target_env")
        if self.use_sde:
            raise NotImplementedError("use_sde=True: PDML compares Gaussian policies; leave it out")

    def _check_numbers(self) -> None:
        super()._check_numbers()
        check({"block_steps": whole(1), "newest_share": SHARE_BELOW_1}, vars(self))

    def set_target_env(self, env: EnvSource) -> None:
        """Set the target; in the place of another one, with no blocks of it."""
        replaced = self.target_env is not None
        super().set_target_env(env)
        if replaced:
            self.blocks, self.shares, self.steps_since_block = [], np.ones(1), 0

    def make_rollouts(self) -> SourceRollouts:
        """Branches that start where policies like the present one have been."""
        assert self.dynamics is not None  # it updates them
        return AdaptedBranches(self.dynamics, self.rollout_start)

    def _close_round(self) -> None:
        super()._close_round()
        self.steps_since_block += self.state.rollout_timesteps

    def update_dynamics(self) -> None:
        """End a block where one is full, then fit as MBPO does."""
        if self.steps_since_block >= self.block_steps:
            actor = {name: value.detach().cpu().clone() for name, value in self.actor.state_dict().items()}
            self.blocks.append(Block(self.steps_since_block, actor))
            self.steps_since_block = 0
            self.shares = block_shares([self.distance(block) for block in self.blocks[:-1]], self.newest_share)
            self.logger.record("dynamics/newest_share", float(self.shares[-1]))
        super().update_dynamics()

    @th.no_grad()
    def distance(self, block: Block) -> float:
        """Mean distance of the present policy to the one at a block's end, over states of D_target."""
        self.actor.set_training_mode(False)  # after updates: dropout and batch statistics would join in
        seen = self.normalise_observations(self.transitions("target").take(slice(-STATES, None)).observations)
        present = {name: value.clone() for name, value in self.actor.state_dict().items()}
        mean, log_std, _ = self.actor.get_action_dist_params(seen)
        try:
            self.actor.load_state_dict(block.actor)
            other_mean, other_log_std, _ = self.actor.get_action_dist_params(seen)
        finally:
            self.actor.load_state_dict(present)
        return float(gaussian_distance(mean, log_std, other_mean, other_log_std).mean())

    def row_weights(self, size: int) -> np.ndarray:
        """Probability of each transition of D_target, oldest first, (size,).

        Steps since the last block's end weigh as much each as those of the newest block.

        :param size: transitions that D_target holds, the newest ones of all that were collected
        """
        if not self.blocks:
            return np.full(size, 1.0 / size)
        sizes = np.array([block.size for block in self.blocks])
        each = np.repeat(self.shares / sizes, sizes)
        weights = np.append(each, np.full(self.steps_since_block, each[-1]))
        weights = np.pad(weights, (max(0, size - len(weights)), 0), mode="edge")[-size:]
        return weights / weights.sum()

    def fit_weights(self, data: Transitions) -> th.Tensor:
        """The sampler's, (n,): a weighted loss is what the weighted sampler's batches give on average."""
        return th.as_tensor(self.row_weights(len(data)) * len(data), device=self.device).float()
