"""Which side of the replay buffer the batches of critic and actor are drawn from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rpto.buffers import DualReplayBuffer, World

#: The actor's batches alternate: four from D_target, then one from D_source (f = 5 in the paper's appendix).
ALTERNATION = 5
#: Rows that are gathered at once, of several updates.
GATHERED = 16_384


def draw(
    buffer: DualReplayBuffer, world: World, count: int, batch_size: int, normaliser: VecNormalize | None
) -> Iterator[ReplayBufferSamples]:
    """``count`` batches of one world, gathered at once when the first is asked for, in the networks' precision."""
    if count == 0:
        return
    drawn = buffer.sample(count * batch_size, env=normaliser, world=world)
    for rows in zip(*(values.float().split(int(batch_size)) for values in drawn[:5])):
        yield ReplayBufferSamples(*rows)


def critic_batches(
    buffer: DualReplayBuffer, count: int, batch_size: int, real_ratio: float, normaliser: VecNormalize | None
) -> Iterator[ReplayBufferSamples]:
    """Batches of D_source with a share of D_target.

    :param real_ratio: that share, in [0, 1); a row of the source is left in any case
    """
    n_target = min(round(real_ratio * batch_size), batch_size - 1) if buffer.target.size() > 0 else 0
    drawn = draw(buffer, "source", count, batch_size - n_target, normaliser)
    if n_target == 0:
        return drawn
    return map(_concatenate, drawn, draw(buffer, "target", count, n_target, normaliser))


def actor_batches(
    buffer: DualReplayBuffer, from_source: Sequence[bool], batch_size: int, normaliser: VecNormalize | None
) -> Iterator[ReplayBufferSamples]:
    """A batch for each update of the actor.

    :param from_source: for each of them whether it is of D_source, else of D_target
    """
    drawn = {
        True: draw(buffer, "source", sum(from_source), batch_size, normaliser),
        False: draw(buffer, "target", len(from_source) - sum(from_source), batch_size, normaliser),
    }
    return (next(drawn[source]) for source in from_source)


def alternation(first: int, count: int) -> list[bool]:
    """For each of ``count`` updates of the actor from number ``first`` on, whether its turn is D_source's."""
    return [(first + i) % ALTERNATION == ALTERNATION - 1 for i in range(count)]


def _concatenate(a: ReplayBufferSamples, b: ReplayBufferSamples) -> ReplayBufferSamples:
    rows = (th.cat(pair) for pair in zip(a[:5], b[:5]))
    return ReplayBufferSamples(*rows)
