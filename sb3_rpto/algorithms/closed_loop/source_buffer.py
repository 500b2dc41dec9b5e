"""D_source when the simulator was corrected: whether it is another's, and a beginning in the present one."""

from __future__ import annotations

from sb3_rpto.algorithms.closed_loop.looping import Looping
from sb3_rpto.dynamics.onestep import remembered
from sb3_rpto.dynamics.physical import PhysicalDynamics

#: Another simulator made D_source where the present one errs by so much on the oldest so many of its transitions.
OTHER, OLDEST = 0.02, 500
#: Source steps that are taken anew: of all of an episode, not of beginnings alone.
FILL = 16_000


def outdated(model: Looping, dynamics: PhysicalDynamics) -> bool:
    """Whether D_source holds what another simulator than the present one produced.

    Where the oldest transitions were overwritten, the next ones have lost the commands that late motors still act on.
    """
    side, lead = model.replay_buffer.source, 0
    if side.full:
        lead = min(remembered(dynamics.mj_model, dynamics.frame_skip) * int(model.source_steps), side.size() // 2)
    return dynamics.error(model.transitions("source").take(slice(lead + OLDEST)), lead=lead) > OTHER


def renew_source(model: Looping) -> None:
    """Drop what another simulator produced, and take the first :data:`FILL` steps in the present one.

    They begin with episodes: of one under way the commands before it are dropped too, which late motors still act on.
    """
    assert model._source_world is not None
    model.replay_buffer.source.reset()
    model._source_world.begin_anew()
    model._source_world.interact(model, FILL)
