import os
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import pytest
import rounding
import torch as th
from filelock import FileLock
from hypothesis import settings

from benchmarks.tracing.planting import Planted, generate
from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms import pretraining
from sb3_rpto.effects import declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Report, trace
from sb3_rpto.sysid.settings import ProblemSettings, Settings

th.set_num_threads(1)
# Machines may be busy: no test is timed.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

ALGORITHMS = [RPO, RTO, RPTO]
#: RTO runs the code that RPTO runs, less RPO's term.
OURS = [RPO, pytest.param(RTO, marks=pytest.mark.slow), RPTO]
#: source steps that the networks are first fitted to
PHI_0_STEPS = 100
SMALL_POLICY = {"net_arch": [16]}
SMALL_ENSEMBLE = {"hidden": (16, 16), "n_members": 3, "n_elites": 2, "max_steps": 30}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rounding", action="store_true", help="let products and decompositions err in their last digits")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("rounding"):
        rounding.install()


@pytest.fixture(autouse=True)
def _short_source_phase(monkeypatch):
    """The collection for phi_0 takes 25,000 source steps; tests are served by fewer."""
    monkeypatch.setattr(pretraining, "PHI_0_STEPS", PHI_0_STEPS)
    monkeypatch.setattr(pretraining, "PHI_0_UPDATES", 30)
    monkeypatch.setattr(pretraining, "FIRST_SOURCE_STEPS", PHI_0_STEPS)


def pendulum(g: float = 10.0) -> gym.Env:
    return gym.make("Pendulum-v1", g=g)


def heavier(factor: float = 1.2) -> gym.Env:
    """An inverted pendulum of another mass."""
    env = gym.make("InvertedPendulum-v5")
    (mass,) = declare(env.unwrapped.model, ["pole.mass"])  # type: ignore[attr-defined]
    return apply_effects(env, [mass.with_values(factor * mass.values)])


def small(cls, env=None, target=None, **kwargs):
    """An algorithm small enough for tests; RPO takes no dynamics."""
    env = pendulum() if env is None else env
    target = pendulum(12.0) if target is None else target
    settings = {"policy_kwargs": SMALL_POLICY, "batch_size": 32, "seed": 0, "source_steps": 8, "device": "cpu"}
    settings["gradient_steps"] = 1
    settings = {name: value for name, value in settings.items() if name not in cls.unused}
    if cls.updates_dynamics and kwargs.get("dynamics", "ensemble") == "ensemble":
        settings |= {"dynamics_kwargs": SMALL_ENSEMBLE, "model_train_freq": 50}
    return cls("MlpPolicy", env, target_env=target, **{**settings, **kwargs})


# --- tracing ----------------------------------------------------------------------------------------------------------


@contextmanager
def coarsely(step: float = 0.005, **others: Any) -> Iterator[None]:
    """Measured motion is integrated in steps of 2 ms at most; tests are served by longer ones, in s.

    :param others: settings of the problem that change, too
    """
    settings = Settings(problem=ProblemSettings(longest_step=step, **others))
    with mock.patch.dict(trace.__kwdefaults__, settings=settings):
        yield


TRACED = ["coulomb_friction", "torque_offset", "command_delay"]


@pytest.fixture(scope="session")
def planted() -> Planted:
    """A pendulum with dry friction that its model does not have."""
    return generate("pendulum", [("coulomb_friction", "large")], seed=0, episodes=6, duration=2.0)


@pytest.fixture(scope="session")
def report(planted: Planted, tmp_path_factory: pytest.TempPathFactory) -> Report:
    """What a trace of it finds; not to be changed. Of the processes that share a run's tests one traces."""
    root = tmp_path_factory.getbasetemp()
    file = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "report.pickle"
    with FileLock(f"{file}.lock"):
        if not file.exists():
            found = trace(planted.xml, planted.measurements, planted.declared, candidates=TRACED, horizon=0.4)
            file.write_bytes(pickle.dumps(found))
        return pickle.loads(file.read_bytes())
