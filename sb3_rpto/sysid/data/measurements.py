"""Recorded episodes of a machine, read from files and checked before anything is fitted to them."""

import glob
import os
import warnings
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.sysid.data.columns import Columns, joint_of, read_columns
from sb3_rpto.sysid.data.from_transitions import read_minari, read_replay
from sb3_rpto.sysid.data.recording import PARTS, Episode, Noise, Table, check_clocks, read_run, repair, runs_of
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.data.text_tables import read_text, renamed
from sb3_rpto.sysid.findings import Finding, FindingKind, grouped

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Recorded episodes with the names of their columns and all that was found while reading them.

    :param episodes: the recordings
    :param columns: names of the arrays' columns
    :param findings: what a reader of the results must know; nothing is repaired without one
    :param unobserved: names of ``columns.qpos`` that were not measured: not to be compared with a prediction
    :param exact: whether the samples come from a simulator: no measurement noise, exact velocities
    :param simulated: whether the model's own steps in time are to meet them, noise apart
    :param substeps: steps of the simulator that made them in one of the model's own, where they are ``simulated``
    :param idle: whether nothing was commanded before a run began, as after the reset of an environment; else its first
        command is taken to have held
    :param touching: whether contacts come and go in these measured data
    :param noise: of positions and velocities, where it is known; None: it is estimated from the positions, and exact
        samples have none
    """

    episodes: list[Episode]
    columns: Columns
    findings: list[Finding] = field(default_factory=list)
    unobserved: tuple[str, ...] = ()
    exact: bool = False
    simulated: bool = False
    substeps: int = 1
    idle: bool = False
    touching: bool = False
    noise: Noise | None = None

    @property
    def whole_states(self) -> bool:
        """Whether a prediction may begin at a sample itself: exact, or with positions and velocities of known noise."""
        return self.exact or self.noise is not None

    @property
    def step(self) -> float:
        """Median time between two samples, s."""
        return float(np.median(np.concatenate([np.diff(episode.time) for episode in self.episodes])))

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, in the order of the columns."""
        return tuple(dict.fromkeys(map(joint_of, self.columns.qpos)))

    @property
    def actuators(self) -> tuple[str, ...]:
        """Actuator names, in the order of the columns of ``ctrl``."""
        return self.columns.ctrl

    def __repr__(self) -> str:
        """A line instead of the arrays."""
        samples = sum(map(len, self.episodes))
        seconds = sum(float(np.ptp(e.time)) for e in self.episodes)
        names = f"joints {', '.join(self.joints)}; actuators {', '.join(self.actuators) or 'none'}"
        return f"<Measurements: {len(self.episodes)} episodes, {samples} samples, {seconds:.4g} s; {names}>"

    def __str__(self) -> str:
        """That line, and what was found, each kind once."""
        return "\n".join([repr(self), *(f"  {finding}" for finding in grouped(self.findings))])

    @classmethod
    def from_csv(cls, paths: Paths, rename: Mapping[str, str] | None = None) -> "Measurements":
        """Read CSV files, also gzipped (``.csv.gz``); a file without an ``episode`` column is one episode.

        Read are headers behind a ``#`` or ``%`` (``np.savetxt``), rows of SI units below them, semicolons, tabs or
        blanks between columns, decimal commas, marks at the ends of lines, and quoted names.

        :param paths: a path, a glob pattern, or several of them; a header and one row a sample, in SI units
        :param rename: the format's names by those of the files, such as ``{"t": "time", "q1": "qpos.shoulder"}``
        :raises FileNotFoundError: nothing matches
        :raises TypeError: a table in memory, or names that are no mapping
        :raises ValueError: an empty file, a row of another length than the header, a broken gzip file, other text than
            UTF-8, units of others, a name in ``rename`` that a file does not have, or data that break the file format
            (see :meth:`from_tables`)
        """
        return cls.from_tables({path: read_text(path, rename) for path in _expand_paths(paths)})

    @classmethod
    def from_parquet(cls, paths: Paths, rename: Mapping[str, str] | None = None) -> "Measurements":
        """Read Parquet files, as :meth:`from_csv` does.

        :param paths: as there
        :param rename: as there
        :raises FileNotFoundError: nothing matches
        :raises ImportError: pandas is not installed; pandas itself asks for pyarrow
        :raises ValueError: no Parquet file, or data that break the file format (see :meth:`from_tables`)
        """
        try:
            import pandas
        except ImportError as error:
            message = "reading Parquet needs pandas and pyarrow: pip install -e '.[experiments,data]' in the checkout"
            raise ImportError(message) from error
        tables = {}
        for path in _expand_paths(paths):
            try:
                frame = pandas.read_parquet(path)
            except (ValueError, OSError) as error:  # pyarrow's own of broken files are such
                raise ValueError(f"{path}: no whole Parquet file ({error}); write it again") from error
            index = [name for name in frame.index.names if name is not None and name not in frame.columns]
            if index:  # pandas puts what was its index back there
                frame = frame.reset_index(index)
            names = renamed([*frame.columns], rename, path)
            tables[path] = {new: frame[name].to_numpy() for name, new in zip(frame.columns, names)}
        return cls.from_tables(tables)

    @classmethod
    def from_npz(cls, paths: Paths, rename: Mapping[str, str] | None = None) -> "Measurements":
        """Read npz archives with one array of shape (T,) for each column, as :meth:`from_csv` does.

        :param paths: as there
        :param rename: as there
        :raises FileNotFoundError: nothing matches
        :raises ValueError: no whole archive of named arrays, arrays of Python objects, or data that break the file
            format (see :meth:`from_tables`)
        """
        tables = {}
        for path in _expand_paths(paths):
            try:
                with np.load(path, allow_pickle=False) as archive:
                    tables[path] = {name: archive[name] for name in archive.files}
            except (zipfile.BadZipFile, EOFError, AttributeError, TypeError) as error:  # the last two: a single array
                raise ValueError(f"{path}: no whole npz archive of named arrays ({error}); write it again") from error
            except ValueError as error:
                message = f"{path}: no npz archive, or it holds arrays of Python objects; write plain numbers and text"
                raise ValueError(message) from error
            names = renamed([*tables[path]], rename, path)
            tables[path] = dict(zip(names, tables[path].values()))
        return cls.from_tables(tables)

    @classmethod
    def from_tables(cls, tables: Mapping[str, Table]) -> "Measurements":
        """Check tables of columns in memory and cut them into episodes.

        :param tables: for each file name its columns of shape (T,), in a dict or a pandas DataFrame: ``time`` in s,
            ``qpos`` in rad or m, ``qvel`` in rad/s or m/s, ``qfrc`` in N·m or N, ``ctrl`` in the actuators' units,
            ``enabled`` 0 or 1, ``param`` in SI
        :raises TypeError: a table in the place of a dict of them
        :raises ValueError: no tables; unknown, missing or differing columns, or such of unequal shape; what is no
            number, NaN or infinity; time that does not increase, too few rows; a setting or a split that changes within
            an episode, or a split of another name; the message names the place and the remedy
        """
        if not isinstance(tables, Mapping) or any(
            not isinstance(t, Mapping) and not hasattr(t, "columns") for t in tables.values()
        ):
            raise TypeError("tables must be a dict of tables by their names; write {'run': table} for a single one")
        if not tables:
            raise ValueError("no tables; give at least one")
        tables = {str(name): table for name, table in tables.items()}
        stems = [Path(name).stem for name in tables]
        findings: list[Finding] = []
        episodes: list[Episode] = []
        seen: dict[bytes, str] = {}
        first = next(iter(tables))
        columns = read_columns(tables[first], first)
        for (file, table), stem in zip(tables.items(), stems):
            read_columns(table, file)
            differing = sorted(set(table) ^ set(tables[first]))
            if differing:
                raise ValueError(
                    f"{file}: column {differing[0]!r} is not in both this file and {first}; "
                    "all files need the same columns"
                )
            label = stem if stems.count(stem) == 1 else file
            for key, rows in runs_of(file, table).items():
                name = label if key is None else key if len(tables) == 1 else f"{label}:{key}"
                run = read_run(file, name, rows, columns)
                content = b"".join(
                    rows[c].tobytes() for c in sorted(rows) if c.startswith(("qpos", "qvel", "ctrl", "qfrc", "enabled"))
                )
                content += (run.time - run.time[0]).round(9).tobytes()
                if content in seen:
                    message = f"the same samples as episode {seen[content]!r}; only that one is kept"
                    findings.append(Finding.of_run(FindingKind.DUPLICATE, name, "", message))
                    continue
                seen[content] = name
                episodes += repair(run, columns, findings)
        check_clocks(episodes)
        if not episodes:
            raise ValueError(
                f"{first}: no stretch between gaps has {DATA.min_rows} rows; record longer or drop fewer samples"
            )
        return cls(episodes, columns, findings)

    @classmethod
    def from_replay(
        cls,
        buffer: ReplayBuffer,
        env: gym.Env | VecEnv,
        *,
        exact: bool = True,
        noise: float | Sequence[float] | np.ndarray | None = None,
    ) -> "Measurements":
        """Read the transitions of an SB3 replay buffer, of a :class:`~sb3_rpto.DualReplayBuffer` those of the target.

        Observations are mapped back to states (:func:`sb3_rpto.envs.observations.state_map`), actions to the commands
        of the actuators. An episode ends at a done or a time limit, and where no transition begins at the last one's
        next observation, which is its last sample (the command there repeats the one before). Time is counted in
        ``env.unwrapped.dt``. A position that no observation holds (the x of a walker) is integrated from its velocity
        and listed in :attr:`unobserved`; a sample with a speed at the observation's bound is not ``usable``:
        no prediction begins there, though its positions are compared.

        :param buffer: of vector observations, any number of environments, raw (not normalised), actions scaled to
            [-1, 1] as SB3 stores them
        :param env: the environment, with the wrappers that it had; it is neither reset nor stepped
        :param exact: whether the transitions come from a simulator; False for a machine behind the same observations
        :param noise: standard deviation of the white noise of each observation, (d,), or of all alike, in their units;
            the data are not exact then, and it is not estimated: at the rate of control it hardly can be. The
            simulator's own steps in time are to meet them all the same
        :raises ValueError: no buffer of vectors, no MuJoCo model, actions of another shape than the buffer's or the
            actuators', states that cannot be recovered, NaN, no episode of two transitions, a noise that is negative
            or of another length than the observations
        """
        return cls(**read_replay(buffer, env, exact, noise)._asdict())

    @classmethod
    def from_minari(cls, dataset: Any, env: gym.Env | VecEnv | None = None) -> "Measurements":
        """Read a Minari dataset of a MuJoCo environment, as :meth:`from_replay` does; its samples count as exact.

        :param dataset: a ``minari.MinariDataset``, or the id of one that is stored locally
        :param env: the environment of the data; None: the one that the dataset recovers
        :raises FileNotFoundError: no dataset of this id is stored
        :raises ImportError: minari is not installed
        :raises ValueError: as there, or observations and actions that are no arrays
        """
        return cls(**read_minari(dataset, env)._asdict())

    def tables(self) -> dict[str, np.ndarray]:
        """All samples as one table of columns of shape (sum of T,), in the file format and its units, for any writer.

        Repairs are in it: unwrapped angles, estimated velocities, one episode for each stretch between gaps (and one
        run, when read again). A table does not say whether data are exact, what was not observed, known noise, nor
        which samples are not usable; where there is such a thing, a warning says so.

        :raises ValueError: there are no episodes
        """
        lost = [name for name in ("exact", "simulated", "unobserved") if getattr(self, name)]
        lost += ["noise"] if self.noise is not None else []
        lost += [] if all(e.usable.all() for e in self.episodes) else ["usable"]
        if lost:
            message = f"a table does not hold {', '.join(lost)} of these recordings: read again, they count as measured"
            warnings.warn(message, stacklevel=2)

        def join(arrays: Iterable[Any]) -> np.ndarray:
            return np.concatenate(list(arrays))

        lengths = [len(e) for e in self.episodes]
        table = {
            "episode": np.repeat([e.name for e in self.episodes], lengths),
            "time": join(e.time for e in self.episodes),
        }
        c = self.columns
        for prefix, names in (
            ("qpos", c.qpos),
            ("qvel", c.qvel),
            ("ctrl", c.ctrl),
            ("qfrc", c.qfrc),
            ("enabled", c.ctrl),
        ):
            for i, name in enumerate(names):
                values = join(getattr(e, prefix)[:, i] for e in self.episodes)
                table[f"{prefix}.{name}"] = values.astype(float)
        for name in c.params:
            table[f"param.{name}"] = np.repeat([e.params[name] for e in self.episodes], lengths)
        if self.episodes[0].part is not None:
            table["split"] = np.repeat([str(e.part) for e in self.episodes], lengths)
        return table

    def split(
        self, seed: int, fractions: Sequence[float] = (0.6, 0.2, 0.2)
    ) -> tuple["Measurements", "Measurements", "Measurements"]:
        """Part the data into train, select and test by whole runs.

        A ``split`` column is honoured. Without one, runs are drawn by seed, at least one for test where there are two.
        Where fewer than three training runs would remain, those for select are added to them and select is empty,
        which is a finding. Runs differ in length: a draw that sets most samples apart is drawn again.

        :param seed: of the draw; the order of the files does not matter
        :param fractions: of the runs for train, select and test; they sum to one
        :return: three measurements; all carry the findings, select or test may have no episodes
        :raises ValueError: fractions that are negative or do not sum to one, a ``split`` column without train
        """
        if len(fractions) != 3 or min(fractions) < 0 or fractions[0] == 0 or abs(sum(fractions) - 1) > 1e-6:
            raise ValueError(
                f"fractions must be three numbers >= 0 that sum to 1, the first > 0; got {tuple(fractions)}"
            )
        said: list[str] = []
        if self.episodes and self.episodes[0].part is not None:
            part = {e.run: str(e.part) for e in self.episodes}
            for name in PARTS:
                if name not in part.values():
                    if name == "train":
                        raise ValueError("no episode has 'train' in the column 'split'; name at least one")
                    said.append(f"the column 'split' names no {name} episode")
        else:
            runs = sorted({e.run for e in self.episodes})
            n = len(runs)
            n_test = min(max(1, round(fractions[2] * n)), n - 1) if n >= 2 else 0
            n_select = min(round(fractions[1] * n), n - n_test)
            if n_test == 0:
                said.append("there is but one run: no test data, errors cannot be held out")
            if n - n_test - n_select < 3:
                n_select = 0
                said.append(
                    f"{n - n_test} run(s) remain for training: none is set apart to select on, "
                    "use blocks of the training runs"
                )
            lengths = {r: sum(len(e.time) for e in self.episodes if e.run == r) for r in runs}
            order = _draw_order(lengths, n_test + n_select, seed)
            part = {
                r: "test" if i < n_test else "select" if i < n_test + n_select else "train" for i, r in enumerate(order)
            }
        findings = [*self.findings, *(Finding(FindingKind.SPLIT, "all episodes", message) for message in said)]
        train, select, test = ([e for e in self.episodes if part[e.run] == name] for name in PARTS)
        return tuple(replace(self, episodes=e, findings=list(findings)) for e in (train, select, test))  # type: ignore[return-value]


def _draw_order(lengths: dict[str, int], apart: int, seed: int) -> list[str]:
    """Runs in an order drawn by seed, whose first ``apart`` leave the others at least half the samples due to them.

    :param lengths: number of samples of each run
    """
    runs, rng = list(lengths), np.random.default_rng(seed)
    due = sum(lengths.values()) * (1 - apart / len(runs))
    for _ in range(DATA.split_draws):
        order = [runs[i] for i in rng.permutation(len(runs))]
        if sum(lengths[r] for r in order[apart:]) >= due / 2:
            return order
    return sorted(runs, key=lambda r: lengths[r])


def _expand_paths(paths: Paths) -> list[str]:
    if isinstance(paths, Mapping) or hasattr(paths, "columns"):
        raise TypeError("paths must name files; for a table in memory use Measurements.from_tables({'run': table})")
    patterns = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    found: list[str] = []
    for pattern in [os.fspath(p) for p in patterns]:
        matches = [pattern] if os.path.exists(pattern) else sorted(glob.glob(pattern, recursive=True))
        if not matches:
            raise FileNotFoundError(f"no file matches {pattern!r}; check the path or the pattern")
        for folder in (match for match in matches if os.path.isdir(match)):
            raise ValueError(f"{folder!r} is a folder; name its files, such as {os.path.join(folder, '*.csv')!r}")
        found += matches
    return list(dict.fromkeys(found))
