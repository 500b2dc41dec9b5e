"""What recordings are read and checked by: each number with its reason."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DataSettings:
    """Thresholds of reading, checking and repairing recordings; shares are of 1, angles in rad, times in s."""

    # --- rows and clocks ---
    #: Fewest samples of a run: a cubic needs four points, one more leaves something to smooth.
    min_rows: int = 5
    #: Fewest transitions of an episode: one tells no acceleration.
    min_transitions: int = 2
    #: A step in time of more than so many median steps is a gap.
    gap: float = 5.0
    #: A sample is missing in a step of more than so many median steps where the clock is regular.
    missing_row: float = 1.5
    #: The clock jitters where 5 % of the steps are off the median by more than this share of it.
    jitter: float = 0.05
    #: A clock that jitters by less than this share of its interval is even.
    slight_jitter: float = 0.005
    #: A stamp that is off an even clock by more than this share of its interval is another sample's.
    stamp_offset: float = 0.45
    #: An even clock must take this share off the variance of the differences, where the joint moves fast.
    even_clock_gain: float = 0.05
    #: Order of the divided differences that tell smooth motion from noise.
    difference_order: int = 4
    #: Clocks of two runs that differ by this factor have other units: s and ms differ by 1000, s and min by 60.
    clock_ratio: float = 100.0
    #: Times must be told as finely as this, or tolerances of a clock are below the rounding of a double.
    finest_time: float = 1e-10
    #: A clock comes in bursts where more than this share of its steps are gaps ...
    burst_share: float = 0.1
    #: ... and the mean step is so many times the median.
    burst_ratio: float = 3.0

    # --- positions ---
    #: Fewest fresh readings that tell whether positions are held between them.
    held_readings: int = 20
    #: Fewest different changes of held positions: a coarse encoder makes one or two.
    held_changes: int = 5
    #: An angle is too fast for its samples where more than this share of its steps are about half a turn.
    fast_angle: float = 0.05
    #: A step is no motion, and a sample no reading, where it stands out of all others by so many times.
    jump: float = 8.0
    #: At most this share of the steps are jumps; more are the motion itself.
    jump_share: float = 0.02
    #: What moves within so many s of an unusual command may answer it.
    command_answer: float = 0.1
    #: At most this share of the samples is interpolated; more may be motion.
    glitch_share: float = 0.01
    #: Norms of quaternions beyond this are no rounding of 1 in a file ...
    quaternion_rounding: float = 1e-6
    #: ... beyond this a finding ...
    quaternion_finding: float = 1e-3
    #: ... and beyond this no quaternions.
    quaternion_norm: float = 0.05
    #: Another convention of rotations fits where it leaves at most this share of what MuJoCo's leaves.
    convention: float = 0.5

    # --- velocities ---
    #: Slopes of a measured velocity against the position's change that filters and units leave.
    slope: tuple[float, float] = (0.8, 1.25)
    #: Samples over which velocity and change of position are compared: longer than filters are late.
    slope_span: int = 16
    #: Samples of the filter that differentiates positions.
    filter_rows: int = 9
    #: Time that this filter spans where noisy forces are looked at, s.
    filter_time: float = 0.06

    # --- angles and the model ---
    #: Hinges that move over more turns than this may be in degrees.
    large_angle: float = 2.0
    #: Known forces must explain this share of the acceleration's square, read in degrees, to tell degrees ...
    explained_in_degrees: float = 0.7
    #: ... and no more than this, read in rad: it accelerates 57 times too fast then.
    explained_in_radians: float = 0.0
    #: Samples that this is judged by in all.
    degrees_rows: int = 3000
    #: Fewest samples of one run for it.
    degrees_run: int = 30
    #: Steps in degrees of an angle that wraps at 360.
    degrees_step: float = 270.0
    #: Span in degrees of an angle that wraps at 360, with 1 % for rounding.
    degrees_span: float = 363.6
    #: A slide that moves over so many times its limits is in other units, by whatever zero: 100 or 1000 are those.
    slide_units: float = 10.0
    #: A position this far beyond its limits is said to be, in rad or m: limits give way a little.
    beyond_limits: float = 0.1
    #: A servo that is within this of its command, but for whole turns, in half of the samples, holds it.
    servo_holds: float = 0.5

    # --- observations and splits ---
    #: Draws from which the noise of states follows from that of observations: 1 % of a standard deviation.
    noise_draws: int = 10_000
    #: A speed within so many standard deviations of its observation's bound may be beyond it.
    bound_margin: float = 4.0
    #: A split is drawn so often before the shortest runs are set apart.
    split_draws: int = 100


#: Those that are used.
DATA = DataSettings()
