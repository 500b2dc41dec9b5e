"""Every threshold of the method, grouped by stage, with the reason beside each number.

Errors are in units of the noise, times in s, and shares between 0 and 1, unless something else is said.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ProblemSettings:
    """How recordings are split into windows, and in which steps they are simulated."""

    #: Longest integration step for measured data: a semi-implicit one of 1 ms errs by a milliradian in half a second.
    longest_step: float = 0.002
    #: Most windows to fit, and to select on.
    train_windows: int = 40
    select_windows: int = 40
    #: Fewer windows than this overlap, by a share.
    few_windows: int = 40
    overlap: float = 2 / 3
    #: Usual length of a window, and that of short training data: an effect shows more against the noise of so few.
    horizon: float = 0.5
    horizon_of_short_data: float = 0.8
    short_data: float = 15.0
    #: Where contacts come and go, windows are short and many: an error about the moment of a touch-down grows to far
    #: more than noise.
    contact_horizon: float = 0.1
    contact_windows: int = 4
    #: Contacts that change this often a second are said to come and go.
    contact_changes: float = 0.5
    #: Where steps in time seem to err by more than the noise, others so many times as short are tried.
    finer_steps: int = 4
    #: Where what is found leaves errors far above the noise, windows so many times as long show more of what is
    #: missing, and what only stands in for it shows too.
    longer_windows: int = 2


@dataclass(frozen=True)
class ConsistencySettings:
    """What can be wrong between a model and recordings."""

    #: Commands of which a larger share is outside the actuator's range are refused: they are in other units.
    clipped_share: float = 0.5
    #: A machine sampled at longer steps than this is said to be sampled slowly.
    slow_step: float = 0.02
    #: Samples farther apart than this, or nearer than this share of the model's step, are of times in another unit.
    longest_step: float = 0.5
    shortest_step: float = 0.01
    #: Dry friction with a longer time constant than this creeps by more than the noise (MuJoCo's default: 0.02).
    soft: float = 0.005
    #: A response that is later than this many samples is reported; so many are looked at.
    lag: int = 2
    most_lag: int = 25
    #: Fewest samples of a run that tell; samples in all, about two seconds for a small robot; runs, evenly spread.
    samples: int = 30
    samples_in_all: int = 40_000
    runs: int = 100
    #: Correlation that counts; where no other run is there to compare with; and by which a lag must improve it.
    correlation: float = 0.5
    certain_correlation: float = 0.7
    lag_gain: float = 0.1
    #: Needed and commanded force agree within this factor; a spring that the model lacks reverses them too.
    slope: float = 3.0


@dataclass(frozen=True)
class OriginSettings:
    """Whether recordings are a machine's, or a simulator's own."""

    #: Windows that are compared, and iterations of each fit.
    windows: int = 16
    iterations: int = 10
    #: Typical window error that leaves nothing to ask.
    enough: float = 1.1
    #: They come from the model's own steps where those err by less than this share of what fine ones do, or, where
    #: they leave nothing to ask, by less than the second.
    clear_share: float = 0.5
    share_where_enough: float = 0.8
    #: They may be exact where their noise is less than this share of what exact ones count as noisy by.
    noiseless: float = 0.03
    #: Nothing was commanded before the runs where less than this share of their first commands arrives in the first
    #: step, by so many standard deviations of that share.
    arriving_share: float = 0.75
    arriving_deviations: float = 3.0


@dataclass(frozen=True)
class RefinementSettings:
    """How fits are led out of kinks and valleys of the cost."""

    #: Shares of the windows that are fitted alone, in their turn: the next one when the last did not pay.
    shares: tuple[float, ...] = (0.5, 0.75, 0.25)
    #: A step pays when it lowers the cost to this share; at most so many are taken.
    worth: float = 0.9
    steps: int = 30
    #: Largest window error that leaves nothing to look for; exact data are met below it.
    enough: float = 2.0
    #: Iterations of a fit to a share and of one to all.
    iterations: int = 10
    #: Windows are lengthened from so many samples on.
    first_samples: int = 2
    #: Fits begin anew beside the best one until so many in a row did not pay; measured data's only where the typical
    #: window errs by less than the second.
    hops: int = 3
    hop_error: float = 3.0
    #: How far beside it, in plausible sizes: by powers of ten between these.
    hop_powers: tuple[float, float] = (-2.0, 0.0)


@dataclass(frozen=True)
class ComparisonSettings:
    """Whether one model is better than another on windows that neither was fitted to."""

    #: Effects must lower the typical window error by this share to stay.
    least_gain: float = 0.03
    #: Errors below this are none: exact data are met to rounding, where any ratio may be large.
    error_floor: float = 0.5
    #: The t of fewer blocks counts as what is as unlikely among so many: two or three may agree by chance.
    blocks: int = 6
    #: Most folds of a cross-validation.
    folds: int = 6
    #: Windows whose error is above this are missed; noise alone does not come near it.
    missed: float = 2.0
    #: What acts in few windows must save this share of the error of those that are missed without it, in so many
    #: blocks.
    rare_gain: float = 0.5
    rare_blocks: int = 3
    #: Windows left out move a parameter as if it were known beforehand to this many plausible sizes, to the power of
    #: -2: what they hardly show, like a tilt that acts to second order, would go astray.
    prior: float = 1.0


@dataclass(frozen=True)
class AdequacySettings:
    """Whether what remains is no more than noise."""

    #: R may exceed one by so much: the noise is estimated, too.
    tolerance: float = 0.06
    #: Saturation is rare and hides in medians: windows are counted whose error exceeds by this factor what noise alone
    #: exceeds in one of a hundred. More than this share, beyond that chance, are too many.
    stray_factor: float = 1.25
    stray_share: float = 0.02
    chance: float = 1e-3
    #: Resampled sets of blocks for the interval of R.
    resamples: int = 400
    #: Below it R tells of something small.
    small: float = 1.5


@dataclass(frozen=True)
class ScreeningSettings:
    """Which candidates the data could show, and which look alike."""

    #: A candidate of plausible size that moves all residuals together by less than this is not excited.
    excited: float = 4.0
    #: Candidates whose influences have a higher cosine than this are one class.
    same: float = 0.98
    #: Digits of cosines: of what is alike up to rounding, the first in the library's order is the likest.
    digits: int = 9


@dataclass(frozen=True)
class SelectionSettings:
    """Which effects are needed."""

    #: t*, well above what complete sets need to have nothing named (`benchmarks tracing threshold`: at most 2.0 in 30,
    #: most 0), as real noise is not theirs; `calibrate` measures it for the data at hand.
    threshold: float = 3.5
    #: It is this quantile of the thresholds that complete sets need.
    calibration_level: float = 0.95
    #: t* where what else lacks, not the noise, spreads the blocks: the 98 % quantile of one test is the best there is.
    threshold_far: float = 2.0
    #: Share of the error that counts there: of the many effects that would fit a little of what lacks, few are named.
    gain_far: float = 0.1
    #: t from which on an effect seems to matter.
    seems: float = 1.5
    #: A model of exact data that typically errs by less may only be held by kinks.
    nearly_exact: float = 10.0
    #: Iterations of a refit that begins at the larger model's optimum, of the joint fit, and of the last fits: where
    #: two parameters do nearly the same, a descent goes slowly along their valley.
    refit_iterations: int = 5
    joint_iterations: int = 15
    final_iterations: int = 40
    #: Effects whose removal raises the cost by less than this share, to second order, may go together.
    trifle: float = 0.01
    #: So many of the cheapest effects are tried to be dropped one by one.
    dropped: int = 3
    #: Rounds of adding effects, after a joint fit and in its place.
    rounds: int = 3
    rounds_instead: int = 8
    #: Candidates of each that are fitted to some windows, and to all.
    candidates_to_some: int = 10
    candidates_to_all: int = 4
    #: Typical window error that leaves nothing to add.
    enough: float = 1.1
    #: So many starts of an effect are fitted: those that promise most. Declared parameters are fitted from as many.
    starts: int = 3
    #: Fewer windows than these hardly show that one stretch of motion is not accounted for.
    few_windows: int = 10
    #: So many effects that meet exact data may be in the place of fewer.
    several: int = 3
    #: Finer steps in time are taken where they lower R by this share: then the steps, not the model, make it.
    finer_gain: float = 0.03
    #: A simulator's steps, so many to one of the model's, are tried where R is no more than the limit, with so few
    #: iterations of the fit; they are taken where they lower the windows' errors by this share.
    substeps: tuple[int, ...] = (1, 2, 4)
    substeps_limit: float = 3.0
    substeps_iterations: int = 5
    substeps_gain: float = 0.05
    #: So many of the nearest kinds are refined: dry friction may lie behind what holds it and more, and what gives way.
    kinds_refined: int = 4
    #: Most kinds that account for exact data together.
    kinds_together: int = 3
    #: A further one is looked for where the nearest lowers the cost to less than this share, beside the simplest whose
    #: cost is not so many times the lowest one.
    kinds_further: float = 0.8
    kinds_alike: float = 2.0
    #: Most of the missed windows that limits of joints are compared in.
    limit_windows: int = 20
    #: A soft limit gives way: it may lie so many plausible sizes inside of where the motion ended.
    limit_inside: tuple[float, ...] = (0.0, 0.2, 0.5, 1.0, 2.0)
    #: What rests on fewer blocks has no interval: one alone does not scatter.
    interval_blocks: float = 1.5


@dataclass(frozen=True)
class SubstitutionSettings:
    """Which of several effects that could stand for one another is kept."""

    #: Iterations of a fit with one effect in the place of another.
    iterations: int = 8
    #: Pairs of kept effects in whose place one is tried.
    pairs: int = 3
    #: Candidates for a substitution are the likest so many, of at least this cosine; of a kind that is nowhere kept,
    #: which could stand in all places, at least the second.
    candidates: int = 5
    like: float = 0.3
    akin: float = 0.6
    #: Of two that meet exact data the one that errs by less than this share is right, if the other errs by so much.
    right: float = 0.01
    errs: float = 0.1


@dataclass(frozen=True)
class HypothesisSettings:
    """When recordings are read in another way, or a hint is given that they should be."""

    #: Dry friction that gives way is looked for where it leaves less than this share of the error, or less than the
    #: second and no more than noise; a share below the second is told, too. Held forces are taken below the first.
    clear_share: float = 0.5
    some_share: float = 0.95
    #: A level of friction that makes MuJoCo's own constraint act.
    little_friction: float = 1e-9
    #: Iterations of fits that only look whether something else would do better.
    iterations: int = 8
    #: Another way of reading columns, another mass, or finer steps that leave less than this share are told.
    told_share: float = 0.5
    #: Windows that ways of reading are compared in; so many that promise most are fitted, with so many iterations.
    windows: int = 16
    fitted: int = 3
    fitted_iterations: int = 10
    #: Most windows that steps in time are compared in.
    step_windows: int = 40
    #: A body is looked at with these changes of its mass and of its inertia.
    mass_changes: tuple[float, ...] = (-0.3, 0.4)
    #: Windows that the typical run must have: one tells its encoder's zero, and another is to confirm it.
    windows_of_a_run: int = 2


@dataclass(frozen=True)
class Settings:
    """All thresholds of a trace."""

    problem: ProblemSettings = ProblemSettings()
    consistency: ConsistencySettings = ConsistencySettings()
    origin: OriginSettings = OriginSettings()
    refinement: RefinementSettings = RefinementSettings()
    comparison: ComparisonSettings = ComparisonSettings()
    adequacy: AdequacySettings = AdequacySettings()
    screening: ScreeningSettings = ScreeningSettings()
    selection: SelectionSettings = SelectionSettings()
    substitution: SubstitutionSettings = SubstitutionSettings()
    hypotheses: HypothesisSettings = HypothesisSettings()


#: As shipped.
DEFAULTS = Settings()
