"""What is refused before anything is built, each check by itself."""

import gymnasium as gym
import numpy as np
import pytest
from conftest import ALGORITHMS, SMALL_ENSEMBLE, pendulum, small
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.monitor import Monitor

from sb3_rpto import RPO, RPTO
from sb3_rpto.algorithms import arguments

VALUES = {
    "dynamics": "ensemble",
    "weighting": "paper",
    "rollout_start": "mix",
    "real_ratio": 0.05,
    "weight_floor": 0.5,
    "source_steps": 20,
    "model_train_freq": 250,
    "batch_size": 256,
    "buffer_size": 1_000,
}


class Matrix(gym.Env):
    """Two rows of actions."""

    observation_space = spaces.Box(-1, 1, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (2, 2), np.float32)

    def reset(self, *, seed=None, options=None):
        return np.zeros(3, np.float32), {}


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_actions_that_are_not_flat_are_refused_at_construction(cls):
    with pytest.raises(NotImplementedError, match=r"shape \(2, 2\).*TransformAction"):
        small(cls, Matrix(), Matrix())


def test_what_is_allowed_passes():
    arguments.check_values(**VALUES)
    arguments.check_supported(1, False, None)
    arguments.check_applicable("RPO", False, {"env", "real_ratio"})
    arguments.check_applicable("RPTO", True, arguments.DYNAMICS_ARGUMENTS)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dynamics", "gp"),
        ("weighting", "centered"),
        ("rollout_start", "middle"),
        ("real_ratio", 1.0),
        ("real_ratio", -0.1),
        ("weight_floor", -1e-9),
        ("source_steps", "auto"),
        ("source_steps", 0),
        ("model_train_freq", 2.5),
    ],
)
def test_a_wrong_value_is_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}"):
        arguments.check_values(**{**VALUES, name: value})


@pytest.mark.parametrize(
    ("passed", "named"),
    [
        ((3, False, None), "n_steps"),
        ((1, True, None), "optimize_memory_usage"),
        ((1, False, DictReplayBuffer), "replay_buffer_class=DictReplayBuffer"),
    ],
)
def test_what_is_not_supported_is_named(passed, named):
    with pytest.raises(NotImplementedError, match=named):
        arguments.check_supported(*passed)


def test_arguments_without_use_are_named():
    with pytest.raises(ValueError, match=r"RPO does not use \['declared', 'weighting'\]"):
        arguments.check_applicable("RPO", False, {"env", "weighting", "declared"})


@pytest.mark.parametrize(
    ("kinds", "error", "message"),
    [(["coulomb"], ValueError, "close_loop.*coulomb_friction"), ("coulomb_friction", TypeError, "close_loop must be")],
)
def test_effects_to_look_for_are_checked_at_once(kinds, error, message):
    env, target = (gym.make("InvertedDoublePendulum-v5") for _ in range(2))
    with pytest.raises(error, match=message):
        small(RPTO, env, target, dynamics="physical", dynamics_kwargs={}, close_loop=kinds)


@pytest.mark.parametrize("rule", ["reward_fn", "termination_fn"])
@pytest.mark.parametrize("answer", [lambda o, a, n: np.zeros(len(o)), lambda o, a, n: o])
def test_rules_that_answer_in_another_form_are_refused_at_once(rule, answer):
    with pytest.raises(ValueError, match=rf"dynamics_kwargs\['{rule}'\] must answer"):
        small(RPTO, dynamics_kwargs={**SMALL_ENSEMBLE, rule: answer})


def test_a_fit_of_no_steps_is_refused_at_once():
    with pytest.raises(ValueError, match="max_steps must be at least 1"):
        small(RPTO, dynamics_kwargs={**SMALL_ENSEMBLE, "max_steps": 0})


def test_a_monitor_that_forbids_resets_is_refused_before_the_source_phase():
    model = small(RPO, Monitor(pendulum(), allow_early_resets=False))
    with pytest.raises(ValueError, match="allow_early_resets"):
        model.learn(10)
    assert model.source_timesteps == 0


def test_a_batch_keeps_a_row_of_the_source():
    model = small(RPO, real_ratio=0.99, batch_size=32, gradient_steps=5)
    model.learn(20, source_timesteps=0)
    assert model._n_updates == 100
    batches = list(model.critic_batches(5, 32))
    assert [len(b.rewards) for b in batches] == [32] * 5


def test_a_single_declared_name_does_not_come_apart_into_letters():
    env, target = (gym.make("InvertedDoublePendulum-v5") for _ in range(2))
    with pytest.raises(TypeError, match=r"list of names, not the string 'pole.length'; write \['pole.length'\]"):
        small(RPTO, env, target, dynamics="physical", dynamics_kwargs={}, declared="pole.length")
