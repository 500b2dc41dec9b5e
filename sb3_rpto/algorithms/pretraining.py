"""Algorithm 1's input: a policy, its critic and phi_0 that know the source, before the first target step."""

from __future__ import annotations

import pathlib

from sb3_rpto.algorithms.interfaces import Agent
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.dynamics.base import Dynamics

#: Source steps that fit phi_0 when no source data are given, and the cap of gradient steps of that fit.
PHI_0_STEPS, PHI_0_UPDATES = 25_000, 5_000
#: Source steps that fill D_source before the first target step when nothing else did.
FIRST_SOURCE_STEPS = 5_000


def prepare_in_source(agent: Agent, source_timesteps: int, progress_bar: bool) -> None:
    """Bring policy, D_source and phi_0 to where Algorithm 1 starts; counts no target step.

    A model that knows nothing of the source first trains there by plain SAC. D_source then holds source transitions,
    and phi_0 is fitted to them. While all this goes on D_source is as large as it takes; the transfer begins with the
    newest ``buffer_size`` of them.
    """
    buffer = agent.replay_buffer
    if not agent.state.knows_source and source_timesteps > 0:
        buffer.resize("source", max(buffer.source.buffer_size, source_timesteps))
        train_in_source(agent, source_timesteps, progress_bar)
    agent.state.knows_source = True
    if "source" not in agent.snapshots:
        agent.take_snapshot("source")
    # A network must be fitted to describe the source; a physical model comes with the source's constants.
    learned = agent.dynamics if agent.dynamics is not None and agent.dynamics.rollout == "branches" else None
    # Neither source_data nor an earlier run gave any. A run that goes on keeps what a closed loop left it.
    if len(buffer.source_starts) == 0 and (agent.num_timesteps == 0 or buffer.source.size() == 0):
        fits = learned is not None and not learned.fitted
        wanted = PHI_0_STEPS if fits else min(FIRST_SOURCE_STEPS, agent.buffer_size)
        buffer.resize("source", max(buffer.source.buffer_size, wanted))
        collect_in_source(agent, wanted - buffer.source.size())
        if learned is not None:
            buffer.source_starts = agent.transitions("source").observations.cpu().numpy()[-PHI_0_STEPS:]
    if learned is not None and not learned.fitted:
        _fit_phi_0(agent, learned)
    buffer.resize("source", agent.buffer_size)


def collect_in_source(agent: Agent, n_steps: int) -> None:
    """Act in the source and fill D_source, in the real one for branches; nothing for ``n_steps`` <= 0."""
    assert agent.env is not None  # learn() has checked
    if n_steps <= 0:
        return
    if agent.dynamics is not None and agent.dynamics.rollout == "episodes":  # phi may have moved: its own source
        assert agent.rollouts is not None
        agent.rollouts.interact(agent, n_steps)
        return
    EpisodeSource(agent.env).interact(agent, n_steps)
    agent.env.reset()


def phi_0_updates(agent: Agent) -> int:
    """Gradient steps that fit phi_0 at most: a number of the user's bounds every fit, a preset's the later ones."""
    return min(PHI_0_UPDATES, agent.fit_bound or PHI_0_UPDATES)


def _fit_phi_0(agent: Agent, dynamics: Dynamics) -> None:
    """Let the learned dynamics describe the source before the first target step (Algorithm 1's input)."""
    data = agent.transitions("source")
    if agent.verbose:
        print(f"fitting the model of the source to {len(data):,} transitions, which may take minutes on a CPU")
    for name, value in dynamics.fit(data, max_steps=phi_0_updates(agent)).items():
        agent.logger.record(f"dynamics/phi_0_{name}", value)


def train_in_source(agent: Agent, source_timesteps: int, progress_bar: bool) -> None:
    """Plain SAC in the real source, one update per step; resumes where a checkpoint left it."""
    assert agent.env is not None  # learn() has checked
    bar = None
    if progress_bar:
        from tqdm.rich import tqdm

        bar = tqdm(total=source_timesteps, initial=agent.state.pretraining_timesteps, desc="source")
    source = EpisodeSource(agent.env, agent.take_source_observation())  # a phase that is interrupted goes on elsewhere
    agent.state.pretraining = True
    report_every = max(source_timesteps // 10, 1)
    next_report = (agent.state.pretraining_timesteps // report_every + 1) * report_every
    try:
        while agent.state.pretraining_timesteps < source_timesteps:
            warming_up = agent.state.pretraining_timesteps < agent.learning_starts
            explores = agent.use_sde and agent.use_sde_at_warmup
            steps = source.interact(agent, 1, random=warming_up and not explores)
            agent.state.pretraining_timesteps += steps
            # Also where it goes on without its buffers: the policy would be fitted to a handful of transitions.
            if agent.replay_buffer.source.size() > agent.learning_starts:
                agent.train(steps, agent.batch_size)
            if bar is not None:
                bar.update(steps)
            if agent.state.pretraining_timesteps >= next_report:
                next_report += report_every
                _report(agent, source)
    finally:
        agent.state.pretraining = False
        if bar is not None:
            bar.close()
    agent.env.reset()


def _report(agent: Agent, source: EpisodeSource) -> None:
    """Log the source phase in a group of its own and leave a checkpoint where the user gave the logger a folder."""
    for name, value in {"timesteps": agent.state.pretraining_timesteps, **source.log()}.items():
        agent.logger.record(f"pretrain/{name}", value)
    # As in every row of SB3's: readers of its files draw the rest against this one.
    agent.logger.record("time/total_timesteps", agent.num_timesteps, exclude="tensorboard")
    agent.logger.dump(step=agent.num_timesteps)
    if agent.logs_to_folder and agent.logger.dir is not None:
        folder = pathlib.Path(agent.logger.dir)
        # A process killed between the two leaves transitions of steps that the zip has not, not steps without any.
        agent.save_replay_buffer(folder / "pretrain_replay_buffer.pkl")
        agent.save(folder / "pretrain.zip")
