"""From SAC's policy to one that TRPO can train: the same mean, a Gaussian around it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_rpto.baselines.regression import regress

#: Gradient steps that fit the value, and Adam's rate for them.
VALUE_STEPS, VALUE_RATE = 4_000, 1e-3
#: Standard deviations smaller than this, in half action ranges, leave TRPO nothing to learn from.
SMALLEST_STD = 0.05


class WithinBounds(nn.Module):
    """[-1, 1] -> the range of the actions.

    :param space: of the actions
    """

    reach: th.Tensor
    middle: th.Tensor

    def __init__(self, space: spaces.Box) -> None:
        super().__init__()
        self.register_buffer("reach", th.as_tensor((space.high - space.low) / 2).float())
        self.register_buffer("middle", th.as_tensor((space.high + space.low) / 2).float())

    def forward(self, scaled: th.Tensor) -> th.Tensor:
        """Actions in the environment's units, (n, action_dim)."""
        return self.middle + self.reach * scaled


class SquashedMeanPolicy(ActorCriticPolicy):
    """A Gaussian policy whose mean is squashed into the action range, as SAC's deterministic action is.

    So it can be an exact clone: regression of an unbounded mean on actions at their bounds costs most of the return.
    """

    action_space: spaces.Box

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Sequential(self.action_net, nn.Tanh(), WithinBounds(self.action_space))


def clone_kwargs(teacher: SAC) -> dict[str, Any]:
    """``policy_kwargs`` of a :class:`SquashedMeanPolicy` that can clone a SAC's policy.

    :param teacher: the SAC
    :raises NotImplementedError: for gSDE, whose noise is not a Gaussian around the mean
    """
    if teacher.use_sde:
        raise NotImplementedError("use_sde=True: a policy with gSDE cannot be cloned for TRPO; train SAC without it")
    widths = list(teacher.actor.net_arch)
    return {"net_arch": {"pi": widths, "vf": widths}, "activation_fn": teacher.actor.activation_fn}


def clone(
    policy: ActorCriticPolicy, teacher: SAC, observations: np.ndarray, value_steps: int = VALUE_STEPS
) -> dict[str, float]:
    """Clone a SAC policy, and fit the value.

    The mean becomes the teacher's deterministic action. The standard deviation is that of the teacher's actions around
    it, one number for each dimension. The value is regressed on min_i Q_i(s, a) of the teacher's target critics at
    that action (so it holds the teacher's entropy bonus).

    :param policy: is changed; a :class:`SquashedMeanPolicy` built with :func:`clone_kwargs`
    :param teacher: the SAC
    :param observations: (n, observation_dim), states of the source as the networks see them (normalised, where that is
        done)
    :param value_steps: gradient steps of the value
    :return: ``value_rmse`` of the last steps, and ``std``, the mean of the standard deviations in half action ranges
    :raises ValueError: without observations
    """
    if len(observations) == 0:
        raise ValueError("observations: value and noise have no states to be fitted on; pass some of the source")
    device, actor = policy.device, teacher.actor
    policy.mlp_extractor.policy_net.load_state_dict(actor.latent_pi.state_dict())
    head: Any = policy.action_net
    head[0].load_state_dict(actor.mu.state_dict())
    seen = th.as_tensor(observations, device=teacher.device).float()
    with th.no_grad():
        means = actor(seen, deterministic=True)
        drawn = actor(seen, deterministic=False)
        values = th.cat(teacher.critic_target(seen, means), dim=1).min(dim=1)[0].to(device)
    std = (drawn - means).square().mean(dim=0).sqrt().clamp(min=SMALLEST_STD).to(device)
    policy.log_std.data.copy_((std * head[2].reach).log())
    modules = (policy.mlp_extractor.value_net, policy.value_net)
    optimizer = th.optim.Adam([p for module in modules for p in module.parameters()], lr=VALUE_RATE)
    loss = regress(lambda states: policy.predict_values(states)[:, 0], optimizer, seen.to(device), values, value_steps)
    return {"value_rmse": loss**0.5, "std": float(std.mean())}
