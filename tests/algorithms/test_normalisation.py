"""What a source model has seen: told by its zip, by files beside it, or by the user."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from conftest import SMALL_POLICY, small
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize, unwrap_vec_normalize
from tracking import MEAN, Tracking, solved, statistics, zipped

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms.normalisation import read_statistics, saw_normalised, statistics_of

SMALL = {"hidden": (8,), "n_members": 2, "n_elites": 1}
SETTINGS = {"device": "cpu", "policy_kwargs": SMALL_POLICY}
every_class = pytest.mark.parametrize("cls", [RPO, RTO, RPTO])


def from_zip(path, env=None, target=None, cls=RPO, **kwargs):
    kwargs |= {} if cls is RPO else {"dynamics_kwargs": SMALL}
    env = Tracking() if env is None else env
    return cls.from_source(path, env, Tracking(shift=0.1) if target is None else target, device="cpu", **kwargs)


def earned(model):
    """By its deterministic policy in the source."""
    env = VecNormalize(DummyVecEnv([Tracking]), training=False, norm_reward=False)
    normaliser = model.get_vec_normalize_env()
    env.norm_obs = normaliser is not None
    if normaliser is not None:
        env.obs_rms = normaliser.obs_rms
    env.seed(7)
    return evaluate_policy(model, env, n_eval_episodes=5, warn=False)[0]


# --- a zip with statistics -------------------------------------------------------------------------------------------


@every_class
@pytest.mark.parametrize("beside", ["vecnormalize.pkl", "statistics.pkl"])
def test_statistics_beside_a_zip_are_read_and_it_says_so(cls, beside, tmp_path):
    path = zipped(tmp_path, normalised=True, beside=beside)
    with pytest.warns(
        UserWarning, match=f"normalised by VecNormalize, so env is put into one.*{beside}.*vec_normalize="
    ):
        model = from_zip(path, cls=cls)
    assert earned(model) > -40
    assert model.get_vec_normalize_env().obs_rms.mean == pytest.approx(MEAN)
    assert unwrap_vec_normalize(model.target_env).obs_rms is model.get_vec_normalize_env().obs_rms


@every_class
@pytest.mark.parametrize("kind", ["str", "path", "object"])
def test_statistics_that_are_given_are_used_silently_and_stay_as_they_are(cls, kind, tmp_path):
    path = zipped(tmp_path / "agent", normalised=True)
    given = statistics()
    given.save(str(tmp_path / "mine.pkl"))
    passed = {"str": str(tmp_path / "mine.pkl"), "path": tmp_path / "mine.pkl", "object": given}[kind]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*ormalis")
        model = from_zip(path, cls=cls, vec_normalize=passed)
        assert earned(model) > -40
        model.learn(25, source_timesteps=0)
    assert model.get_vec_normalize_env().obs_rms.count > 10_000
    assert given.obs_rms.count == 10_000
    assert model.get_vec_normalize_env().norm_reward


def test_a_model_in_memory_may_be_given_statistics_too():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = from_zip(solved(normalised=True), vec_normalize=statistics())
    assert earned(model) > -40


def test_false_leaves_the_source_as_it_is(tmp_path):
    path = zipped(tmp_path, normalised=False, beside="vecnormalize.pkl")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = from_zip(path, vec_normalize=False)
    assert model.get_vec_normalize_env() is None
    assert earned(model) > -40


def test_an_environment_in_its_own_normalisation_keeps_it(tmp_path):
    path, env = zipped(tmp_path, normalised=True, beside="vecnormalize.pkl"), statistics()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in (None, env, statistics()):
            assert from_zip(path, env, vec_normalize=given).get_vec_normalize_env() is env
    env.obs_rms.mean[:] = 0.0
    with pytest.warns(UserWarning, match="source_model saw observations normalised by other statistics than env's"):
        from_zip(path, env)
    with pytest.raises(ValueError, match="env is in a VecNormalize with other statistics than those of vec_normalize"):
        from_zip(path, env, vec_normalize=statistics())


def test_what_is_no_statistics_is_refused(tmp_path):
    path = zipped(tmp_path, normalised=True)
    with open(tmp_path / "other.pkl", "wb") as file:
        pickle.dump([1, 2], file)
    (tmp_path / "broken.pkl").write_bytes(b"no pickle")
    VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])).save(str(tmp_path / "pendulum.pkl"))
    for given, error, said in (
        (tmp_path / "none.pkl", FileNotFoundError, "vec_normalize: there is no file"),
        (tmp_path / "other.pkl", ValueError, r"other.pkl' holds a list; pass what VecNormalize.save\(\) wrote"),
        (tmp_path / "broken.pkl", ValueError, "broken.pkl' cannot be read"),
        (tmp_path / "pendulum.pkl", ValueError, "vec_normalize: its statistics are not of env's observations"),
        (3, TypeError, "vec_normalize must be a VecNormalize, or the path"),
    ):
        with pytest.raises(error, match=said):
            from_zip(path, vec_normalize=given)


def test_statistics_are_copied_from_an_object_with_and_without_an_environment(tmp_path):
    given = statistics()
    one = read_statistics(given)
    two = read_statistics(one)
    for found in (one, two):
        assert found.venv is None
        assert found.obs_rms is not given.obs_rms
        np.testing.assert_array_equal(found.obs_rms.mean, given.obs_rms.mean)
    assert given.venv is not None


# --- what a zip tells by itself --------------------------------------------------------------------------------------


def trained(folder, dtype, normalised):
    """A SAC of a few steps, which no episode's return can tell of."""
    folder.mkdir()
    env = DummyVecEnv([lambda: Tracking(dtype=dtype)])
    env = VecNormalize(env) if normalised else env
    SAC("MlpPolicy", env, learning_starts=5, **SETTINGS).learn(12).save(folder / "model.zip")
    if normalised:
        env.save(str(folder / "vecnormalize.pkl"))
    return folder / "model.zip"


def test_a_zip_of_doubles_tells_whether_it_saw_normalised_observations(tmp_path):
    """As MuJoCo's observations are: VecNormalize shows float32."""
    raw, normalised = (trained(tmp_path / name, np.float64, name == "normalised") for name in ("raw", "normalised"))
    env = {"dtype": np.float64}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        from_zip(raw, Tracking(**env), Tracking(shift=0.1, **env))
        statistics(**env).save(str(raw.parent / "vecnormalize.pkl"))  # of another model in this folder
        assert from_zip(raw, Tracking(**env), Tracking(shift=0.1, **env)).get_vec_normalize_env() is None
    (normalised.parent / "vecnormalize.pkl").unlink()
    with pytest.warns(
        UserWarning, match="saw observations normalised by VecNormalize, and env is in none.*vec_normalize="
    ):
        from_zip(normalised, Tracking(**env), Tracking(shift=0.1, **env))
    with pytest.warns(UserWarning, match="saw raw observations, and env normalises them"):
        from_zip(raw, statistics(**env), Tracking(shift=0.1, **env), vec_normalize=False)


def test_a_raw_zip_beside_the_statistics_of_another_is_raw(tmp_path):
    raw = trained(tmp_path / "raw", np.float32, normalised=False)
    statistics().save(str(raw.parent / "vecnormalize.pkl"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert from_zip(raw).get_vec_normalize_env() is None


def test_statistics_of_another_task_beside_a_zip_are_nobodys(tmp_path):
    path = zipped(tmp_path, normalised=False)
    VecNormalize(DummyVecEnv([pendulum])).save(str(tmp_path / "vecnormalize.pkl"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert from_zip(path).get_vec_normalize_env() is None


def test_statistics_of_nothing_are_nobodys(tmp_path):
    for name in ("raw", "normalised"):
        path = trained(tmp_path / name, np.float32, name == "normalised")
        (path.parent / "vecnormalize.pkl").unlink(missing_ok=True)
        with pytest.warns(UserWarning, match=r"raw or normalised by other statistics, and env's VecNormalize has none"):
            from_zip(path, VecNormalize(DummyVecEnv([Tracking])))


def test_the_file_of_a_checkpoint_callback_is_that_of_its_step(tmp_path):
    for name in ("rl_model_20_steps.zip", "rl_model_40_steps.zip", "rl_model_vecnormalize_20_steps.pkl"):
        (tmp_path / name).touch()
    assert statistics_of(tmp_path / "rl_model_20_steps.zip") == tmp_path / "rl_model_vecnormalize_20_steps.pkl"
    assert statistics_of(tmp_path / "rl_model_40_steps") is None


# --- both worlds in VecNormalize -------------------------------------------------------------------------------------


def pendulum(g=10.0):
    return gym.make("Pendulum-v1", g=g)


@every_class
@pytest.mark.parametrize("outside", [False, True], ids=["outermost", "within a VecMonitor"])
def test_a_target_in_a_normalisation_of_its_own_shares_the_sources(cls, outside):
    env = VecNormalize(DummyVecEnv([pendulum]), clip_obs=5.0)
    own = VecNormalize(DummyVecEnv([lambda: pendulum(12.0)]))
    with pytest.warns(UserWarning, match="target_env is in a VecNormalize of its own: the target shares") as said:
        model = small(cls, env, VecMonitor(own) if outside else own)
    assert len([w for w in said if "shares" in str(w.message)]) == 1
    assert model.target_env.obs_rms is env.obs_rms
    assert own.obs_rms is env.obs_rms  # whoever evaluates in it sees alike
    assert own.clip_obs == model.target_env.clip_obs == 5.0
    assert not own.training
    model.learn(30, source_timesteps=60)
    stored = model.replay_buffer.target.observations[:30, 0]
    np.testing.assert_allclose((stored[:, :2] ** 2).sum(axis=1), 1.0, atol=1e-5)  # cos and sin: raw
    rewards = model.replay_buffer.target.rewards[:30]
    assert rewards.min() < -0.5  # the environment's own, which are scaled for the critic when they are drawn
    twin = small(cls, VecNormalize(DummyVecEnv([pendulum]), clip_obs=5.0), pendulum(12.0))
    twin.learn(30, source_timesteps=60)
    np.testing.assert_array_equal(
        twin.replay_buffer.target.observations[:30], model.replay_buffer.target.observations[:30]
    )


def test_a_target_that_is_normalised_beside_a_raw_source_is_refused():
    with pytest.raises(ValueError, match="target_env is in VecNormalize and env is not"):
        small(RPO, pendulum(), VecNormalize(DummyVecEnv([lambda: pendulum(12.0)])))


def test_such_a_target_may_be_set_before_its_source(tmp_path):
    env = VecNormalize(DummyVecEnv([pendulum]))
    small(RPO, env, pendulum(12.0)).save(tmp_path / "model.zip")
    with pytest.warns(UserWarning, match="target shares"):
        model = RPO.load(
            tmp_path / "model.zip", target_env=VecNormalize(DummyVecEnv([lambda: pendulum(12.0)])), device="cpu"
        )
    model.set_env(env)
    assert model.target_env.obs_rms is env.obs_rms


# --- evaluation ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("both", [False, True], ids=["target plain", "both normalised"])
def test_an_evaluation_sees_by_the_sources_statistics_as_with_sac(both, tmp_path):
    """RTO leaves the policy as it is, so what EvalCallback reports is known."""
    path = zipped(tmp_path, normalised=True)
    target = VecNormalize(DummyVecEnv([lambda: Tracking(shift=0.1)])) if both else Tracking(shift=0.1)

    def evaluation():
        env = VecNormalize(DummyVecEnv([lambda: Tracking(shift=0.1)]), training=False, norm_reward=False)
        env.seed(5)
        return env

    env = statistics()
    env.training = False
    expected = evaluation()
    expected.obs_rms = env.obs_rms
    by_sac, _ = evaluate_policy(SAC.load(path, device="cpu"), expected, n_eval_episodes=3, warn=False)
    callback = EvalCallback(evaluation(), eval_freq=10, n_eval_episodes=3, verbose=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="target_env is in a VecNormalize")
        model = from_zip(path, env, target, cls=RTO)
    model.learn(10, callback=callback, source_timesteps=0)
    assert callback.last_mean_reward == pytest.approx(by_sac)
    assert by_sac > -60  # by other statistics it would be near -200


def test_an_evaluation_without_normalisation_is_refused_before_the_first_step(tmp_path):
    model = from_zip(zipped(tmp_path, normalised=True), statistics())
    callback = EvalCallback(DummyVecEnv([Tracking]), eval_freq=5, verbose=0)
    with pytest.raises(ValueError, match=r"EvalCallback's environment is in no VecNormalize.*training=False"):
        model.learn(10, callback=callback)
    assert model.num_timesteps == model.source_timesteps == 0


@pytest.mark.parametrize(("seen", "told"), [(1.5, True), (1.1, None), (0.5, None)])
def test_a_zip_tells_by_values_that_its_environment_cannot_show(seen, told):
    """Bounds that an environment leaves by a little tell nothing."""
    sac = SAC("MlpPolicy", pendulum(), **SETTINGS)
    sac._last_original_obs = np.array([[0.6, 0.8, 1.0]], np.float32)
    sac._last_obs = np.array([[seen, 0.8, 1.0]], np.float32)
    assert saw_normalised(sac) is told
    sac._last_original_obs = sac._last_obs.copy()
    assert saw_normalised(sac) is None


def test_statistics_beside_a_strangers_zip_are_not_read(tmp_path):
    """They are a pickle, too."""
    path = zipped(tmp_path, normalised=True)
    (tmp_path / "vecnormalize.pkl").write_bytes(b"no pickle")
    with pytest.warns(
        UserWarning, match="normalised by VecNormalize lie beside it.*leaves unread; pass vec_normalize="
    ):
        assert from_zip(path, weights_only=True).get_vec_normalize_env() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert earned(from_zip(path, weights_only=True, vec_normalize=statistics())) > -40
        from_zip(path, weights_only=True, vec_normalize=False)
