"""A burst of updates leaves the device alone.

Torch's meta device stands for a GPU: its tensors hold no numbers, so reading one back raises an error, and so does
mixing it with tensors of the CPU.
"""

import numpy as np
import pytest
import torch as th
from conftest import pendulum

from sb3_rpto import RPO, RPTO
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.dynamics.ensemble import EnsembleDynamics, _Examples

BATCH = 32


class Stream(th.Generator):
    """A stream of the CPU's for any device: there is none of the meta device."""

    def __new__(cls, device=None):
        return super().__new__(cls)


def rows(n: int, model) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    observation, action = model.observation_space.shape[0], model.action_space.shape[0]
    return {
        "observations": rng.normal(size=(n, observation)),
        "next_observations": rng.normal(size=(n, observation)),
        "actions": rng.uniform(-1, 1, (n, action)),
        "rewards": rng.normal(size=n),
        "dones": np.zeros(n),
    }


@pytest.fixture
def made(monkeypatch):
    """Makes a model on the meta device, with both buffers filled."""
    monkeypatch.setattr(th, "Generator", Stream)

    def make(cls, **kwargs):
        kwargs = {"buffer_size": 400, "batch_size": BATCH, "seed": 0, **kwargs}
        model = cls("MlpPolicy", pendulum(), target_env=pendulum(12.0), device="meta", **kwargs)
        for world in ("source", "target"):
            model.replay_buffer.append(world, **rows(300, model))
        model._setup_learn(1)
        model.state.pretraining = False
        return model

    return make


@pytest.fixture
def reads(monkeypatch):
    """The lists that were read from the device."""
    read = []

    def tolist(tensor):
        read.append(len(tensor))
        return [0.0] * len(tensor)

    monkeypatch.setattr(th.Tensor, "tolist", tolist)
    return read


@pytest.mark.parametrize(
    ("cls", "kwargs", "losses"),
    [
        (RPO, {}, 4),
        (RPO, {"ent_coef": 0.2}, 3),
        pytest.param(RPO, {"policy_kwargs": {"optimizer_class": th.optim.RMSprop}}, 4, marks=pytest.mark.slow),
        (RPTO, {"real_ratio": 0.5, "dynamics_kwargs": {"hidden": (8,), "termination_fn": None}}, 4),
    ],
    ids=["learned-temperature", "fixed-temperature", "another-optimizer", "batches-of-both-worlds"],
)
@pytest.mark.filterwarnings("ignore:EnsembleDynamics learns terminations")
def test_a_burst_reads_its_losses_at_the_end_and_nothing_else(cls, kwargs, losses, made, reads):
    model = made(cls, **kwargs)
    model.train(20, BATCH)
    assert reads == [20] * losses


def test_reading_within_a_burst_would_be_noticed(made, reads, monkeypatch):
    model, loss = made(RPO), TransferAlgorithm.critic_loss
    monkeypatch.setattr(RPO, "critic_loss", lambda self, *given: loss(self, *given) * float(self.temperature()))
    with pytest.raises(RuntimeError, match="meta"):
        model.train(2, BATCH)


def test_a_tensor_of_another_device_would_be_noticed(made, reads, monkeypatch):
    model, loss = made(RPO), TransferAlgorithm.critic_loss
    monkeypatch.setattr(RPO, "critic_loss", lambda self, *given: loss(self, *given) + th.ones(BATCH).mean(0, True))
    with pytest.raises(RuntimeError, match="device"):
        model.train(2, BATCH)


@pytest.fixture
def ensemble(monkeypatch):
    monkeypatch.setattr(th, "Generator", Stream)
    env = pendulum()
    return EnsembleDynamics(
        env.observation_space,
        env.action_space,
        hidden=(8, 8),
        n_members=3,
        n_elites=2,
        termination_fn=lambda observations, actions, following: observations[:, 0] > 1,
    ).to("meta")


def test_rollouts_stay_on_the_device(ensemble):
    observations, actions = th.zeros(700, 3, device="meta"), th.zeros(700, 1, device="meta")
    for deterministic in (False, True):
        answer = ensemble.step(observations, actions, deterministic)
        assert {answer.next_observations.device, answer.rewards.device, answer.terminations.device} == {
            observations.device
        }


def test_an_epoch_of_the_ensembles_fit_stays_on_the_device(ensemble):
    sizes = {"inputs": (300, 4), "targets": (300, 4), "terminations": (300,), "weights": (300,)}
    examples = _Examples(**{name: th.zeros(size, device="meta") for name, size in sizes.items()})
    loss, steps = ensemble._train_epoch(examples.normalised(), max_steps=100)
    assert (loss.device.type, steps) == ("meta", 20)
    nll, error = ensemble._judge(examples)
    assert {nll.device.type, error.device.type} == {"meta"}
