"""Step 3: what is stored of branches and of episodes in the source."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch as th
from conftest import SMALL_POLICY, heavier, small
from gymnasium import spaces
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPO, RPTO
from sb3_rpto.algorithms.rollouts import BranchSource, SimulatorSource, try_source
from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.envs import observations
from sb3_rpto.envs.observations import whole_state

BOUND, WALL = 4.0, 2.0
LOW, HIGH = np.array([-1.0, -2.0], np.float32), np.array([3.0, 2.0], np.float32)
POLE = "InvertedPendulum-v5"


class Point(gym.Env):
    """A point that each action moves by itself; its actions' bounds are nobody's [-1, 1]."""

    observation_space = spaces.Box(-BOUND, BOUND, (2,))
    action_space = spaces.Box(LOW, HIGH)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 2).astype(np.float32), 0
        return self.place, {}

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        self.place = np.clip(self.place + action, -BOUND, BOUND).astype(np.float32)
        return self.place, float(self.place.sum()), False, self.steps >= 5, {}


class Push(Dynamics):
    """The same as a model, which knows no bounds, and ends beyond a wall."""

    rollout = "branches"

    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """See the class."""
        reached = observations + actions
        return Prediction(reached, reached.sum(dim=1), reached[:, 0] > WALL)

    def fit(self, data: Transitions, weights: Any = None, max_steps: int | None = None) -> dict[str, float]:
        """Nothing is to be learned."""
        return {}

    def error(self, data: Transitions) -> float:
        """None."""
        return 0.0


def algorithm(env: Any = None) -> RPTO:
    """One whose branches may start from places of the source, all in [-1, -0.5], or of the target, in [0.5, 1]."""
    made = small(RPTO, Point() if env is None else env, Point())
    rng = np.random.default_rng(0)
    made.replay_buffer.source_starts = rng.uniform(-1, -0.5, (300, 2)).astype(np.float32)
    places = rng.uniform(0.5, 1, (300, 2)).astype(np.float32)
    made.replay_buffer.append("target", places, places, np.zeros((300, 2)), np.zeros(300), np.zeros(300))
    return made


def branches(made: RPTO, n: int, start: Any = "target") -> dict[str, np.ndarray]:
    """So many, as they were stored."""
    push = Push(made.observation_space, made.action_space)
    assert BranchSource(push, start).interact(made, n) == n
    side = made.replay_buffer.source
    assert side.size() == n
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    return {name: getattr(side, name)[:n, 0] for name in names}


def test_branches_are_stored_as_the_model_answers_them() -> None:
    stored = branches(algorithm(), 400)
    actions = LOW + (stored["actions"] + 1) / 2 * (HIGH - LOW)
    assert (np.ptp(stored["actions"], axis=0) > 1).all()
    reached = stored["observations"] + actions
    assert (reached > 2.5).any()  # and so beyond the wall
    np.testing.assert_allclose(stored["next_observations"], reached, atol=1e-6)
    np.testing.assert_allclose(stored["rewards"], reached.sum(axis=1), atol=1e-5)
    np.testing.assert_array_equal(stored["dones"] > 0, reached[:, 0] > WALL)
    assert 0 < stored["dones"].mean() < 1
    assert not stored["timeouts"].any()


def test_what_a_model_says_beyond_the_observations_bounds_is_at_them() -> None:
    made = algorithm()
    made.replay_buffer.target.observations[:300] += 3  # now in [3.5, 4]
    stored = branches(made, 400)
    actions = LOW + (stored["actions"] + 1) / 2 * (HIGH - LOW)
    reached = stored["observations"] + actions
    assert (reached > BOUND).any()
    np.testing.assert_allclose(stored["next_observations"], reached.clip(-BOUND, BOUND), atol=1e-6)
    np.testing.assert_allclose(stored["rewards"], reached.sum(axis=1), atol=1e-5)


@pytest.mark.parametrize(("start", "of_target"), [("target", 101), ("source", 0), ("mix", (50, 51))])
def test_branches_start_where_it_was_asked_for(start: str, of_target: Any) -> None:
    made = algorithm()
    stored = branches(made, 101, start)["observations"]
    assert (stored[:, 0] > 0).sum() in np.atleast_1d(of_target)
    for pool in (made.replay_buffer.source_starts, made.replay_buffer.target.observations[:300, 0]):
        begun = {place.tobytes() for place in stored} & {place.tobytes() for place in pool}
        assert len(begun) > 30 or len(begun) == 0  # anywhere, not at the first ones


@pytest.mark.parametrize("start", ["target", "source", "mix"])
def test_branches_start_where_the_model_knows_the_state_if_there_is_such_a_place(
    start: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = algorithm()
    monkeypatch.setattr(Push, "knows", lambda self, observations: np.abs(observations[:, 1]) < 0.6)
    assert (np.abs(branches(made, 150, start)["observations"][:, 1]) < 0.6).all()
    monkeypatch.setattr(Push, "knows", lambda self, observations: np.zeros(len(observations), dtype=bool))
    assert len(branches(algorithm(), 20, start)["observations"]) == 20


def test_single_branches_are_mixed_too_and_of_more_than_fit_all_are_of_both() -> None:
    made = algorithm()
    source = BranchSource(Push(made.observation_space, made.action_space), "mix")
    assert {bool(source._starts(made, 1)[0, 0] > 0) for _ in range(40)} == {False, True}
    made.replay_buffer.resize("source", 60)
    for n, stored in ((200, 60), (40, 40), (45, 45)):  # in the last two rounds what was there is forgotten in part
        assert source.interact(made, n) == stored
        assert abs((made.replay_buffer.source.observations[:, 0, 0] > 0).sum() - 30) <= 3


@pytest.mark.parametrize("start", ["target", "mix"])
def test_before_the_first_target_transition_branches_start_in_the_source(start: str) -> None:
    made = algorithm()
    made.replay_buffer.target.reset()
    assert (branches(made, 20, start)["observations"] < 0).all()


# --- normalisation ----------------------------------------------------------------------------------------------------


def far(make: Callable[[], gym.Env], mean: float, variance: float) -> VecNormalize:
    """Normalised by statistics that are far from nothing, and stay."""
    env = VecNormalize(make_vec_env(make, n_envs=2), training=False)
    env.obs_rms.mean += mean  # type: ignore[union-attr]
    env.obs_rms.var *= variance  # type: ignore[union-attr]
    env.ret_rms.var *= 25.0  # type: ignore[assignment]
    return env


def test_branches_act_on_what_the_policy_knows_and_are_stored_raw(monkeypatch: pytest.MonkeyPatch) -> None:
    env = far(Point, 3.0, 4.0)
    made = algorithm(env)
    seen, act = [], made.policy._predict
    monkeypatch.setattr(made.policy, "_predict", lambda obs, **kwargs: (seen.append(obs), act(obs, **kwargs))[1])
    stored = branches(made, 50)
    np.testing.assert_allclose(seen[0], (stored["observations"] - 3) / 2, rtol=1e-5)
    assert (stored["observations"] >= 0.5).all()
    actions = LOW + (stored["actions"] + 1) / 2 * (HIGH - LOW)
    np.testing.assert_allclose(stored["rewards"], (stored["observations"] + actions).sum(axis=1), atol=1e-5)


def test_episodes_are_stored_raw() -> None:
    made = small(RPO, far(Point, 3.0, 4.0), Point()).learn(20, source_timesteps=60)
    for side in (made.replay_buffer.source, made.replay_buffer.target):
        n = side.size()
        assert n >= 20
        np.testing.assert_allclose(side.rewards[:n, 0], side.next_observations[:n, 0].sum(axis=1), atol=1e-5)
        assert side.observations[:n].max() > 1


# --- simulators -------------------------------------------------------------------------------------------------------


def simulators(randomise: float) -> RPTO:
    """Two, with a mass that is known to a tenth."""
    made = RPTO(
        "MlpPolicy",
        DummyVecEnv([lambda: gym.make(POLE)]),
        target_env=heavier(),
        dynamics="physical",
        declared=["pole.mass"],
        dynamics_kwargs={"randomise": randomise},
        source_steps=2,
        policy_kwargs=SMALL_POLICY,
        seed=0,
        device="cpu",
    )
    made.learn(1, source_timesteps=40)
    (mass,) = made.dynamics.effects()  # type: ignore[union-attr]
    made.dynamics.replace([mass], (0.1 * mass.values[:, None]) ** 2)  # type: ignore[union-attr]
    return made


def masses(made: RPTO, n_steps: int = 400) -> tuple[list[set[float]], float]:
    """Of each simulator those of all of its episodes, and the estimate."""
    world, seen = made.rollouts, [set[float](), set[float]()]
    for _ in range(n_steps // 2):
        world.interact(made, 2)  # type: ignore[union-attr]
        for copy, of in zip(world.copies, seen):  # type: ignore[union-attr]
            model = copy.unwrapped.model
            of.add(float(model.body_mass[model.body("pole").id]))
    (estimate,) = made.dynamics.values  # type: ignore[union-attr]
    return seen, float(estimate)


def test_each_episode_of_a_randomised_simulator_has_a_phi_of_its_own() -> None:
    made = simulators(1.0)
    taken = made.replay_buffer.source.size()
    (one, other), estimate = masses(made)
    ended = made.replay_buffer.source.dones[taken : made.replay_buffer.source.size(), 0].reshape(-1, 2)
    episodes = [len(one - {estimate}), len(other - {estimate})]
    assert episodes == ended.sum(axis=0).tolist()
    assert min(episodes) > 10
    assert not (one - {estimate}) & other
    drawn = np.array(sorted(one | other))
    assert drawn.std() == pytest.approx(0.1 * estimate, rel=0.4)
    assert np.median(drawn) == pytest.approx(estimate, rel=0.05)


def test_a_walker_of_an_episode_of_its_own_stands_as_it_is_then() -> None:
    env = DummyVecEnv([lambda: gym.make("Hopper-v5", reset_noise_scale=0.0)])
    dynamics = PhysicalDynamics(
        env.observation_space,
        env.action_space,
        **physical_config(env),
        declared=["leg.length"],
        randomise=1.0,
        threads=1,
    )
    dynamics.seed(0)
    (leg,) = dynamics.effects()
    dynamics.replace([leg], np.array([[0.03**2]]))
    source = SimulatorSource(dynamics, env, 3)
    seen = set()
    for _ in range(3):
        source.env.reset()
        for copy in source.copies:
            base: Any = copy.unwrapped
            floor = base.model.geom("floor").id
            gap = min(
                mujoco.mj_geomDistance(base.model, base.data, floor, geom, 1.0, None)
                for geom in range(base.model.ngeom)
                if geom != floor
            )
            assert gap == pytest.approx(0.04, abs=1e-4)
            seen.add(float(copy.effects[0].values[0]))
    assert len(seen) == 9


def test_without_that_all_episodes_have_the_estimate() -> None:
    seen, estimate = masses(simulators(0.0), 100)
    assert seen == [{estimate}] * 2


# --- refused at construction -----------------------------------------------------------------------------------------


class Imitated(gym.Env):
    """A pole on a cart with all attributes of gymnasium's class for MuJoCo, but for the method that steps it."""

    def __init__(self) -> None:
        twin: Any = gym.make(POLE).unwrapped
        self.model, self.data, self.frame_skip, self.dt = twin.model, twin.data, twin.frame_skip, twin.dt
        self.observation_space, self.action_space = twin.observation_space, twin.action_space

    def _get_obs(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-0.01, 0.01, 2)
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def step(self, action: np.ndarray) -> Any:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        return self._get_obs(), 1.0, bool(abs(self.data.qpos[1]) > 0.2), False, {}


class WritesItsMass(InvertedPendulumEnv):
    """Each reset writes the nominal mass of the pole: nothing is drawn, and phi is undone."""

    def reset_model(self) -> np.ndarray:
        self.model.body("pole").mass[0] = 4.89462372
        return super().reset_model()


class Drawn(InvertedPendulumEnv):
    """Single steps do not tell its goal."""

    goal = 0.0

    def reset_model(self) -> np.ndarray:
        self.goal = float(self.np_random.uniform(-0.5, 0.5))
        return super().reset_model()

    def step(self, action: np.ndarray) -> Any:
        observation, _, *rest = super().step(action)
        return observation, -abs(float(observation[0]) - self.goal), *rest


def stuck() -> gym.Env:
    """It holds what cannot be copied."""
    env = gym.make(POLE)
    env.unwrapped.lock = (n for n in ())  # type: ignore[attr-defined]
    return env


def limited(env: gym.Env) -> gym.Env:
    return gym.wrappers.TimeLimit(env, 50)


@pytest.fixture
def _read_as_states() -> Any:
    """States are the observations, whoever wrote ``_get_obs``."""
    told = {cls: lambda env: whole_state(2, 2) for cls in (Imitated, WritesItsMass, Drawn)}
    with mock.patch.dict(observations._registered, told):
        yield


REFUSED = [
    (lambda: limited(Imitated()), {}, "Imitated is no gymnasium MuJoCo environment"),
    (lambda: limited(Imitated()), {"close_loop": True}, "Imitated is no gymnasium MuJoCo environment"),
    (lambda: limited(Imitated()), {"dynamics": "residual"}, "Imitated is no gymnasium MuJoCo environment"),
    (lambda: limited(WritesItsMass()), {}, r"reset\(\) of WritesItsMass writes body_mass"),
    (lambda: limited(WritesItsMass()), {"dynamics": "residual"}, r"reset\(\) of WritesItsMass writes body_mass"),
    (lambda: limited(Drawn()), {"dynamics": "residual"}, "depends on more than the state before it"),
    (lambda: limited(Drawn()), {"weighting": "value_aware"}, "depends on more than the state before it"),
    (stuck, {}, "cannot be copied"),
    (stuck, {"dynamics": "residual"}, "cannot be copied"),
]


@pytest.mark.usefixtures("_read_as_states")
@pytest.mark.parametrize(("make", "settings", "said"), REFUSED)
def test_a_source_in_which_phi_cannot_act_is_refused_at_construction(
    make: Callable[[], gym.Env], settings: dict[str, Any], said: str
) -> None:
    settings = {"dynamics": "physical", "declared": ["pole.mass"], "dynamics_kwargs": {"threads": 1}, **settings}
    with pytest.raises(ValueError, match=said):
        RPTO("MlpPolicy", make(), target_env=heavier(), device="cpu", policy_kwargs=SMALL_POLICY, **settings)


@pytest.mark.usefixtures("_read_as_states")
@pytest.mark.parametrize("dynamics", ["physical", "residual"])
def test_such_a_source_is_refused_when_it_is_set_and_with_a_checkpoint(dynamics: str, tmp_path: Path) -> None:
    model: Any = small(
        RPTO, gym.make(POLE), heavier(), dynamics=dynamics, declared=["pole.mass"], dynamics_kwargs={"threads": 1}
    )
    for make, said in ((lambda: limited(Imitated()), "is no gymnasium MuJoCo"), (stuck, "cannot be copied")):
        before = model.env
        with pytest.raises(ValueError, match=said):
            model.set_env(make())
        assert model.env is before
        model.save(tmp_path / "model.zip")
        with pytest.raises(ValueError, match=said):
            RPTO.load(tmp_path / "model.zip", make(), device="cpu")


def test_the_trial_of_a_source_leaves_all_as_it_was() -> None:
    """Neither the source nor any random stream moves, so a run is the one that it was without a trial."""
    env = DummyVecEnv([lambda: gym.make(POLE)])
    env.seed(3)
    env.reset()
    dynamics = PhysicalDynamics(
        env.observation_space, env.action_space, **physical_config(env), declared=["pole.mass"], threads=1
    )
    before, data = dynamics.generator.get_state(), env.envs[0].unwrapped.data.qpos.copy()  # type: ignore[attr-defined]
    states = th.get_rng_state(), env.envs[0].unwrapped.np_random.bit_generator.state, dynamics.values.copy()
    try_source(env, dynamics, single_steps=True)
    np.testing.assert_array_equal(env.envs[0].unwrapped.data.qpos, data)  # type: ignore[attr-defined]
    assert th.equal(dynamics.generator.get_state(), before)
    assert th.equal(th.get_rng_state(), states[0])
    assert env.envs[0].unwrapped.np_random.bit_generator.state == states[1]
    np.testing.assert_array_equal(dynamics.values, states[2])
