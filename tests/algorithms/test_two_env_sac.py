"""SB3's accounts in the target: rollouts of whole episodes, the null-shift check."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from conftest import OURS, SMALL_ENSEMBLE, SMALL_POLICY, small
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPO, RPTO
from sb3_rpto.buffers import chronological


def short(g=12.0):
    return gym.make("Pendulum-v1", g=g, max_episode_steps=8)


def assert_moves_as_a_pendulum(rows):
    """The angle of each transition has turned by the speed after it."""
    reached = np.arctan2(rows["next_observations"][:, 1], rows["next_observations"][:, 0])
    left = np.arctan2(rows["observations"][:, 1], rows["observations"][:, 0])
    turned = (reached - left + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.05 * rows["next_observations"][:, 2], atol=1e-5)


class Interrupted(gym.Wrapper):
    """Stops the run by Ctrl-C within a step: after the environment has moved, before it answers."""

    steps = 0

    def step(self, action):
        answer = super().step(action)
        self.steps += 1
        if self.steps == 21:
            raise KeyboardInterrupt
        return answer


class Watch(BaseCallback):
    """The gSDE noise at every step, and when rollouts begin and end."""

    def __init__(self):
        super().__init__()
        self.noise, self.events = [], []

    def _on_rollout_start(self):
        self.events.append(("start", self.num_timesteps))

    def _on_rollout_end(self):
        self.events.append(("end", self.num_timesteps))

    def _on_step(self):
        if self.model.use_sde:
            self.noise.append(self.model.actor.action_dist.exploration_mat[0, 0].item())
        return True


@pytest.mark.parametrize("cls", OURS)
@pytest.mark.parametrize(("sample_freq", "redrawn"), [(-1, 1), (4, 2)])
def test_exploration_noise_lasts_in_episodic_training(cls, sample_freq, redrawn):
    model = small(cls, short(10.0), short(), train_freq=(1, "episode"), use_sde=True, sde_sample_freq=sample_freq)
    watch = Watch()
    model.learn(16, callback=watch, source_timesteps=0)
    assert [len(set(watch.noise[i : i + 8])) for i in (0, 8)] == [redrawn, redrawn]
    assert len(set(watch.noise)) == 2 * redrawn


def test_a_rollout_is_as_many_episodes_as_train_freq_says_within_the_budget():
    model = small(RPO, short(10.0), short(), train_freq=(2, "episode"))
    watch = Watch()
    model.learn(37, callback=watch, source_timesteps=0)
    assert watch.events == [("start", 0), ("end", 16), ("start", 16), ("end", 32), ("start", 32), ("end", 37)]
    assert model.target_spent == {"learning": 37}


@pytest.mark.parametrize("cls", OURS)
def test_a_resumed_source_phase_still_notices_a_target_equal_to_the_source(cls, tmp_path):
    # unseeded: the loaded model's own reset begins elsewhere than the saved target stands
    model = small(cls, short(10.0), short(10.0), seed=None, learning_starts=0)
    saved = tmp_path / "model.zip"

    class SaveBeforeTheFirstStep(BaseCallback):
        def _on_training_start(self):
            self.model.save(saved)
            self.model.save_replay_buffer(tmp_path / "buffer.pkl")

        def _on_step(self):
            return True

    with pytest.warns(UserWarning, match="stepped exactly like env"):
        model.learn(20, callback=SaveBeforeTheFirstStep(), source_timesteps=40)
    resumed = cls.load(saved, env=short(10.0), target_env=short(10.0))
    resumed.load_replay_buffer(tmp_path / "buffer.pkl")
    with pytest.warns(UserWarning, match="stepped exactly like env"):
        resumed.learn(20, reset_num_timesteps=False)


def test_the_null_shift_check_ends():
    model = small(RPO, short(10.0), short(12.0))
    model.learn(3, source_timesteps=0)
    assert model.target.null_shift is None


def test_a_target_in_the_place_of_another_one_is_checked_anew():
    model = small(RPO, short(10.0), short(12.0))
    model.learn(3, source_timesteps=0)
    with pytest.warns(UserWarning, match="D_target loses"):
        model.set_target_env(short(10.0))
    with pytest.warns(UserWarning, match="stepped exactly like env"):
        model.learn(20, reset_num_timesteps=False)


@pytest.mark.parametrize("seed", [None, 0])
def test_a_target_is_seeded_as_the_seed_given_last_says(seed):
    first, second = small(RPO, short(10.0), seed=seed), small(RPO, short(10.0), short(12.0), seed=seed)
    for model in (first, second):
        model.set_random_seed(7)
    first.set_target_env(short(12.0))
    seen = [model.target_env.reset() for model in (first, second)]
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize("widths", [(2, 1), (1, 2), (2, 3)])
def test_action_noise_takes_the_width_of_the_target(widths):
    first, second = ([short] * width for width in widths)
    model = small(RPO, target=DummyVecEnv(first), action_noise=NormalActionNoise(np.zeros(1), np.full(1, 0.1)))
    model.learn(12, source_timesteps=0)
    with pytest.warns(UserWarning, match="D_target loses"):
        model.set_target_env(DummyVecEnv(second))
    model.learn(12, reset_num_timesteps=False)
    assert model.num_timesteps == 24


def test_the_best_policy_of_a_target_is_judged_by_its_own_episodes():
    model = small(RPO, short(10.0), gym.wrappers.TransformReward(short(12.0), lambda r: 0.01 * r))
    model.learn(140, source_timesteps=0)
    assert np.isfinite(model.snapshots.best_mean_reward)
    with pytest.warns(UserWarning, match="D_target loses"):
        model.set_target_env(short(12.0))
    model.learn(140, reset_num_timesteps=False)
    earned = [info["r"] for info in model.ep_info_buffer]
    assert model.snapshots.best_mean_reward == pytest.approx(
        max(np.mean(earned[i : i + 5]) for i in range(len(earned) - 4))
    )


def test_steps_that_a_script_takes_in_the_target_are_counted_at_once():
    model = small(RPO, short(10.0), short()).learn(20, source_timesteps=0)
    model.target_env.reset()
    model.target_env.step(np.zeros((1, 1)))
    assert model.target_spent == {"learning": 20, "other": 1}


def test_an_evaluation_in_the_target_itself_makes_up_no_transition():
    target = short()
    model = small(RPO, short(10.0), target).learn(11, source_timesteps=0)  # in the middle of an episode
    evaluate_policy(model, target, 1, warn=False)
    with pytest.warns(UserWarning, match="target_spent does not hold those steps"):
        model.learn(9, reset_num_timesteps=False, source_timesteps=0)
    rows = chronological(model.replay_buffer.target)
    goes_on = np.isclose(rows["next_observations"][:-1], rows["observations"][1:]).all(axis=1)
    assert np.flatnonzero(~goes_on).tolist() == [7, 10, 18]  # episodes of 8 steps end, and that of the evaluation began
    assert_moves_as_a_pendulum(rows)


def test_a_callback_that_evaluates_in_the_target_itself_is_stopped():
    target = short()
    model = small(RPO, short(10.0), target)

    def evaluate(local, _):
        if model.num_timesteps == 5:
            evaluate_policy(model, target, 1, warn=False)
        return True

    with pytest.raises(RuntimeError, match="stepped or reset by somebody else"):
        model.learn(20, callback=evaluate, source_timesteps=0)
    assert model.replay_buffer.target.size() == model.num_timesteps == 5
    with pytest.warns(UserWarning, match="a new episode begins"):
        model.learn(15, reset_num_timesteps=False, source_timesteps=0)
    assert model.replay_buffer.target.size() == model.num_timesteps == 20


def test_a_step_of_the_target_that_was_interrupted_is_no_somebody_elses():
    model = small(RPO, short(10.0), Interrupted(short()))
    with pytest.raises(KeyboardInterrupt):
        model.learn(30, source_timesteps=0)
    with pytest.warns(UserWarning, match="interrupted within a step") as caught:
        model.learn(10, reset_num_timesteps=False, source_timesteps=0)
    assert not any("stepped or reset" in str(one.message) for one in caught)
    assert model.target_spent == {"learning": 31}  # 21 and 10
    assert model.replay_buffer.target.size() == 30
    assert_moves_as_a_pendulum(chronological(model.replay_buffer.target))


def stop_at(model, steps):
    """Ctrl-C in the update after so many target steps, each of which is stored by then."""
    update = model.update_policy

    def interrupted():
        if model.num_timesteps == steps:
            raise KeyboardInterrupt
        update()

    model.update_policy = interrupted
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, source_timesteps=0)
    del model.update_policy


@pytest.mark.parametrize("other", [False, True])
def test_steps_that_a_script_takes_after_an_interruption_make_up_no_transition(other):
    model = small(RPO, short(10.0), short())
    stop_at(model, 20)
    if other:
        with pytest.warns(UserWarning, match="D_target loses"):
            model.set_target_env(short(14.0))
    model.target_env.reset()
    for _ in range(3):
        model.target_env.step(np.zeros((1, 1)))
    model.learn(3, reset_num_timesteps=False, source_timesteps=0)
    assert model.num_timesteps == 23
    assert model.replay_buffer.target.size() == (3 if other else 23)
    assert_moves_as_a_pendulum(chronological(model.replay_buffer.target))


def test_steps_that_a_script_takes_after_a_callback_failed_make_up_no_transition():
    class Fails(BaseCallback):
        def _on_training_start(self):
            raise RuntimeError("mine")

        def _on_step(self):
            return True

    model = small(RPO, short(10.0), short())
    with pytest.raises(RuntimeError, match="mine"):
        model.learn(10, callback=Fails(), source_timesteps=0)
    model.target_env.reset()
    model.target_env.step(np.zeros((1, 1)))
    model.learn(10, source_timesteps=0)
    assert model.replay_buffer.target.size() == 10


def test_the_first_fit_to_another_target_waits_for_transitions_of_it():
    model = small(RPTO, short(10.0), short(), model_train_freq=20)
    model.learn(19, source_timesteps=0)
    with pytest.warns(UserWarning, match="D_target loses"):
        model.set_target_env(short(14.0))
    seen, fit = [], model.dynamics.fit
    model.dynamics.fit = lambda data, *rest: seen.append(len(data)) or fit(data, *rest)
    model.learn(25, reset_num_timesteps=False)
    assert seen == [20]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_source_phase_that_goes_on_begins_a_new_episode(n_envs):
    source = DummyVecEnv(
        [lambda: Interrupted(gym.make("Pendulum-v1")), *[lambda: gym.make("Pendulum-v1")] * (n_envs - 1)]
    )
    model = small(RPO, source, short())
    with pytest.raises(KeyboardInterrupt):
        model.learn(5, source_timesteps=150)
    model.learn(5, reset_num_timesteps=False, source_timesteps=150)
    rows = chronological(model.replay_buffer.source)
    assert len(rows["rewards"]) >= 150
    assert_moves_as_a_pendulum(rows)


class Silent(DummyVecEnv):
    """Does not tell how episodes end."""

    def step_wait(self):
        *answer, infos = super().step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return *answer, infos


@pytest.mark.parametrize("world", ["source", "target"])
def test_an_end_that_a_vec_env_does_not_tell_is_named(world):
    worlds = {"source": short(10.0), "target": short(12.0), world: Silent([short])}
    with pytest.raises(
        ValueError, match=rf"the {world}'s VecEnv ended an episode without info\['terminal_observation'\]"
    ):
        small(RPO, worlds["source"], worlds["target"], learning_starts=5).learn(12, source_timesteps=12)


class Broken(gym.Wrapper):
    """Its fifth answer is infinite, which a VecNormalize clips."""

    def __init__(self, env, what, at=5):
        super().__init__(env)
        self.what, self.at, self.steps = what, at, 0

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        return (observation + np.float32(np.inf) if self.at == 0 else observation), info

    def step(self, action):
        observation, reward, *rest = super().step(action)
        self.steps += 1
        if self.steps == self.at and self.what == "observation":
            observation = observation + np.float32(np.inf)
        return observation, (np.inf if self.steps == self.at and self.what == "reward" else reward), *rest


@pytest.mark.parametrize(("what", "at"), [("observation", 5), ("reward", 5), ("observation", 8), ("observation", 0)])
def test_what_is_not_finite_in_the_target_is_refused_behind_a_normalisation(what, at):
    source = VecNormalize(DummyVecEnv([lambda: short(10.0)]))
    made = small(RPO, source, Broken(short(), what, at))
    with pytest.raises(ValueError, match=f"the target environment returned, as {what}, what is not finite"):
        made.learn(20, source_timesteps=0)
    kept = chronological(made.replay_buffer.target)
    assert len(kept["rewards"]) == max(at - 1, 0)
    assert all(np.isfinite(values).all() for values in kept.values())


def test_a_source_phase_without_an_update_is_told():
    with pytest.warns(
        UserWarning, match=r"source phase of 20 steps ends before its first update \(learning_starts=20\)"
    ):
        small(RPO, learning_starts=20).learn(2)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="the source phase")
        small(RPO, learning_starts=20).learn(2, source_timesteps=21)
        small(RPO, learning_starts=20).learn(2, source_timesteps=0)  # nobody wants one


@pytest.mark.parametrize("normalised", [True, False])
def test_another_normalisation_is_told_and_the_episode_goes_on_in_it(normalised):
    def world(normalised):
        venv = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
        return VecNormalize(venv) if normalised else venv

    made = small(RPO, world(normalised), gym.make("Pendulum-v1", g=12.0)).learn(20, source_timesteps=0)
    with pytest.warns(UserWarning, match="the model saw .*env"):
        made.set_env(world(not normalised))
    made.learn(10, reset_num_timesteps=False)
    assert_moves_as_a_pendulum(chronological(made.replay_buffer.target))
    np.testing.assert_allclose(np.linalg.norm(made.replay_buffer.target.observations[:30, 0, :2], axis=1), 1, atol=1e-5)


def test_a_source_that_is_refused_changes_nothing():
    source, target = short(10.0), short()
    model = small(RPO, source, target)
    with pytest.raises(ValueError, match="target_env is env"):
        model.set_env(target)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(gym.make("MountainCarContinuous-v0"))
    assert model.env.envs[0].unwrapped is source.unwrapped
    model.learn(20, source_timesteps=50)
    assert model.target_spent == {"learning": 20}


@pytest.mark.parametrize("name", ["Pendulum-v1", "MountainCarContinuous-v0"])
def test_another_source_need_not_have_been_reset(name):
    model = small(RPO, gym.make(name), gym.make(name)).learn(20, source_timesteps=0)
    model.set_env(gym.make(name))
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 40


def test_random_actions_in_the_source_follow_the_seed_after_loading(tmp_path):
    small(RPO).save(tmp_path / "fresh")
    seen = []
    for seed in (2, 2, 3):
        model = RPO.load(tmp_path / "fresh", short(10.0), target_env=short(), seed=seed)
        model.learn(1, source_timesteps=60)
        seen.append(chronological(model.replay_buffer.source)["actions"][:60])
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])


def test_steps_of_a_log_are_no_rollout_in_the_target_that_comes_after_it():
    recorded = small(RPO, short(10.0), short()).learn(40, source_timesteps=0).replay_buffer.target
    settings = {"policy_kwargs": SMALL_POLICY, "batch_size": 32, "source_steps": 20, "gradient_steps": 1, "seed": 0}
    few = {"dynamics_kwargs": SMALL_ENSEMBLE, "model_train_freq": 20, "device": "cpu"}
    model = RPTO("MlpPolicy", short(10.0), target_data=recorded, **settings, **few)
    model.learn(500, lambda local, _: model.num_timesteps < 200, source_timesteps=0)
    model.set_target_env(short())
    updates, steps = model._n_updates, model.source_timesteps
    model.learn(2, reset_num_timesteps=False)
    assert model._n_updates - updates == 2
    assert model.source_timesteps - steps == 40
