"""What a change of structure must not change: parameters of short runs with fixed seeds, to the last bit.

    python -m benchmarks frozen            # run all and compare with the table
    python -m benchmarks frozen --record   # write the table anew
    python -m benchmarks frozen --traces runs/tracing.csv   # verdicts, effects and values of the quick sets

Bits depend on the processor and on torch: record the table from the commit before a change, on the same computer.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th

from benchmarks import RESULTS
from benchmarks.runner import Row, chosen, parser_of, read_table, run_jobs
from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.effects import LIBRARY
from sb3_rpto.envs.corrected import apply_effects

TABLE = RESULTS / "frozen_parameters.csv"
#: Verdicts, effects and values of the quick sets of the tracing study, from the commit before the change.
TRACES = RESULTS / "frozen_traces.csv"
#: Values that differ by less, relative to the larger, are the same: the table has six digits.
SAME = 2e-5
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
    "RPTO, closed loop": (
        RPTO,
        {**PHYSICAL, "close_loop": True, "effects": ["coulomb_friction"], "retrain_steps": 1_000},
    ),
}


def target() -> gym.Env:
    """A double pendulum with dry friction at its rail."""
    env = gym.make("InvertedDoublePendulum-v5")
    return apply_effects(env, [LIBRARY["coulomb_friction"]("slider", level=10.0)])


@dataclass(frozen=True)
class Job:
    """A run by its name."""

    name: str


def frozen(job: Job) -> list[Row]:
    """One run: its target steps, and number, norm and digest of its parameters."""
    cls, settings = RUNS[job.name]
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
    assert model.log_ent_coef is not None
    numbers = [p.detach().numpy().ravel() for p in model.policy.state_dict().values()]
    numbers.append(model.log_ent_coef.detach().numpy().ravel())
    dynamics = {} if model.dynamics is None else model.dynamics.state_dict()
    numbers += [np.asarray(v, np.float64).ravel() for v in dynamics.values() if isinstance(v, th.Tensor | np.ndarray)]
    row = np.concatenate([n.astype(np.float64) for n in numbers])
    digest = hashlib.sha256(row.tobytes()).hexdigest()[:16]
    counts = {"target_steps": model.num_timesteps, "parameters": len(row)}
    return [{"run": job.name, **counts, "norm": f"{np.linalg.norm(row):.10g}", "sha256": digest}]


def compare_traces(table: Path, frozen_table: Path = TRACES) -> pd.DataFrame:
    """A table of the tracing study beside the frozen one: a row for each set that both have.

    :param table: as ``python -m benchmarks tracing --out NAME`` writes it
    :param frozen_table: what it is compared with
    :return: verdicts and effects then and now, the largest relative difference of a value, and whether all are the same
    :raises ValueError: they have no set in common
    """
    then = {row["set"]: row for row in read_table(frozen_table)}
    rows = []
    for row in read_table(table):
        known = then.get(row["id"])
        if known is None:
            continue
        values = _values(row)
        labels = " ".join(effect["label"] for effect in row["effects"])
        old = known["values"]
        pairs = [(old[name], values[name]) for name in old if name in values]
        off = max((abs(a - b) / max(abs(a), abs(b), 1e-12) for a, b in pairs), default=0.0)
        alike = (row["verdict"], labels, {*values}) == (known["verdict"], known.get("effects") or "", {*old})
        found = {"set": row["id"], "verdict": row["verdict"], "effects": labels, "off": off}
        rows.append({**found, "same": alike and off < SAME})
    if not rows:
        raise ValueError(f"{table} has none of the sets of {frozen_table}; run 'python -m benchmarks tracing' first")
    return pd.DataFrame(rows)


def _values(row: Row) -> dict[str, float]:
    """Fitted values by the parameter's name, of effects with their label before it."""
    declared = {name: p["value"] for one in row["declared"] for name, p in one["parameters"].items()}
    named = {f"{e['label']}.{name}": p["value"] for e in row["effects"] for name, p in e["parameters"].items()}
    return declared | named


def main(arguments: Sequence[str] | None = None) -> int:
    """Record or compare.

    :param arguments: without the study's name; default: those of the process
    :return: exit code, 1 where parameters are others
    """
    parser = parser_of("frozen", __doc__, "frozen")
    parser.add_argument("--record", action="store_true", help="write the table anew")
    parser.add_argument("--traces", type=Path, metavar="CSV", help="compare this table of the tracing study instead")
    asked = parser.parse_args(arguments)
    if asked.traces is not None:
        compared = compare_traces(asked.traces)
        print(compared.to_string(index=False))
        return 0 if compared["same"].all() else 1
    listed = chosen([Job(name) for name in RUNS], asked.only)
    if asked.list:
        print(*(job.name for job in listed), sep="\n")
        return 0
    table = asked.out.with_name(f"{asked.out.name}.csv") if asked.out else TABLE
    if not (asked.record or table.exists()):
        parser.error("there is no table yet: write one by --record, from the commit to compare with")
    # One after the other in this process, unless asked otherwise: threads of others change no last digit.
    results = run_jobs(frozen, listed, asked.runs, asked.workers or 1, asked.backend, fresh=True)
    now = pd.DataFrame([row for result in results for row in result["rows"]]).astype(str)
    if asked.record:
        table.parent.mkdir(exist_ok=True)
        now.to_csv(table, index=False)
        print(now.to_string(index=False))
        return 0
    then = pd.read_csv(table, dtype=str)
    then = then[then["run"].isin([job.name for job in listed])]
    both = then.merge(now, on="run", how="outer", suffixes=(" then", " now"))
    same = (both["sha256 then"] == both["sha256 now"]).fillna(False)
    print(both.assign(same=same).to_string(index=False))
    return 0 if same.all() else 1
