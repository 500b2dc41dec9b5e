"""The loop closed on a double pendulum: what does the simulator lack, and what is a policy worth that knows?

    python examples/close_the_loop.py
    python examples/close_the_loop.py --target 2

A policy is trained in the simulator (kept in runs/double_pendulum for the next time) and meets a target whose lengths
and mass are off, which is declared, and in which something acts that nobody declared. RPTO may take a few hundred steps
there. From the first 200 it traces what is missing, adds it to the simulator and learns on there. With the loop open it
fits what is declared and traces nothing; plain SAC learns from the target alone. Printed: the report, the returns with
what they cost, the simulators' errors, and what is true of the target. Ten to forty minutes on one core the first time.
"""

from __future__ import annotations

import argparse
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from rich.console import Console
from rich.table import Table
from transfer_double_pendulum import draw, source, source_policy

from sb3_rpto import RPTO, apply_effects
from sb3_rpto.baselines.sac_variants import fine_tuned_sac
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.evaluation.learning_curve import LearningCurve
from sb3_rpto.sysid import Report

DECLARED = ("pole.length", "pole2.length", "cart.mass")


def unknown(number: int) -> list[Effect]:
    """What the simulator does not know of a target: declared numbers off by up to a fifth, and dry friction."""
    model = source().unwrapped.model
    rng = np.random.default_rng([number, *b"InvertedDoublePendulum-v5"])
    numbers = [d.with_values(d.values * rng.uniform(0.8, 1.2, 1)) for d in declare(model, DECLARED)]
    peak = np.abs(model.actuator_gear[0, 0] * model.actuator_ctrlrange[0]).max()
    return [*numbers, LIBRARY["coulomb_friction"]("slider", level=0.04 * peak)]


def make_target(number: int) -> gym.Env:
    return apply_effects(source(), unknown(number))


def compare(report: Report, number: int) -> Table:
    """What was found of the target against what is true of it."""
    found = {traced.label: traced for traced in (*report.declared, *report.effects)}
    true = {effect.label: effect for effect in unknown(number)}
    table = Table("in the target", "true", "found", "95 % interval", title="what the simulator did not know")
    for label in {**true, **found}:
        cells = ["not there" if label not in true else f"{true[label].values[0]:.5g}"]
        if label in found:
            (low, high), value = found[label].interval.T[0], found[label].effect.values[0]
            cells += [f"{value:.5g}", f"{low:.5g} to {high:.5g}"]
        table.add_row(label, *cells)
    return table


def costs(curves: dict[str, list[dict[str, Any]]]) -> Table:
    """What was earned in the target, and what was paid for it."""
    table = Table("", *curves, title="the policy in the target")
    for name, row, key, form in (
        ("return, zero-shot", 0, "return", "{:,.0f}"),
        ("return after the target steps", -1, "return", "{:,.0f}"),
        ("target steps", -1, "steps", "{:,.0f}"),
        ("updates", -1, "updates", "{:,.0f}"),
        ("source steps, in the simulator", -1, "source_steps", "{:,.0f}"),
        ("seconds", -1, "seconds", "{:,.0f}"),
        ("one-step error of the simulator as it was", -1, "source_error", "{:.2g}"),
        ("... as it is fitted", -1, "model_error", "{:.2g}"),
    ):
        cells = [rows[row].get(key) for rows in curves.values()]
        table.add_row(name, *("" if value is None else form.format(value) for value in cells))
    return table


def errors(model: Any) -> dict[str, float]:
    """One-step errors on the target's transitions, in typical changes: of the simulator as it was, and with phi."""
    if not isinstance(model, RPTO) or model.replay_buffer.target.size() < 2:
        return {}
    data, spaces = model.transitions("target"), (model.observation_space, model.action_space)
    uncorrected = PhysicalDynamics(*spaces, threads=1, **physical_config(source()))
    return {"source_error": uncorrected.error(data), "model_error": model.dynamics.error(data)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--target", type=int, default=0, help="another number is another target")
    parser.add_argument("--steps", type=int, default=250, help="budget of target steps; more than 200, to be traced")
    parser.add_argument("--retrain-steps", type=int, default=320_000, help="in the corrected simulator, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/double_pendulum"))
    arguments = parser.parse_args()
    out, seed, steps = arguments.out, arguments.seed, arguments.steps
    out.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)  # more are no quicker for networks of this size, and far slower beside other work
    model_path, data_path = source_policy(out, seed=0)
    target = partial(make_target, arguments.target)

    def learn(model: Any) -> list[dict[str, Any]]:
        curve = LearningCurve(target, [*range(50, steps, 50), steps], n_episodes=10, seed=seed, read=errors)
        model.learn(steps, callback=curve, log_interval=1_000)  # its own lines say more
        return curve.rows

    def transferred(close_loop: bool) -> RPTO:
        return RPTO.from_source(
            model_path,
            source(),
            target_env=target(),
            source_data=data_path,
            dynamics="physical",
            declared=DECLARED,
            close_loop=close_loop,
            retrain_steps=arguments.retrain_steps,
            seed=seed,
            verbose=int(close_loop),
            device="cpu",
        )

    print(f"RPTO learns from {steps} steps in the target, and from what they say of the simulator")
    model = transferred(close_loop=True)
    curves = {"RPTO, loop closed": learn(model)}
    model.save(out / "closed_loop.zip")
    print(f"RPTO learns from {steps} steps in the target, the loop open: what is declared is fitted, nothing is traced")
    curves["RPTO, loop open"] = learn(transferred(close_loop=False))
    print(f"SAC learns from {steps} steps in the target")
    curves["SAC, fine-tuned"] = learn(fine_tuned_sac(model_path, target(), seed))

    console = Console()
    if model.loop.reports:
        report = model.loop.reports[-1]
        report.save(out)
        print(f"\n{report}\n\nwritten: {out}/report.html, report.json, model.xml, effects.json, closed_loop.zip\n")
        console.print(compare(report, arguments.target))
    console.print(costs(curves))
    rows = [{"method": label, **row} for label, part in curves.items() for row in part]
    pd.DataFrame(rows).to_csv(out / f"closed_loop_{arguments.target}_{seed}.csv", index=False)
    draw(curves, f"Inverted double pendulum, target {arguments.target}", out / "closed_loop.png")


if __name__ == "__main__":
    warnings.filterwarnings("ignore", category=UserWarning, module="tqdm")
    main()
