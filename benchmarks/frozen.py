"""What a change of structure must not change: parameters of short runs with fixed seeds, to the last bit.

    python -m benchmarks.frozen            # run all and compare with the table
    python -m benchmarks.frozen --record   # write the table anew

Bits depend on the processor and on torch: record the table from the commit before a change, on the same computer.
"""

from __future__ import annotations

import argparse
import hashlib
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from tqdm import tqdm

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.effects import LIBRARY
from sb3_rpto.envs.corrected import apply_effects

TABLE = Path(__file__).parent / "results" / "frozen_parameters.csv"
#: Target steps with one fit of the dynamics among them and updates after it, and source steps before.
STEPS, SOURCE_STEPS = 300, 500
ENSEMBLE = {"dynamics": "ensemble", "dynamics_kwargs": {"max_steps": 200}}
PHYSICAL = {"dynamics": "physical", "declared": ["pole.length", "pole2.length"]}
#: The class and the arguments of each run.
RUNS: dict[str, tuple[type[TransferAlgorithm], dict[str, Any]]] = {
    "RPO": (RPO, {}),
    "RTO, ensemble": (RTO, ENSEMBLE),
    "RPTO, ensemble": (RPTO, ENSEMBLE),
    "RTO, physical": (RTO, PHYSICAL),
    "RPTO, physical": (RPTO, PHYSICAL),
    "RPTO, residual": (RPTO, {**PHYSICAL, "dynamics": "residual"}),
    "RPTO, closed loop": (RPTO, {**PHYSICAL, "close_loop": ["coulomb_friction"], "retrain_steps": 1_000}),
}


def target() -> gym.Env:
    """A double pendulum with dry friction at its rail."""
    env = gym.make("InvertedDoublePendulum-v5")
    return apply_effects(env, [LIBRARY["coulomb_friction"]("slider", level=10.0)])


def frozen(name: str) -> dict[str, Any]:
    """One run: its target steps, and number, norm and digest of its parameters."""
    cls, settings = RUNS[name]
    network = {"net_arch": [32, 32]}
    model = cls(
        "MlpPolicy",
        "InvertedDoublePendulum-v5",
        target_env=target(),
        policy_kwargs=network,
        seed=0,
        device="cpu",
        **settings,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model.learn(STEPS, source_timesteps=SOURCE_STEPS)
    numbers = [p.detach().numpy().ravel() for p in model.policy.state_dict().values()]
    numbers.append(model.log_ent_coef.detach().numpy().ravel())
    dynamics = {} if model.dynamics is None else model.dynamics.state_dict()
    numbers += [np.asarray(v, np.float64).ravel() for v in dynamics.values() if isinstance(v, th.Tensor | np.ndarray)]
    row = np.concatenate([n.astype(np.float64) for n in numbers])
    digest = hashlib.sha256(row.tobytes()).hexdigest()[:16]
    return {
        "run": name,
        "target_steps": model.num_timesteps,
        "parameters": len(row),
        "norm": f"{np.linalg.norm(row):.10g}",
        "sha256": digest,
    }


def main() -> None:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--record", action="store_true", help="write the table anew")
    asked = parser.parse_args()
    if not (asked.record or TABLE.exists()):
        parser.error("there is no table yet: write one by --record, from the commit to compare with")
    th.set_num_threads(1)
    now = pd.DataFrame([frozen(name) for name in tqdm(RUNS, desc="runs")]).astype(str)
    if asked.record:
        TABLE.parent.mkdir(exist_ok=True)
        now.to_csv(TABLE, index=False)
        print(now.to_string(index=False))
        return
    then = pd.read_csv(TABLE, dtype=str)
    both = then.merge(now, on="run", how="outer", suffixes=(" then", " now"))
    same = (both["sha256 then"] == both["sha256 now"]).fillna(False)
    print(both.assign(same=same).to_string(index=False))
    raise SystemExit(0 if same.all() else 1)


if __name__ == "__main__":
    main()
