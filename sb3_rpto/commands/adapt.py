"""``sb3-rpto adapt``: from a robot's log to a policy that was trained in the corrected simulator."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from sb3_rpto.commands import options, recordings

DESCRIPTION = """\
Go from a robot's log to a policy for it, without a step on the robot: say from the
log what the simulator lacks, correct it, and let the policy learn on there (RPTO).

The same command goes on where it was killed: from its last checkpoint.
"""

EXAMPLE = """\
example:
  sb3-rpto adapt source.zip InvertedDoublePendulum-v5 'log/*.csv' --declare pole.length --out runs/robot

writes into DIR report.html to read, report.json, the corrected simulator (model.xml, effects.json), model.zip
and result.json. Recordings: docs/measurements.md. The whole way: docs/robot-log-to-policy.md
"""

#: What the command gives itself.
GIVEN = frozenset(
    {
        *("self", "policy", "env", "target_env", "target_data", "dynamics", "declared", "close_loop", "effects"),
        *("seed", "device"),
    }
)


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "adapt",
        help="from a robot's log to a policy for it",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source_model", metavar="ZIP", help="SAC that was trained in the simulator")
    parser.add_argument("env", metavar="ENV", help="id of the simulator: HalfCheetah-v5, package:name/Task-v0")
    options.add_statistics(parser, "ZIP")
    recordings.add(parser)
    parser.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder of the run; it resumes there")
    parser.add_argument(
        "--steps", metavar="N", type=int, default=64_000, help="in the simulator, 8 for each update (default: 64,000)"
    )
    options.add_settings(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Trace and learn, or go on with it."""
    from sb3_rpto import RPTO
    from sb3_rpto.algorithms.arguments import constructor_names
    from sb3_rpto.commands.policies import in_saved, save_statistics, say_statistics, statistics_of_source
    from sb3_rpto.commands.progress import Progress, earnings, read_rows
    from sb3_rpto.commands.runs import RunFolder, beside, load_checkpoint, statistics_asked
    from sb3_rpto.commands.terminal import lines, say
    from sb3_rpto.effects import Declared
    from sb3_rpto.files import digest, write_atomically
    from sb3_rpto.sysid.report import figures

    figures.require()
    options.check_positive(parsed, "steps")
    options.check_seed(parsed.seed)
    options.check_file(parsed.source_model, "ZIP")
    statistics = statistics_of_source(parsed.source_model, parsed.vec_normalize)
    recordings.check_candidates(parsed.candidates)
    settings = dict(parsed.set)
    options.check_names(settings, constructor_names(RPTO) - GIVEN)
    world = options.world(parsed.env, "ENV")
    simulator = world.make()
    recordings.check_out(parsed.out, simulator)
    known = recordings.known(parsed.known, simulator)
    # What the user declares comes last: its bounds are those that count.
    declared = [*(effect.label for effect in known if isinstance(effect, Declared)), *parsed.declare]
    effects = [e.to_json() for e in known if not isinstance(e, Declared)]
    if effects:
        own = settings.get("dynamics_kwargs", {})
        if "effects" in own:
            raise ValueError(
                "--known and --set dynamics_kwargs both give effects; give them all in the file of --known"
            )
        settings["dynamics_kwargs"] = {**own, "effects": effects}
    data = replace(recordings.read(parsed.files, parsed.format, parsed.rename), simulated=parsed.simulated)
    config = {
        "command": "adapt",
        "env": world.name,
        "source_model": beside(parsed.out, parsed.source_model),
        "source_model_sha256": digest(parsed.source_model),
        "files": [beside(parsed.out, file) for file in parsed.files],
        "recordings_sha256": recordings.digest(data),
        "declare": parsed.declare,
        "candidates": parsed.candidates,
        "known": None if parsed.known is None else beside(parsed.out, parsed.known),
        "known_sha256": None if parsed.known is None else digest(parsed.known),
        "steps": parsed.steps,
        "seed": parsed.seed,
        "settings": dict(parsed.set),
        **statistics_asked(parsed.out, statistics),
        **({"simulated": True} if parsed.simulated else {}),  # runs of earlier versions do not tell
    }
    folder = RunFolder.open(parsed.out, config)
    if folder.result.exists():
        say(f"adapted already: {folder.model}")
        return 0
    say_statistics("ZIP", statistics)
    checkpoint = folder.newest_checkpoint()
    model: Any
    if checkpoint is None:
        model = RPTO.from_source(
            parsed.source_model,
            simulator,
            target_data=data,
            dynamics="physical",
            declared=declared,
            close_loop=True,
            effects=parsed.candidates or "all",
            seed=parsed.seed,
            device=parsed.device,
            vec_normalize=statistics,
            **settings,
        )
        rows = []
    else:
        model = load_checkpoint(checkpoint, in_saved(simulator, checkpoint), device=parsed.device)
        rows = read_rows(checkpoint)
    model.loop.progress = None if parsed.quiet else lines()
    progress = Progress(folder, parsed.steps, rows, parsed.quiet)
    model.learn(parsed.steps - model.num_timesteps, callback=progress, reset_num_timesteps=checkpoint is None)
    save_statistics(folder.path, model)
    write_atomically(folder.model, model.save)
    folder.finish(progress.rows)
    say(f"{earnings(model.loop)}; written: {folder.model}")
    return 0
