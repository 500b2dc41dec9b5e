"""The networks' model of the source, fitted once for all runs of a study that begin alike."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from benchmarks.provenance import commit, versions
from sb3_rpto.algorithms import pretraining
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.files import json_text, write_atomically


def fit_once(model: TransferAlgorithm, folder: Path) -> None:
    """Give the model phi_0 before ``learn()`` would fit it: as an earlier run left it, else fitted here and kept.

    phi_0 depends on the source's transitions, on the networks as they were initialised, their settings and their random
    stream, not on the target: what is kept is, to the last bit, what the run would have come to by itself. Nothing is
    done where no networks are to be fitted, where the source's transitions are yet to be collected, or in a checkout
    with changes, whose fits nothing would tell apart.

    :param model: as it was constructed
    :param folder: where fits are kept, by what they depend on
    """
    dynamics = model.dynamics
    if dynamics is None or dynamics.rollout != "branches" or dynamics.fitted or not model.replay_buffer.source.size():
        return
    made_by = commit()
    if made_by is not None and made_by.endswith("-dirty"):
        return
    data = model.transitions("source")
    settings = [
        json_text(model.dynamics_config),
        str(model.device),
        pretraining.phi_0_updates(model),
        versions(),
        made_by,
    ]
    path = folder / f"phi_0_{_digest([vars(data), dynamics.state_dict(), settings])}.pt"
    if path.is_file():
        kept = th.load(path, map_location=model.device, weights_only=True)
        dynamics.load_state_dict(kept["model"])
        dynamics.optimizer.load_state_dict(kept["optimizer"])
        return
    dynamics.fit(data, max_steps=pretraining.phi_0_updates(model))
    state = {"model": dynamics.state_dict(), "optimizer": dynamics.optimizer.state_dict()}
    write_atomically(path, lambda file: th.save(state, file), "pt")


def _digest(value: Any) -> str:
    """Of tensors and plain values in dictionaries and lists, the same in every process."""
    digest = hashlib.sha256()

    def add(part: Any) -> None:
        if isinstance(part, dict):
            part = [item for name in sorted(part) for item in (name, part[name])]
        if isinstance(part, list | tuple):
            for one in part:
                add(one)
            return
        array = part.detach().cpu().numpy() if isinstance(part, th.Tensor) else np.array(str(part))
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())

    add(value)
    return digest.hexdigest()[:16]
