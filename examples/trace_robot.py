"""A "robot" has something in it that its makers' model lacks: record it, trace it, correct the model.

python examples/trace_robot.py --seed 0
python examples/trace_robot.py --outside

Nothing but the package is needed: the robot is a simulation in plain NumPy that shares no code with MuJoCo or the
tracer. What is in it is drawn by the seed and said in a sealed envelope, which is opened at the end.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))  # the checkout, whose benchmarks simulate the robot

from benchmarks.tracing.planting import KINDS, SYSTEMS, draw, generate, places
from benchmarks.tracing.truth import as_effect, deviation, twins
from sb3_rpto.effects import Effect
from sb3_rpto.effects.corrected_model_io import load_corrected
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.shooting.prediction_errors import horizon_errors

MACHINE = "pendulum"
RATE, NOISE = 250.0, 1e-3  # samples a second; noise of the encoder in rad


@dataclass(frozen=True)
class Envelope:
    """The truth about a robot. Sealed: nothing before the last lines of :func:`main` opens it."""

    _label: str
    _effect: Effect | None  # None: it is outside the library, so the right answer is that nothing explains it
    _declared: dict[str, float]

    def open(self) -> tuple[str, Effect | None, dict[str, float]]:
        return self._label, self._effect, self._declared


def robot(
    seed: int, episodes: int = 8, duration: float = 4.0, library: bool = True
) -> tuple[Measurements, str, tuple[str, ...], Envelope]:
    """Recordings, the makers' model (MJCF), the parameters that they are unsure of, and the envelope.

    The effect that nobody declared is drawn from all that the machine can have and the library holds, or does not; the
    declared parameters are off by up to 15 %.
    """
    machine = SYSTEMS[MACHINE]
    kinds = [kind for kind, plant in KINDS.items() if plant.library == library and places(machine, kind)]
    plant = draw(machine, kinds[np.random.default_rng(seed).integers(len(kinds))], "large", seed)
    made = generate(machine, [plant], seed, episodes, duration, RATE, noise=NOISE)
    effect = as_effect(machine, plant) if plant.library else None
    label = effect.label if effect else f"{plant.kind} {plant.parameters}"
    return made.measurements, made.xml, made.declared, Envelope(label, effect, made.truth.declared)


def write_log(data: Measurements, folder: Path) -> None:
    """One CSV file for each run, as a robot's logger would leave them."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("run*.csv"):
        old.unlink()
    names = [f"{what}.{name}" for what in ("qpos", "qvel", "ctrl") for name in getattr(data.columns, what)]
    for number, e in enumerate(data.episodes):
        rows = np.column_stack([e.time, e.qpos, e.qvel, e.ctrl])
        with (folder / f"run{number:02d}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["time", *names])
            writer.writerows([[f"{value:.6f}" for value in row] for row in rows])


def progress(share: float, what: str) -> None:
    print(f"\r[{share:4.0%}] {what:<60}", end="", file=sys.stderr)


def check_saved(folder: Path, report: Report, test: Measurements) -> None:
    """The corrected model, loaded again, predicts runs that nothing was fitted to."""
    corrected = load_corrected(folder)
    simulation = corrected.simulation()  # MuJoCo's model, with what MJCF cannot hold around it
    again = horizon_errors(simulation, simulation.values(), test, report.sigma, report.seed)
    print(f"{folder}/model.xml and effects.json, loaded again, on the test runs (RMSE in mrad):")
    for before, after in zip(report.before, again, strict=True):
        at = before.horizon if isinstance(before.horizon, str) else f"{before.horizon:g} s"
        for j, joint in enumerate(after.joints):
            print(f"  {at:9}  {joint}  {1e3 * before.rmse[j]:7.2f} before, {1e3 * after.rmse[j]:7.2f} corrected")


def compare(report: Report, envelope: Envelope) -> None:
    """What was found against what is true."""
    label, effect, declared = envelope.open()
    print(f"the envelope says: {label}")
    named = {t.label: t for t in report.effects}
    like = [name for name, t in named.items() if label in t.alike or twins(MACHINE, label, name)]
    if effect is None:
        right = "right" if report.verdict != "explained" else "WRONG"
        print(f"  no effect of the library is that; the verdict {report.verdict!r} is {right}")
    elif label in named:
        found = named[label]
        values = [{p.name: float(v) for p, v in zip(e.parameters, e.values)} for e in (effect, found.effect)]
        print(f"  named itself, its values {deviation(effect.kind, *values):.1%} off")
        for p, (low, high) in zip(effect.parameters, found.interval.T):
            true, value = (v[p.name] for v in values)
            print(f"  {p.name}: found {value:.4g} [{low:.4g}, {high:.4g}] {p.unit}, true {true:.4g}")
    else:
        print(f"  named {like[0]}, which these data cannot tell from it" if like else "  MISSED")
        if like:
            print("  (declared values belong to the effect that is named: they may be far off here)")
    others = [name for name in named if name != label and name not in like[:1]]
    if effect is not None and others:
        print(f"  named beside it, wrongly: {', '.join(others)}")
    for t in report.declared:
        true, value = declared[t.label], float(t.effect.values[0])
        print(f"  {t.label}: found {value:.4g} {t.effect.parameters[0].unit}, true {true:.4g}, {value / true - 1:+.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="another seed is another robot")
    parser.add_argument("--outside", action="store_true", help="a robot with something that no effect explains")
    parser.add_argument("--out", type=Path, default=Path("runs/trace_robot"))
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--duration", type=float, default=4.0, help="of an episode in s")
    parser.add_argument("--candidates", help="kinds of effects to look for, K1,K2 (default: all in the library)")
    arguments = parser.parse_args()

    measured, xml, declared, envelope = robot(
        arguments.seed, arguments.episodes, arguments.duration, not arguments.outside
    )
    log = arguments.out / "log"
    write_log(measured, log)

    # From here on: the log, the model and the names. That is all that you have of a robot, too.
    began = time.perf_counter()
    data = Measurements.from_csv(log / "run*.csv")
    kinds = arguments.candidates.split(",") if arguments.candidates else None
    report = trace(xml, data, declared, seed=arguments.seed, candidates=kinds, progress=progress)
    print(f"\rtraced {len(data.episodes)} runs in {time.perf_counter() - began:.0f} s{'':50}\n", file=sys.stderr)
    print(f"{report}\n")
    report.save(arguments.out)
    print(f"written: {arguments.out}/report.html, report.json, model.xml, effects.json\n")
    _, _, test = data.split(arguments.seed)
    check_saved(arguments.out, report, test)
    print()
    compare(report, envelope)


if __name__ == "__main__":
    main()
