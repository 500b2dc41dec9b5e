"""SB3's callbacks in a run over two worlds: what they count is the target's, and which are in the wrong place."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_rpto.algorithms.environment_checks import members
from sb3_rpto.algorithms.normalisation import normalises


def check_callbacks(callback: BaseCallback, source: VecEnv | None, target_env: VecEnv | None) -> None:
    """Refuse a callback that is in the wrong place, or evaluates where it must not.

    In the target that D_target is collected from its steps would be counted nowhere, and the episode under way would
    jump. Without the source's normalisation the policy would see other observations there; SB3 fails then in mid-run.

    :raises ValueError: naming the callback
    """
    for one in _nested(callback):
        inside = getattr(one, "must_be_inside", None)
        if inside is not None and not isinstance(one.parent, inside):
            name = type(one).__name__
            raise ValueError(
                f"{name} works inside {inside.__name__}: {inside.__name__}(eval_env, callback_on_new_best={name}())"
            )
        evaluated = getattr(one, "eval_env", None)
        if isinstance(evaluated, VecEnv) and target_env is not None and members(evaluated) & members(target_env):
            raise ValueError(
                f"{type(one).__name__} evaluates in target_env itself, so the episode that D_target is collected from "
                "would jump; give it an environment of its own"
            )
        normalised = source is not None and normalises(unwrap_vec_normalize(source))
        if isinstance(one, EvalCallback) and normalised and unwrap_vec_normalize(one.eval_env) is None:
            raise ValueError(
                f"{type(one).__name__}'s environment is in no VecNormalize, and the policy sees observations that "
                "env's has normalised; give it VecNormalize(eval_env, training=False, norm_reward=False), as with SAC: "
                "SB3 copies the statistics there"
            )


def count_in_target(callback: BaseCallback, target_env: VecEnv | None) -> None:
    """Let what counts environments count the target's, not the source's."""
    for one in _nested(callback):
        if isinstance(one, ProgressBarCallback):
            one.__class__ = TargetProgressBar
        elif isinstance(one, StopTrainingOnMaxEpisodes) and target_env is not None:
            one._total_max_episodes = one.max_episodes * target_env.num_envs


class TargetProgressBar(ProgressBarCallback):
    """SB3's progress bar, advancing by the steps that count: those of ``num_timesteps``."""

    def _on_step(self) -> bool:
        self.pbar.update(self.model.num_timesteps - self.model._num_timesteps_at_start - self.pbar.n)
        return True


def _nested(callback: BaseCallback) -> Iterator[BaseCallback]:
    """A callback and all that lists and events of SB3's hold."""
    yield callback
    for part in (*getattr(callback, "callbacks", []), getattr(callback, "callback", None)):
        if isinstance(part, BaseCallback):
            yield from _nested(part)
