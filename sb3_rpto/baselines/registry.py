"""Every method by its name: how it is built and run, and how many updates a target step its authors take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms import RPO, RPTO, RTO
from sb3_rpto.algorithms.normalisation import in_statistics
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.baselines import sac_variants
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.pdml import PDML
from sb3_rpto.baselines.policy_distillation import clone_kwargs
from sb3_rpto.baselines.ptp import PTP
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.evaluation.learning_curve import LearningCurve, MakeEnv
from sb3_rpto.presets import resolve_preset


@dataclass(frozen=True)
class Run:
    """What a method is given; see :func:`~sb3_rpto.baselines.transfer.transfer`.

    :param vec_normalize: file of the statistics by which the source model sees observations; False: it sees raw ones;
        None: algorithms of ours look beside its zip
    :param device: to learn on; runs side by side are quickest on the CPU
    :param before_learning: is given an algorithm of ours as it was constructed
    """

    source_model: str
    make_source: MakeEnv
    make_target: MakeEnv
    budget: int
    seed: int = 0
    n_source_envs: int = 1
    source_data: str | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    before_learning: Callable[[TransferAlgorithm], None] = lambda model: None
    vec_normalize: str | Literal[False] | None = None

    def source(self, n_envs: int = 1) -> VecEnv:
        """The source as the source model sees it."""
        return self.seen(make_vec_env(self.make_source, n_envs=n_envs))  # type: ignore[return-value]  # as passed

    def target(self) -> GymEnv:
        """The target as the source model sees it."""
        return self.seen(self.make_target())

    def seen(self, env: GymEnv) -> GymEnv:
        """An environment in the statistics by which the source model sees observations, if there are some."""
        return in_statistics(env, self.vec_normalize) if self.vec_normalize else env

    def source_id(self) -> str | None:
        """The source's id, None where it has none."""
        env = self.make_source()
        env_id = None if env.spec is None else env.spec.id
        env.close()
        return env_id

    def source_transitions(self, curve: LearningCurve) -> dict[str, Any]:
        """Transitions of the source; what fresh ones cost is in the curve's source steps."""
        data, spent = sac_variants.source_transitions(
            self.source_model, self.seen(self.make_source()), self.seed, self.source_data
        )
        curve.source_steps += spent
        return data


@dataclass(frozen=True)
class Method:
    """A method of the harness.

    :param run: spends exactly the budget of target steps and leaves the curve's rows
    :param in_batches: learns from many target steps at once, so that it is evaluated after it has
    :param takes_source_data: has a use for recorded transitions of the source
    """

    run: Callable[[Run, LearningCurve], None]
    in_batches: bool = False
    takes_source_data: bool = True


def _zero_shot(run: Run, curve: LearningCurve) -> None:
    curve.begin(sac_variants.fine_tuned_sac(run.source_model, run.target(), run.seed, run.device, **run.kwargs))


def two_worlds(cls: type[TransferAlgorithm], run: Run, curve: LearningCurve) -> None:
    """Algorithms over a source and a target, warm-started from the source model."""
    # Its own statistics: from_source() wraps the source, and the target shares them.
    source, kwargs = make_vec_env(run.make_source, n_envs=run.n_source_envs), dict(run.kwargs)
    kwargs |= {"source_data": run.source_data, "vec_normalize": run.vec_normalize}
    model = cls.from_source(run.source_model, source, run.make_target(), seed=run.seed, device=run.device, **kwargs)
    run.before_learning(model)
    model.learn(run.budget, callback=curve)


def _slbo(run: Run, curve: LearningCurve) -> None:
    stage = min(SLBO.NUMBERS["model_train_freq"], max(run.budget // 4, 1))
    two_worlds(SLBO, Run(**{**vars(run), "kwargs": {"model_train_freq": stage, **run.kwargs}}), curve)


def _sac(run: Run, curve: LearningCurve) -> None:
    SAC("MlpPolicy", run.make_target(), seed=run.seed, device=run.device, **run.kwargs).learn(
        run.budget, callback=curve
    )


def _sac_warm(run: Run, curve: LearningCurve) -> None:
    model = sac_variants.fine_tuned_sac(run.source_model, run.target(), run.seed, run.device, **run.kwargs)
    model.learn(run.budget, callback=curve)


def _sac_warm_high(run: Run, curve: LearningCurve) -> None:
    settings = {"gradient_steps": _rpto_updates(run.source_id()), **run.kwargs}
    n_critics = settings.pop("n_critics", None)
    if n_critics is None:
        model = sac_variants.fine_tuned_sac(run.source_model, run.target(), run.seed, run.device, **settings)
    else:
        sac_variants.check_critics(SAC.load(run.source_model, device="cpu"), n_critics)
        data = run.source_transitions(curve)
        model = sac_variants.with_more_critics(
            run.source_model, run.target(), run.seed, n_critics, data, run.device, **settings
        )
    model.learn(run.budget, callback=curve)


def _sac_mixed(run: Run, curve: LearningCurve) -> None:
    data = run.source_transitions(curve)
    model = sac_variants.mixed_sac(run.source_model, run.target(), run.seed, data, run.device, **run.kwargs)
    model.learn(run.budget, callback=curve)


def _trpo_warm(run: Run, curve: LearningCurve) -> None:
    sac_variants.trpo_steps(run.budget, run.kwargs.get("n_steps"))
    clone_kwargs(SAC.load(run.source_model, device="cpu"))  # what cannot be cloned shows before states are collected
    states = run.source_transitions(curve)["observations"]
    model = sac_variants.cloned_trpo(
        run.source_model, run.target(), run.seed, run.budget, states, run.device, **run.kwargs
    )
    model.learn(run.budget, callback=curve)


def _sysid_retrain(run: Run, curve: LearningCurve) -> None:
    settings = dict(run.kwargs)
    declared, retrain_steps = settings.pop("declared", ()), settings.pop("retrain_steps", 20_000)
    identification = {name: settings.pop(name) for name in ("max_steps", "dynamics_kwargs") if name in settings}
    if not declared:
        raise ValueError("sysid-retrain needs declared=[...], the names of the simulator's numbers to identify")
    for name, steps in (("retrain_steps", retrain_steps), ("max_steps", identification.get("max_steps", 1))):
        if not isinstance(steps, int) or steps < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {steps!r}")
    # The target's steps are spent before these are used: what is wrong with them shows now.
    source = run.source()
    sac_variants.unfitted_source(source, declared, identification.get("dynamics_kwargs"))
    sac_variants.fine_tuned_sac(run.source_model, source, run.seed, run.device, **settings)
    recorder = sac_variants.fine_tuned_sac(run.source_model, run.target(), run.seed, run.device, gradient_steps=0)
    recorder.learn(run.budget, callback=curve)
    assert recorder.replay_buffer is not None  # learn() has filled it
    simulator, _ = sac_variants.identified_source(
        recorder.replay_buffer, recorder, source, declared, run.seed, **identification
    )
    model = sac_variants.fine_tuned_sac(run.source_model, simulator, run.seed, run.device, **settings)
    model.learn(retrain_steps)
    curve.source_steps += retrain_steps
    curve.finish(model, run.budget)


def _rpto_updates(env_id: str | None) -> int:
    """RPTO's updates per target step of a task."""
    return resolve_preset("default", "ensemble", env_id, ())["gradient_steps"]


#: All methods, by the names of the command line.
REGISTRY: dict[str, Method] = {
    "zero-shot": Method(_zero_shot, takes_source_data=False),
    "rpo": Method(partial(two_worlds, RPO)),
    "rto": Method(partial(two_worlds, RTO)),
    "rpto": Method(partial(two_worlds, RPTO)),
    "sac": Method(_sac, takes_source_data=False),
    "sac-warm": Method(_sac_warm, takes_source_data=False),
    "sac-warm-high": Method(_sac_warm_high),
    "sac-mixed": Method(_sac_mixed),
    "trpo-warm": Method(_trpo_warm, in_batches=True),
    "mbpo": Method(partial(two_worlds, MBPO)),
    "slbo": Method(_slbo, in_batches=True),
    "ptp": Method(partial(two_worlds, PTP)),
    "pdml": Method(partial(two_worlds, PDML)),
    "sysid-retrain": Method(_sysid_retrain, in_batches=True, takes_source_data=False),
    "oracle": Method(_sac_warm, takes_source_data=False),
}
