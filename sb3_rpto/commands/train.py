"""``sb3-rpto train``: a SAC of a task, the source policy of later transfers."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_rpto.commands import options
from sb3_rpto.commands.terminal import say

DESCRIPTION = """\
Train a SAC in a task: the source agent of later transfers.

Settings are those of hyperparams/zoo/sac.yml, then SAC's defaults. The same command
goes on where it was killed: from its last evaluation.
"""

EXAMPLE = """\
example:
  sb3-rpto train Hopper --out runs/hopper-source

writes into DIR model.zip, replay_buffer.pkl (which transfers take as --source-data)
and result.json (configuration and learning curve).
"""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "train",
        help="train a source agent",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("task", metavar="TASK", help="Hopper, rpto/Hopper-v0, Pendulum-v1, package:name/Task-v0")
    options.add_common(parser)
    parser.add_argument("--until", metavar="RETURN", type=float, help="end early, at an evaluation that reaches this")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Train, or go on with it."""
    from stable_baselines3 import SAC

    from sb3_rpto.algorithms.arguments import constructor_names
    from sb3_rpto.algorithms.environment_checks import check_spaces
    from sb3_rpto.commands.runs import RunFolder, SavedCurve, load_checkpoint
    from sb3_rpto.files import write_atomically
    from sb3_rpto.zoo.settings import shipped_settings

    options.check_positive(parsed, "steps", "every", "episodes")
    options.check_seed(parsed.seed)
    task = options.world(parsed.task, "TASK")
    settings = {**shipped_settings("sac", task.env_id), **dict(parsed.set)}
    steps = int(settings.pop("n_timesteps") if parsed.steps is None else parsed.steps)
    settings.pop("n_timesteps", None)
    options.check_names(settings, constructor_names(SAC) - {"env", "seed", "device"})
    options.check_sac(settings)
    options.check_learns(settings, steps)
    env = task.make()
    check_spaces(env.observation_space, env.action_space)
    settings.setdefault("buffer_size", min(1_000_000, steps))  # SAC's, but no larger a file than there is to keep
    every = parsed.every or max(steps // 10, 1)
    config = {
        "command": "train",
        "method": "sac",
        "target": task.name,
        "steps": steps,
        "seed": parsed.seed,
        "settings": settings,
        "every": every,
        "episodes": parsed.episodes,
        "until": parsed.until,
    }
    folder = RunFolder.open(parsed.out, config)
    if folder.result.exists():
        say(f"trained already: {folder.model}")
        return 0
    told = None if parsed.quiet else say
    curve = SavedCurve(folder, task.make, every, steps, parsed.episodes, parsed.seed, until=parsed.until, say=told)
    checkpoint = folder.newest_checkpoint()
    model: Any
    if checkpoint is None:
        model = SAC(env=env, seed=parsed.seed, device=parsed.device, **settings)
    else:
        model = load_checkpoint(checkpoint, env, device=parsed.device)
        curve.restore(checkpoint)
    model.learn(steps - model.num_timesteps, callback=curve, reset_num_timesteps=checkpoint is None)
    curve.env.close()
    write_atomically(folder.replay_buffer, model.save_replay_buffer, suffix="pkl")
    write_atomically(folder.model, model.save)
    rows = [{"method": "sac", "seed": parsed.seed, **row} for row in curve.rows]
    folder.finish(rows)
    last = rows[-1]
    say(f"return {last['return']:.1f} after {last['steps']:,} steps; written: {folder.model}")
    return 0
