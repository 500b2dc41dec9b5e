"""The command ``sb3-rpto``: a thin shell over the package."""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from sb3_rpto.commands import adapt, enjoy, options, plot, recordings, train, transfer
from sb3_rpto.commands.terminal import lines, say
from sb3_rpto.ranges import THREADS, check
from sb3_rpto.version import __version__

#: Exit codes: bad input, and interrupted by the user.
BAD_INPUT, INTERRUPTED = 2, 130
#: What users can cause is said in one line; an error of ours keeps its traceback, unless it is of these kinds, too,
#: and nobody asked for it.
USER_ERRORS = (ValueError, TypeError, OSError, ImportError, NotImplementedError)

Commands = Any  # argparse's own type for a group of subcommands is private


class _Parser(argparse.ArgumentParser):
    """One line for a wrong argument, as for all bad input."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see '{self.prog} --help'")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    :param arguments: without the program's name; default: those of the process
    :return: exit code: 0 done, 2 bad input (with one line on stderr), 130 interrupted
    """
    parser = _Parser(prog="sb3-rpto", description="Move policies from a simulator to a target, and say what it lacks.")
    parser.add_argument("--version", action="version", version=f"sb3-rpto {__version__}")
    parser.add_argument("--traceback", action="store_true", help="where an error arose, in place of one line")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (train.add, transfer.add, adapt.add, enjoy.add, plot.add, _add_trace):
        add(commands)
    traceback, shown = False, warnings.formatwarning
    warnings.formatwarning = lambda message, *_: f"sb3-rpto: warning: {message}\n"  # without a line of code
    try:
        parsed = parser.parse_args(arguments)
        traceback = parsed.traceback
        run: Callable[[argparse.Namespace], int] = parsed.run
        return run(parsed)
    except KeyboardInterrupt:
        print("sb3-rpto: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        # gymnasium's own errors have no kind in common with Python's, and its import takes its time.
        if traceback or not (isinstance(error, USER_ERRORS) or type(error).__module__ == "gymnasium.error"):
            raise
        print(f"sb3-rpto: error: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
        return BAD_INPUT
    finally:
        warnings.formatwarning = shown


# --- trace ----------------------------------------------------------------------------------------------------------

TRACE = """\
Say which effect a simulator lacks to explain recordings of a machine.

The declared parameters of the model are fitted to the recordings first. Where the
fitted model still errs by more than the measurement noise, friction, delays, offsets
and two dozen other effects are tried at all joints and motors. The verdict is
complete, explained, partly explained or unexplained.
"""

TRACE_EXAMPLE = """\
example:
  sb3-rpto trace robot.xml 'runs/*.csv' --declare hinge.damping,pole.mass --out out/

writes out/report.html to read, out/report.json for programs, and the corrected
simulator: out/model.xml, which MuJoCo loads, with out/effects.json beside it.

recordings, one row a sample, SI units, named as in the MJCF:
  episode,time,qpos.hinge,qvel.hinge,ctrl.motor
qvel may be missing. More on the format: docs/measurements.md
"""


def _add_trace(commands: Commands) -> None:
    parser = commands.add_parser(
        "trace",
        help="say from recordings what a simulator lacks, and correct it",
        description=TRACE,
        epilog=TRACE_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", metavar="MODEL", help="MJCF file, or gymnasium id (Reacher-v5, package:name/Task-v0)")
    recordings.add(parser)
    parser.add_argument(
        "--out",
        metavar="DIR",
        required=True,
        type=Path,
        help="folder for the report and the model; those of an earlier trace are replaced",
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the split and the resampling (default: 0)")
    parser.add_argument(
        "--horizon",
        metavar="S",
        type=float,
        help="length of a prediction window in s (default: 0.5, or 0.8 under 15 s of data)",
    )
    parser.add_argument(
        "--calibrate",
        metavar="N",
        type=int,
        default=0,
        help="set the threshold from N data sets simulated from the fitted model (slow; default: as shipped)",
    )
    parser.add_argument(
        "--threads", metavar="N", type=int, default=0, help="that simulate (default: 0, one for each core)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress; print the verdict alone")
    parser.set_defaults(run=_trace)


def _trace(parsed: argparse.Namespace) -> int:
    from sb3_rpto.sysid import trace
    from sb3_rpto.sysid.report import figures

    # What would fail at the end fails now, before minutes of work.
    figures.require()
    if parsed.horizon is not None and not parsed.horizon > 0:
        raise ValueError(f"--horizon is {parsed.horizon:g}; give a time in s above 0")
    recordings.check_candidates(parsed.candidates)
    if parsed.calibrate < 0:
        raise ValueError(f"--calibrate is {parsed.calibrate}; give a number of data sets, or 0 for none")
    options.check_seed(parsed.seed)
    check({"--threads": THREADS}, {"--threads": parsed.threads})
    if parsed.out.exists() and not parsed.out.is_dir():
        raise ValueError(f"--out {parsed.out} is a file; give a folder")
    model = _model(parsed.model)
    recordings.check_out(parsed.out, model)
    known = recordings.known(parsed.known, model)
    data = recordings.read(parsed.files, parsed.format, parsed.rename)
    with _folder(parsed.out), _progress(parsed.quiet) as progress:
        report = trace(
            model,
            data,
            parsed.declare,
            known=known,
            seed=parsed.seed,
            candidates=parsed.candidates,
            horizon=parsed.horizon,
            calibrate=parsed.calibrate,
            threads=parsed.threads,
            simulated=parsed.simulated,
            progress=progress,
        )
    # Printed and written, whichever of the two fails.
    try:
        say(report.verdict if parsed.quiet else str(report))
    finally:
        report.save(parsed.out)
    if not parsed.quiet:
        say(f"\nwritten: {parsed.out / 'report.html'}")
    return 0


@contextlib.contextmanager
def _folder(path: Path) -> Iterator[None]:
    """A folder that can be written to; one that was made here does not stay empty behind an error."""
    made = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryFile(dir=path):
            yield
    except BaseException:
        if made:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def _model(name: str) -> Any:
    """The path of an MJCF file, or the environment of a gymnasium id."""
    if Path(name).is_file():
        return name
    if Path(name).suffix in (".xml", ".mjcf", ".urdf"):
        raise FileNotFoundError(f"there is no MJCF file {name!r}; check the path")
    import gymnasium as gym

    with contextlib.suppress(ValueError):  # a task's name, or a shift that is not registered
        return options.world(name, "MODEL").make()
    try:
        return gym.make(name)
    except (gym.error.Error, ModuleNotFoundError) as error:
        own = "; one of your own needs its module before it: module:name/Task-v0" if ":" not in name else ""
        raise ValueError(f"MODEL {name!r} is neither a file nor a gymnasium environment: {error}{own}") from error


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[float, str], None] | None]:
    """A bar where there is a terminal and rich, else a line for each thing that is done."""
    if quiet:
        yield None
        return
    try:
        from rich.console import Console
        from rich.progress import Progress, TimeElapsedColumn
    except ImportError:
        yield lines()
        return
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lines()
        return
    with Progress(*Progress.get_default_columns()[:-1], TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("reading", total=1.0)
        yield lambda share, what: bar.update(task, completed=share, description=what)


if __name__ == "__main__":
    sys.exit(main())
