"""``python -m sb3_rpto.zoo.train``: ``rl_zoo3 train`` with RPO, RTO, RPTO and the model-based baselines."""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from sb3_rpto import zoo
from sb3_rpto.zoo.settings import ALGORITHMS, source_of

if TYPE_CHECKING:
    from sb3_rpto.zoo.manager import Start

DESCRIPTION = """\
Train in the RL Zoo. With --algo rpo, rto, rpto, mbpo, ptp, pdml or slbo, --env is the target and its source is that of
the task; steps, checkpoints, evaluation and the search's trials are the target's. The options below come on top of
those of rl_zoo3, which follow them.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, resume or search.

    :param arguments: without the program's name; default: those of the process
    :return: exit code: 0 done, 2 bad input
    """
    try:
        zoo.require()
    except ImportError as error:
        print(f"sb3_rpto.zoo.train: error: {error}", file=sys.stderr)
        return 2
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    if {"-h", "--help"} & set(given):
        parser.print_help()
    ours, rest = parser.parse_known_args(given)
    start = _start(parser, ours, rest)

    import rl_zoo3.train

    from sb3_rpto.zoo.manager import TransferManager

    fill_zoo()
    with _replaced(rl_zoo3.train, "ExperimentManager", partial(TransferManager, start=start)), command_line(rest):
        rl_zoo3.train.train()
    return 0


def fill_zoo() -> None:
    """Add the algorithms to those of the zoo, with their search spaces."""
    import rl_zoo3
    from rl_zoo3.gym_patches import PatchedTimeLimit
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    from sb3_rpto.zoo.samplers import SAMPLERS, convert

    rl_zoo3.ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    converters: dict[str, Any] = dict.fromkeys(ALGORITHMS, convert)
    HYPERPARAMS_CONVERTER.update(converters)
    # The zoo replaces gymnasium's TimeLimit; a checkpoint must know what changes in its own.
    time_limit: Any = PatchedTimeLimit
    time_limit.state_attributes = ("_elapsed_steps",)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_rpto.zoo.train",
        description=DESCRIPTION,
        add_help=False,  # rl_zoo3's parser has it
        allow_abbrev=False,  # --s is none of ours
    )
    parser.add_argument("--source-env", metavar="ID", help="id of the source (default: that of the target's task)")
    parser.add_argument(
        "--source-model", metavar="ZIP", help="SAC trained in the source (default: the run trains one first)"
    )
    parser.add_argument(
        "--source-data",
        metavar="FILE",
        help="transitions of the source: SB3's replay buffer or .npz (default: collected with the source agent)",
    )
    parser.add_argument(
        "--source-timesteps",
        metavar="N",
        type=int,
        help="source steps without --source-model (default: 10 times -n, at most 300,000)",
    )
    return parser


def _start(parser: argparse.ArgumentParser, ours: argparse.Namespace, rest: list[str]) -> Start | None:
    """Where the run starts; None for an algorithm of one world, which the zoo trains without us."""
    from sb3_rpto.zoo.manager import Start

    known = argparse.ArgumentParser(add_help=False, allow_abbrev=False)  # what of the zoo's options is needed here
    known.add_argument("--algo", default="ppo")
    known.add_argument("--env", default="")
    known.add_argument("-i", "--trained-agent")
    known.add_argument("--seed", type=int, default=-1)
    known.add_argument("--eval-env-kwargs", nargs="+")
    known.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    known.add_argument("--storage")
    known.add_argument("--study-name")
    known.add_argument("--trial-id", type=int)
    theirs, _ = known.parse_known_args(rest)
    if theirs.algo not in ALGORITHMS:
        passed = [f"--{name.replace('_', '-')}" for name, value in vars(ours).items() if value is not None]
        if passed:
            parser.error(
                f"{', '.join(passed)}: --algo {theirs.algo} has one world; leave it out (-i goes on from a zip)"
            )
        return None
    for name in ("source_model", "source_data"):
        path = getattr(ours, name)
        if path is not None and not Path(path).is_file():
            parser.error(f"--{name.replace('_', '-')}: there is no file {path!r}; check the path")
    source = ours.source_env or source_of(theirs.env)
    if source is None:
        close = difflib.get_close_matches(theirs.env, gym.registry.keys(), n=1)
        hint = f" (or did you mean {close[0]}?)" if close and theirs.env not in gym.registry else ""
        parser.error(f"--env {theirs.env} is none of our targets: pass its source by --source-env ID{hint}")
    if source == theirs.env and not theirs.eval_env_kwargs:
        parser.error(
            f"--env {theirs.env} is the source; name a target such as {source.removesuffix('-v0')}-target0-v0, or pass "
            "the target's arguments by --eval-env-kwargs"
        )
    if theirs.optimize_hyperparameters and not ALGORITHMS[theirs.algo].updates_policy:
        parser.error(
            f"-optimize judges policies, and --algo {theirs.algo} leaves the policy as it is; search with rpto"
        )
    if theirs.optimize_hyperparameters and ours.source_model is None:
        parser.error("-optimize needs --source-model: without it, every trial would first train an agent in the source")
    if theirs.trial_id is not None and not (theirs.storage and theirs.study_name):
        parser.error(f"--trial-id {theirs.trial_id} needs the --storage and the --study-name of its search")
    if ours.source_model is not None and theirs.trained_agent:
        parser.error("--source-model begins a run and -i goes on with one; leave one of them out")
    if ours.source_data is not None and ours.source_model is None:
        parser.error("--source-data spares collecting with --source-model: pass that, too, or leave it out")
    seed = theirs.seed if theirs.seed >= 0 else None  # as the zoo has it
    return Start(source, ours.source_model, ours.source_data, ours.source_timesteps, seed)


@contextmanager
def _replaced(module: object, name: str, value: object) -> Iterator[None]:
    kept = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, kept)


@contextmanager
def command_line(arguments: list[str]) -> Iterator[None]:
    """Inside, the process seems to have been called with these arguments, which rl_zoo3 parses."""
    with _replaced(sys, "argv", [sys.argv[0], *arguments]):
        yield


if __name__ == "__main__":
    sys.exit(main())
