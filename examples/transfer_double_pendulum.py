"""RPTO on a pair of MuJoCo worlds: the inverted double pendulum, and one whose motor has half the strength.

    python examples/transfer_double_pendulum.py

Trains a source policy by SAC (kept in runs/double_pendulum for the next time), moves it to the target with a few
hundred target steps, fine-tunes the same policy by plain SAC for comparison, prints what was gained and what it cost,
and draws both learning curves. About three minutes on two cores the first time.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.monitor import Monitor

from sb3_rpto import RPTO
from sb3_rpto.algorithms.recorded_data import as_transitions
from sb3_rpto.baselines.sac_variants import fine_tuned_sac
from sb3_rpto.buffers import chronological
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.matmul_precision import fast_products
from sb3_rpto.evaluation.learning_curve import LearningCurve

#: Mean return in the source at which the policy counts as converged: 9,360 is the most there is.
SOLVED = 9_300


def source() -> gym.Env:
    return gym.make("InvertedDoublePendulum-v5")


def target() -> gym.Env:
    env = gym.make("InvertedDoublePendulum-v5")
    env.unwrapped.model.actuator_gear[:, 0] *= 0.5
    return env


def source_policy(folder: Path, seed: int) -> tuple[Path, Path]:
    """A SAC that balances in the source, with its replay buffer; trained once."""
    model_path, data_path = folder / f"source_{seed}.zip", folder / f"source_{seed}_data.pkl"
    if not (model_path.exists() and data_path.exists()):
        print("training a source policy (once)")
        solved = StopTrainingOnRewardThreshold(SOLVED, verbose=0)
        check = EvalCallback(Monitor(source()), callback_on_new_best=solved, eval_freq=1_000, verbose=0)
        check.eval_env.seed(seed)  # it decides when to stop
        model = SAC("MlpPolicy", source(), seed=seed, device="cpu")
        with fast_products():
            model.learn(40_000, callback=check, progress_bar=True)
        if check.best_mean_reward < SOLVED:
            print(f"the source policy reaches {check.best_mean_reward:.0f} only: try another --seed")
        model.save_replay_buffer(data_path)
        model.save(model_path)  # last: its presence says that both are there
    return model_path, data_path


def held_out(model_path: Path, n_steps: int, seed: int) -> Transitions:
    """Target transitions of the source policy that nothing learns from; they measure the model."""
    recorder = fine_tuned_sac(model_path, target(), seed, gradient_steps=0).learn(n_steps)
    return as_transitions(chronological(recorder.replay_buffer), recorder.policy, recorder.device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300, help="budget of target steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/double_pendulum"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)  # more are no quicker for networks of this size, and far slower beside other work
    model_path, data_path = source_policy(arguments.out, seed=0)
    every = max(arguments.steps // 6, 1)

    phi_0: dict[str, Any] = {}

    class Curve(LearningCurve):
        def _on_training_start(self) -> None:
            phi_0.update({k: v.clone() if th.is_tensor(v) else v for k, v in self.model.dynamics.state_dict().items()})
            super()._on_training_start()

    print("fitting phi_0 to the source's data, then transferring")
    model = RPTO.from_source(
        model_path,
        source(),
        target_env=target(),
        source_data=data_path,
        dynamics_kwargs={"hidden": (128, 128, 128)},
        seed=arguments.seed,
        device="cpu",
    )
    curve = Curve(target, every, n_episodes=10, seed=arguments.seed)
    model.learn(arguments.steps, callback=curve, progress_bar=True)
    model.save(arguments.out / "transferred.zip")

    rival = fine_tuned_sac(model_path, target(), arguments.seed)
    rival_curve = LearningCurve(target, every, n_episodes=10, seed=arguments.seed)
    rival.learn(arguments.steps, callback=rival_curve)

    unseen = held_out(model_path, 300, seed=arguments.seed + 1)
    error_after = model.dynamics.error(unseen)
    model.dynamics.load_state_dict(phi_0)
    error_before = model.dynamics.error(unseen)

    last, rival_last = curve.rows[-1], rival_curve.rows[-1]
    table = Table("", "RPTO", "SAC, fine-tuned")
    for name, key, form in (
        ("return in the target, zero-shot", None, "{:,.0f}"),
        ("return after the transfer", "return", "{:,.0f}"),
        ("target steps spent", "steps", "{:,.0f}"),
        ("updates per target step", "updates", "{:.1f}"),
        ("source (model) steps per target step", "source_steps", "{:.0f}"),
        ("seconds", "seconds", "{:.0f}"),
    ):
        cells = []
        for rows, final in ((curve.rows, last), (rival_curve.rows, rival_last)):
            value = rows[0]["return"] if key is None else final[key]
            if "per target step" in name:
                value = (value - rows[0][key]) / final["steps"]
            cells.append(form.format(value))
        table.add_row(name, *cells)
    table.add_row("model error on unseen target transitions, before", f"{error_before:.3f}", "")
    table.add_row("model error on unseen target transitions, after", f"{error_after:.3f}", "")
    Console().print(table)
    print(f"target steps by purpose: {model.target_spent}")
    labelled = [{"method": "rpto", **row} for row in curve.rows] + [
        {"method": "sac-warm", **row} for row in rival_curve.rows
    ]
    errors = {"seed": arguments.seed, "model_error_before": error_before, "model_error_after": error_after}
    pd.DataFrame(labelled).assign(**errors).to_csv(arguments.out / f"curves_{arguments.seed}.csv", index=False)
    curves = {"RPTO, ensemble": curve.rows, "SAC, fine-tuned": rival_curve.rows}
    draw(curves, "Inverted double pendulum, half the motor", arguments.out / "learning_curve.png")


def draw(curves: dict[str, list[dict[str, Any]]], title: str, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 4), constrained_layout=True)
    for label, rows in curves.items():
        axis.plot([row["steps"] for row in rows], [row["return"] for row in rows], marker="o", label=label)
    everything = [row for rows in curves.values() for row in rows]
    axis.axhline(everything[0]["return"], linestyle=":", color="grey", label="zero-shot")
    axis.set(xlabel="target steps", ylabel="return (10 episodes)", title=title)
    axis.set_ylim(0, 1.05 * np.max([row["return"] for row in everything]))
    axis.legend()
    figure.savefig(path, dpi=110)
    print(f"learning curve: {path}")


if __name__ == "__main__":
    warnings.filterwarnings("ignore", category=UserWarning, module="tqdm")
    main()
