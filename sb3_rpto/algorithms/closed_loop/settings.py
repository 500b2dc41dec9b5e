"""Every threshold of the closed loop, with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LoopSettings:
    """When to trace, what to accept, how long to learn in what was corrected, and which policy to keep."""

    # --- identify

    #: target transitions before the first trace, and new ones before another
    first_trace: int = 200
    next_trace: int = 200
    #: another trace is due when the one-step error of new transitions is so many times that after the last
    error_growth: float = 2.0
    #: smaller errors, in units of a typical step's change, are the rounding of observations
    rounding: float = 1e-6
    #: and, where the last one did not account for everything, when there are so many times as many transitions
    data_growth: int = 2
    #: so many transitions fill all windows of a trace: up to there more of noisy ones tell more
    enough_transitions: int = 400
    #: samples in a window: several steps show what acts late, and contacts do not amplify errors yet
    window: int = 4
    #: what is missing grows with the square of the time, noise does not: where there is some and no contacts come and
    #: go, windows may have so many, as long as three of four stretches of known states hold them
    noisy_window: int = 6
    short_stretches: float = 0.25

    # --- accept

    #: what is found is kept when the one-step error falls below this share of the best without it
    accepted_error: float = 0.9
    #: another simulator made D_source where the present one errs by so much on the oldest so many of its transitions
    foreign_error: float = 0.02
    oldest_transitions: int = 500

    # --- retrain

    #: source steps that are taken anew in a corrected simulator: of all of an episode, not of beginnings alone
    fill_steps: int = 16_000
    #: source steps for each update in a simulator that is new to the policy: updates cost far more, and of few steps of
    #: its own a policy learns slowly there, or loses what it knows
    steps_per_update: int = 8
    #: with D_source made anew the policy learns what it can for nothing: in rounds of so many source steps, until so
    #: many in a row earned no more than the best one and this share of it; a solved task earns a trifle more for ever
    round_steps: int = 80_000
    patience: int = 2
    least_gain: float = 1e-3

    # --- select policies

    #: episodes of an evaluation, always from the same starts: after a few a policy that is clearly behind the best one
    #: plays no further, nor does after some more one that is not ahead; all of them show who leads, as of many policies
    #: the luckiest would be taken otherwise, or one that falls now and then
    few_episodes: int = 5
    some_episodes: int = 25
    all_episodes: int = 100
    #: their most steps where the task has no end, and the seed of their starts
    longest_episode: int = 1_000
    seed: int = 30_000
    #: a lead is none by less than this share of what the best policy earns (root mean square of its episodes)
    least_lead: float = 1e-3
    #: a policy that is behind by more than this share learns no further, and the best one does: an early fall in one of
    #: all episodes is enough
    clear_loss: float = 0.03
    #: after a few episodes it must be behind by so many standard errors beside
    sure: float = 2.0
    #: updates of the policy between two evaluations
    updates_between: int = 2_000
    #: what was earned counts no longer when a number of the simulator has moved by this share of its scale
    moved: float = 1e-3
