"""``sb3-rpto enjoy``: what a policy earns, and how it looks beside the one that it came from."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_rpto.commands import options
from sb3_rpto.commands.terminal import say

if TYPE_CHECKING:
    import gymnasium as gym

    from sb3_rpto.commands.policies import Policy

DESCRIPTION = """\
Run a policy and print its returns. With --video, draw the source policy in the source,
the source policy in the target (zero-shot) and the policy in the target side by side; where
no source agent is known, as after 'train', the policy alone.

MODEL is a zip, or the folder of 'sb3-rpto transfer', 'train' or 'adapt', which knows the
environments and the source agent. After 'adapt' the target is the corrected simulator.
"""

EXAMPLE = """\
examples:
  sb3-rpto enjoy runs/hopper-rpto --video hopper.mp4
  sb3-rpto enjoy runs/hopper --video hopper.gif
  sb3-rpto enjoy model.zip rpto/Hopper-target0-v0 --source-model source.zip --video hopper.gif
"""


@dataclass(frozen=True)
class Corrected(options.World):
    """A simulator with what a log showed that it lacks.

    :param folder: of ``adapt``, which left it there
    """

    folder: Path = field(kw_only=True)

    def make(self, **more: Any) -> gym.Env:
        """The corrected environment."""
        from sb3_rpto.effects.corrected_model_io import read_effects
        from sb3_rpto.effects.walker_reset import StandingEnv

        env = super().make(**more)
        base: Any = env.unwrapped
        return StandingEnv(env, read_effects(self.folder / "effects.json", base.model))


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "enjoy",
        help="run a policy; film it beside the source policy",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", metavar="MODEL", type=Path, help="zip of a model, or a run's folder")
    parser.add_argument("target", metavar="TARGET", nargs="?", help="id of the world to run in (default: the run's)")
    parser.add_argument("--episodes", metavar="N", type=int, default=10, help="(default: 10)")
    parser.add_argument(
        "--seed", metavar="N", type=int, default=0, help="of the initial states and drawn actions (default: 0)"
    )
    parser.add_argument("--stochastic", action="store_true", help="draw actions as in training")
    parser.add_argument("--video", metavar="FILE", type=Path, help="write a film: .mp4 or .gif")
    parser.add_argument("--seconds", metavar="S", type=float, default=10.0, help="of the film at most (default: 10)")
    parser.add_argument("--source-model", metavar="ZIP", help="agent of the source, for the film (default: the run's)")
    options.add_statistics(parser, "MODEL")
    parser.add_argument("--source", metavar="ID", help="id of the source, for the film (default: likewise)")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Evaluate, then film."""
    import numpy as np
    from stable_baselines3.common.utils import set_random_seed

    from sb3_rpto.algorithms.normalisation import statistics_of
    from sb3_rpto.commands.policies import load_policy, say_statistics, statistics_named

    options.check_positive(parsed, "episodes")
    options.check_seed(parsed.seed)
    if not 0 < parsed.seconds < float("inf"):
        raise ValueError(f"--seconds is {parsed.seconds:g}; give a time above 0")
    model, known = _model(parsed.model)
    target = _target(parsed, known)
    named = statistics_named(parsed.vec_normalize)
    statistics = (statistics_of(model) if named is None else named) or None
    policy = load_policy(model, "MODEL", statistics)
    say_statistics("MODEL", statistics)
    _check_spaces(policy, target, "MODEL", "TARGET")
    beside = _to_film(parsed, known, target) if parsed.video is not None else None

    env = target.make()
    set_random_seed(parsed.seed)  # of the actions of --stochastic
    returns = []
    for episode in range(parsed.episodes):
        returns.append(_episode(env, policy, parsed.seed if episode == 0 else None, not parsed.stochastic))
        print(f"episode {episode + 1}: return {returns[-1]:.1f}", flush=True)
    env.close()
    print(f"mean return {np.mean(returns):.1f}, standard deviation {np.std(returns):.1f}, {len(returns)} episodes")
    if parsed.video is not None:
        _film(parsed, policy, target, beside)
    return 0


def _target(parsed: argparse.Namespace, known: dict[str, Any]) -> options.World:
    """Where the policy is to run: what was asked for, the target of its run, or the simulator that ``adapt`` corrected.

    :raises ValueError: neither is known, or the world cannot be made
    """
    name = parsed.target or known.get("target")
    if name is not None:
        return options.world(name, "TARGET")
    if known.get("command") == "adapt":
        nominal = options.world(known["env"], "MODEL")
        return Corrected(nominal.name, nominal.env_id, nominal.kwargs, folder=parsed.model)
    raise ValueError(f"MODEL {str(parsed.model)!r} does not tell its world: pass TARGET, the id of one")


def _model(path: Path) -> tuple[Path, dict[str, Any]]:
    """The zip, and what is known of its run: command, target, source or env, source_model."""
    from sb3_rpto.commands.runs import RunFolder

    if not path.is_dir():
        options.check_file(path, "MODEL")
        return path, {}
    known = RunFolder(path).begun() or {}
    if known and not (path / "model.zip").is_file():
        if RunFolder(path).result.exists():
            raise FileNotFoundError(
                f"MODEL {path}: its run is finished and model.zip is gone; remove result.json, and repeat the command"
            )
        raise FileNotFoundError(f"MODEL {path}: its run is not finished; repeat the command that began it to go on")
    options.check_file(path / "model.zip", "MODEL")
    return path / "model.zip", {name: value for name, value in known.items() if value is not None}


def _to_film(
    parsed: argparse.Namespace, known: dict[str, Any], target: options.World
) -> tuple[Policy, options.World] | None:
    """The source policy and the source of a film, None for one of the policy alone.

    All that can fail does so here, before anything is run.
    """
    from sb3_rpto.algorithms.normalisation import statistics_of
    from sb3_rpto.commands import video
    from sb3_rpto.commands.policies import load_policy, say_statistics
    from sb3_rpto.zoo.settings import source_of

    video.require(parsed.video)
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        os.environ.setdefault("MUJOCO_GL", "egl")  # of what draws without a display, what works
    agent = parsed.source_model or _agent_of(parsed.model, known)
    found = None
    if agent is not None:
        name = parsed.source or known.get("source") or known.get("env") or source_of(target.env_id)
        if name is None:
            raise ValueError(f"TARGET {target.name!r} is none of our targets: pass the source's id by --source ID")
        options.check_file(agent, "--source-model")
        source = options.world(name, "--source")
        # A run knows by what its agent sees.
        of_run = parsed.source_model is None and "source_model" in known
        statistics = _statistics_of_run(parsed.model, known) if of_run else statistics_of(agent)
        found = load_policy(agent, "--source-model", statistics), source
        say_statistics("--source-model", statistics)
        _check_spaces(found[0], source, "--source-model", "--source")
    elif parsed.source is not None:
        raise ValueError("--source is the world of the source policy: pass its zip by --source-model, too")
    trial = target.make(render_mode="rgb_array")
    trial.reset(seed=0)
    try:
        trial.render()
    except Exception as error:  # of whatever draws: MuJoCo's FatalError, OpenGL's, glfw's
        raise ValueError(
            f"--video: {target.name} cannot be drawn ({error}); unset DISPLAY, or set MUJOCO_GL=egl"
        ) from error
    trial.close()
    return found


def _agent_of(folder: Path, known: dict[str, Any]) -> str | None:
    """The source agent of a run, whose path is kept relative to its folder.

    :raises FileNotFoundError: it is there no longer
    :raises ValueError: another is in its place
    """
    from sb3_rpto.files import digest

    agent = known.get("source_model")
    if agent is None:
        return None
    found = [path for path in (folder / agent, Path(agent)) if path.is_file()]
    if not found:
        raise FileNotFoundError(f"the run's source agent {agent!r} is not there; pass its zip by --source-model")
    if known.get("source_model_sha256") not in (None, digest(found[0])):
        raise ValueError(f"{found[0]} is another agent than the run began with; pass that one's zip by --source-model")
    return str(found[0])


def _statistics_of_run(folder: Path, known: dict[str, Any]) -> Path | None:
    """The statistics by which the source agent of a run saw observations, where the run was told."""
    named = known.get("vec_normalize")
    found = [] if named is None else [path for path in (folder / named, Path(named)) if path.is_file()]
    return found[0] if found else None


def _check_spaces(policy: Policy, world: options.World, argument: str, of: str) -> None:
    """Refuse a policy of another task.

    :raises ValueError: naming the argument
    """
    env = world.make()
    for name in ("observation_space", "action_space"):
        of_policy, of_env = getattr(policy, name), getattr(env, name)
        if of_policy.shape != of_env.shape:
            raise ValueError(f"{argument} has {name} {of_policy}, {of} {world.name!r} has {of_env}; name the same task")
    env.close()


def _episode(env: Any, policy: Policy, seed: int | None, deterministic: bool) -> float:
    observation, _ = env.reset(seed=seed)
    total, over, state = 0.0, False, None
    while not over:
        action, state = policy.predict(observation, state, deterministic=deterministic)
        observation, reward, terminated, truncated, _ = env.step(action)
        total += float(reward)
        over = terminated or truncated
    return total


def _film(
    parsed: argparse.Namespace, policy: Policy, target: options.World, beside: tuple[Policy, options.World] | None
) -> None:
    from stable_baselines3.common.utils import set_random_seed

    from sb3_rpto.commands.video import Panel, film

    in_target = partial(target.make, render_mode="rgb_array")
    panels = [
        Panel(
            "policy" if beside is None else "transferred policy in the target", policy, in_target, not parsed.stochastic
        )
    ]
    if beside is not None:
        from_source, source = beside
        in_source = partial(source.make, render_mode="rgb_array")
        panels = [
            Panel("source policy in the source", from_source, in_source, not parsed.stochastic),
            Panel("source policy in the target (zero-shot)", from_source, in_target, not parsed.stochastic),
            *panels,
        ]
    set_random_seed(parsed.seed)
    film(panels, parsed.video, parsed.seconds, parsed.seed)
    say(f"written: {parsed.video}")
