"""What a study needs before its first run: source agents, and oracles that say what could be reached; made once."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_rpto.baselines.transfer import transfer
from sb3_rpto.buffers import chronological, load_transitions
from sb3_rpto.evaluation.learning_curve import MakeEnv
from sb3_rpto.files import digest, write_json

#: Folder in which agents, transitions and oracles are looked for before they are made.
FOLDER_VARIABLE = "RPTO_SOURCES"
#: Transitions that are kept of a training: the newest.
KEPT = 50_000
#: Evaluations during a training, and episodes of one; of an oracle more, since its best evaluation is a reference.
CHECKS, EPISODES, ORACLE_EPISODES = 20, 10, 50


class Reference(TypedDict):
    """Returns between which a target's scores lie: of the source policy as it is, and of the oracle."""

    zero_shot: float
    oracle: float
    steps: int
    agent: str


def find(name: str, folder: Path) -> Path | None:
    """A file in the folder that :data:`FOLDER_VARIABLE` names, else in the study's own.

    :param name: of the file
    :param folder: the study's own
    :return: None where neither has it
    """
    return next(iter(_found(name, folder)), None)


def _found(name: str, folder: Path) -> list[Path]:
    given = Path(os.environ.get(FOLDER_VARIABLE, "../shared/sources"))
    return [path.resolve() for path in (given / name, folder / name) if path.is_file()]


def source_agent(name: str, make_source: MakeEnv, steps: int, folder: Path, **settings: Any) -> tuple[str, str | None]:
    """A SAC trained in a source, and its transitions: found, or trained once and kept in ``folder``.

    What is kept is the best policy by evaluations in the source.

    :param name: of the files ``<name>.zip`` and ``<name>_transitions.npz``
    :param make_source: makes the source
    :param steps: of the training
    :param folder: where they are kept
    :param settings: arguments of SAC
    :return: paths; no transitions where the agent was found without them
    """
    agent = find(f"{name}.zip", folder)
    if agent is None:
        agent = _train(name, make_source, steps, folder, settings)
    data = agent.with_name(f"{name}_transitions.npz")
    return str(agent), str(data) if data.is_file() else None


def _train(name: str, make_source: MakeEnv, steps: int, folder: Path, settings: dict[str, Any]) -> Path:
    th.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    path, data = folder / f"{name}.zip", folder / f"{name}_transitions.npz"
    model = SAC("MlpPolicy", make_source(), **{"seed": 1_000, "device": "cpu", "buffer_size": steps, **settings})
    with tempfile.TemporaryDirectory(dir=folder) as kept:
        check = EvalCallback(
            make_vec_env(make_source, n_envs=EPISODES, seed=2_000),
            n_eval_episodes=EPISODES,
            eval_freq=max(steps // CHECKS, 1),
            best_model_save_path=kept,
            verbose=0,
        )
        model.learn(steps, callback=check)
        assert model.replay_buffer is not None  # learn() has filled it
        seen = {key: array[-KEPT:] for key, array in chronological(model.replay_buffer).items()}
        names = {"obs": "observations", "act": "actions", "next_obs": "next_observations", "rew": "rewards"}
        arrays: dict[str, Any] = {short: seen[long] for short, long in names.items()}
        np.savez(Path(kept) / "transitions.npz", done=seen["terminations"], **arrays)
        load_transitions(Path(kept) / "transitions.npz")  # fails now where a run would
        os.replace(Path(kept) / "transitions.npz", data)
        os.replace(Path(kept) / "best_model.zip", path)  # last: its presence says that both are there
    return path.resolve()


def reference(name: str, agent: str, make_source: MakeEnv, make_target: MakeEnv, steps: int, folder: Path) -> Reference:
    """Returns of the source policy and of the oracle in a target: found, or measured once and kept in ``folder``.

    The oracle is the source's SAC, trained on in the target; the best of ten evaluations counts.

    :param name: of the file ``<name>_oracle.json``
    :param agent: zip of the source's SAC
    :param make_source: makes the source
    :param make_target: makes the target
    :param steps: target steps of the oracle; one that was found with other steps or of another agent is not taken
    :param folder: where it is kept
    """
    file, wanted = f"{name}_oracle.json", {"steps": steps, "agent": digest(agent)}
    for found in _found(file, folder):
        known: Reference = json.loads(found.read_text(encoding="utf-8"))
        if {key: known.get(key) for key in wanted} == wanted:
            return known
    th.set_num_threads(1)
    every = max(steps // 10, 1)
    rows = transfer("oracle", agent, make_source, make_target, steps, every=every, n_episodes=ORACLE_EPISODES)
    returns = [float(row["return"]) for row in rows]
    made = Reference(zero_shot=returns[0], oracle=max(returns), steps=steps, agent=digest(agent))
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / file, made)
    return made
