"""``sb3-rpto transfer``: a source agent to a target, by any method."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sb3_rpto.commands import options, recordings
from sb3_rpto.commands.terminal import say

if TYPE_CHECKING:
    from sb3_rpto.baselines.registry import Run
    from sb3_rpto.commands.runs import SavedCurve

DESCRIPTION = """\
Move a source agent to a target, and draw its learning curve there.

The source world is that of the target's task; for an environment of your own name it
by --source. Settings are the method's own (docs/baselines.md, the presets). The same
command goes on where it was killed: from its last evaluation.
"""

EXAMPLE = """\
example:
  sb3-rpto transfer runs/hopper-source/model.zip rpto/Hopper-target0-v0 --method rpto \\
    --source-data runs/hopper-source/replay_buffer.pkl --out runs/hopper-rpto

writes into DIR model.zip and result.json (configuration and learning curve); with
--set close_loop=true also report.html, report.json and the corrected simulator.
"""

#: What methods that load SAC's zip take beside SAC's arguments.
BESIDE_SAC = {
    "sac-warm-high": {"n_critics"},
    "sysid-retrain": {"declared", "retrain_steps", "max_steps", "dynamics_kwargs"},
}
#: SAC in the target, or in what was identified of it.
OF_SAC = ("sac", "sac-warm", "sac-warm-high", "sac-mixed", "sysid-retrain", "oracle")
#: Methods that begin anew: nothing is learned step by step, or in two parts.
NOT_RESUMABLE = ("zero-shot", "sysid-retrain")


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "transfer",
        help="move a source agent to a target, by any method",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source_model", metavar="ZIP", help="SAC that was trained in the source")
    parser.add_argument("target", metavar="TARGET", help="id of the target: rpto/Hopper-target0-v0")
    parser.add_argument(
        "--method", default="rpto", help="rpto (default), rpo, rto, sac-warm, mbpo, …: docs/baselines.md"
    )
    parser.add_argument("--source", metavar="ID", help="id of the source (default: that of the target's task)")
    parser.add_argument(
        "--source-data",
        metavar="FILE",
        help="source transitions: replay_buffer.pkl or .npz (default: fresh ones)",
    )
    options.add_statistics(parser, "ZIP")
    options.add_common(parser, of_target="target ")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Transfer, or go on with it."""
    from sb3_rpto.baselines.registry import REGISTRY, Run
    from sb3_rpto.commands.policies import save_statistics, say_statistics, statistics_of_source
    from sb3_rpto.commands.runs import RunFolder, SavedCurve, beside, statistics_asked
    from sb3_rpto.files import digest, write_atomically
    from sb3_rpto.sysid.report import figures
    from sb3_rpto.zoo.settings import ALGORITHMS, shipped_settings

    options.check_positive(parsed, "steps", "every", "episodes")
    options.check_seed(parsed.seed)
    if parsed.method not in REGISTRY:
        raise ValueError(f"--method {parsed.method!r} does not exist; choose one of {', '.join(REGISTRY)}")
    options.check_file(parsed.source_model, "ZIP")
    options.check_file(parsed.source_data, "--source-data")
    target = options.world(parsed.target, "TARGET")
    source = _source(parsed, target)
    settings = dict(parsed.set)
    if parsed.source_data is not None and not REGISTRY[parsed.method].takes_source_data:
        print(f"sb3-rpto: --method {parsed.method} has no use for --source-data", file=sys.stderr)
    budget = shipped_settings(parsed.method if parsed.method in ALGORITHMS else "rpto", target.env_id)["n_timesteps"]
    steps = parsed.steps or budget
    _check_settings(parsed.method, settings, steps)
    learns_anew = parsed.method == "sac"
    statistics = None if learns_anew else statistics_of_source(parsed.source_model, parsed.vec_normalize)
    _check_worlds(parsed, source, target, statistics)
    if settings.get("close_loop"):
        figures.require()
        recordings.check_out(parsed.out, source.make())
    every = parsed.every or max(steps // 10, 1)
    config = {
        "command": "transfer",
        "method": parsed.method,
        "source": source.name,
        "target": target.name,
        "steps": steps,
        "seed": parsed.seed,
        "settings": settings,
        "source_model": beside(parsed.out, parsed.source_model),
        "source_model_sha256": digest(parsed.source_model),
        "source_data": beside(parsed.out, parsed.source_data),
        "source_data_sha256": None if parsed.source_data is None else digest(parsed.source_data),
        "every": every,
        "episodes": parsed.episodes,
        **statistics_asked(parsed.out, statistics),
    }
    folder = RunFolder.open(parsed.out, config)
    if folder.result.exists():
        say(f"transferred already: {folder.model}")
        return 0
    method = REGISTRY[parsed.method]
    given = Run(
        parsed.source_model,
        source.make,
        target.make,
        steps,
        parsed.seed,
        source_data=parsed.source_data,
        kwargs=settings,
        device=parsed.device,
        vec_normalize=statistics,
    )
    say_statistics("ZIP", statistics)
    curve = SavedCurve(
        folder,
        given.make_target,
        every,
        steps,
        parsed.episodes,
        parsed.seed,
        after_update=method.in_batches,
        resumable=parsed.method not in NOT_RESUMABLE,
        say=None if parsed.quiet else say,
    )
    checkpoint = folder.newest_checkpoint()
    if checkpoint is None:
        method.run(given, curve)
    else:
        _go_on(checkpoint, given, curve)
    curve.env.close()
    save_statistics(folder.path, curve.judged)
    write_atomically(folder.model, curve.judged.save)
    rows = [{"method": parsed.method, "seed": parsed.seed, **row} for row in curve.rows]
    folder.finish(rows)
    first, last = rows[0], rows[-1]
    told = f"return {first['return']:.1f} before, {last['return']:.1f} after {last['steps']:,} target steps"
    say(f"{told}; written: {folder.model}")
    return 0


def _source(parsed: argparse.Namespace, target: options.World) -> options.World:
    """The source.

    :raises ValueError: where it is not known, or is the target
    """
    from sb3_rpto.zoo.settings import source_of

    name = parsed.source or source_of(target.env_id)
    if name is None:
        raise ValueError(f"TARGET {target.name!r} is none of our targets: pass the source's id by --source ID")
    source = options.world(name, "--source")
    if source == target:
        raise ValueError(f"TARGET {target.name!r} is the source itself; name another world (docs/tasks.md)")
    return source


def _check_settings(method: str, settings: dict[str, Any], steps: int) -> None:
    """Refuse settings that the method does not know, or that its budget does not bear.

    :raises ValueError: naming the argument
    """
    from sb3_rpto.baselines.sac_variants import check_step_by_step

    options.check_names(settings, _known_settings(method))
    if method == "sysid-retrain" and not settings.get("declared"):
        raise ValueError("--method sysid-retrain needs --set 'declared=[...]', the simulator's numbers to identify")
    if method not in OF_SAC:
        return
    options.check_sac({name: value for name, value in settings.items() if name not in BESIDE_SAC.get(method, set())})
    check_step_by_step(settings)
    if method == "sac":
        options.check_learns(settings, steps)
    elif "learning_starts" in settings:
        raise ValueError(f"--set learning_starts: --method {method} takes no random steps; leave it out")


def _check_worlds(
    parsed: argparse.Namespace,
    source: options.World,
    target: options.World,
    statistics: str | Literal[False] | None,
) -> None:
    """Refuse what would fail later: an agent, a source, transitions or statistics of another task.

    Algorithms of ours tell by themselves of an agent that sees other observations than it has; for others it is done
    here.

    :raises ValueError: naming the argument
    """
    from sb3_rpto.algorithms.warm_start import load_sac
    from sb3_rpto.baselines.registry import REGISTRY
    from sb3_rpto.buffers import load_transitions
    from sb3_rpto.zoo.settings import ALGORITHMS

    sac = load_sac(parsed.source_model, "cpu")
    for argument, world in (("TARGET", target), ("--source", source)):
        env = world.make()
        for name in ("observation_space", "action_space"):
            of_agent, of_world = getattr(sac, name), getattr(env, name)
            if of_agent.shape != of_world.shape:
                raise ValueError(
                    f"ZIP {parsed.source_model!r} has {name} {of_agent}, {argument} {of_world}; name its task's agent"
                )
        env.close()
    if statistics or parsed.method not in (*ALGORITHMS, "sac"):
        _doubt_agent(sac, source, statistics, told=parsed.method in ALGORITHMS)
    if parsed.source_data is None or not REGISTRY[parsed.method].takes_source_data:
        return
    try:
        data = load_transitions(parsed.source_data)
    except ValueError as error:
        raise ValueError(f"--source-data: {error}") from error
    for name, space in (("observations", sac.observation_space), ("actions", sac.action_space)):
        found, expected = data[name][0].size, math.prod(space.shape or ())
        if found != expected:
            raise ValueError(f"--source-data holds {name} of {found} numbers, the agent's have {expected}")


def _doubt_agent(sac: Any, source: options.World, statistics: str | Literal[False] | None, told: bool) -> None:
    """Warn of an agent that would see other observations than it has, as far as its zip tells.

    :param sac: the agent
    :param source: its world
    :param statistics: by which it is to see
    :param told: whether that is said elsewhere
    :raises ValueError: statistics of other observations
    """
    from stable_baselines3.common.vec_env import VecNormalize

    from sb3_rpto.algorithms.normalisation import check_source_model, in_statistics
    from sb3_rpto.algorithms.validation import doubt_returns

    env: Any = source.make()
    if statistics:
        env = in_statistics(env, statistics, options.STATISTICS)
    seen = env if isinstance(env, VecNormalize) else None
    if not told and not check_source_model(sac, seen, seen):
        doubt_returns(sac, env)
    env.close()


def _known_settings(method: str) -> set[str]:
    """Names that a method takes, without those that the command gives itself.

    :raises ImportError: without sb3-contrib, where it is needed
    """
    return _arguments_of(method) - {"policy", "env", "target_env", "target_data", "seed", "device"}


def _arguments_of(method: str) -> set[str]:
    from stable_baselines3 import SAC

    from sb3_rpto.algorithms.arguments import constructor_names
    from sb3_rpto.zoo.settings import ALGORITHMS

    if method in ALGORITHMS:
        return constructor_names(ALGORITHMS[method])
    if method == "trpo-warm":
        from sb3_contrib import TRPO

        return constructor_names(TRPO)
    return constructor_names(SAC) | BESIDE_SAC.get(method, set())


def _go_on(checkpoint: Path, given: Run, curve: SavedCurve) -> None:
    """Learn on from a checkpoint to the end of the budget."""
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_rpto.algorithms.transfer import TransferAlgorithm
    from sb3_rpto.commands.policies import in_saved
    from sb3_rpto.commands.runs import algorithm_of, load_checkpoint

    if issubclass(algorithm_of(checkpoint), TransferAlgorithm):
        source = in_saved(make_vec_env(given.make_source, n_envs=given.n_source_envs), checkpoint)
        model = load_checkpoint(checkpoint, source, given.device, target_env=given.make_target())
    else:
        model = load_checkpoint(checkpoint, in_saved(given.make_target(), checkpoint), given.device)
    curve.restore(checkpoint)
    model.learn(given.budget - model.num_timesteps, callback=curve, reset_num_timesteps=False)
