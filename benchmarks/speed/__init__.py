"""How fast the package is against SB3 and plain code, measured in one run: ``python -m benchmarks speed``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch as th

from benchmarks.runner import Row, manifest, write_table
from benchmarks.speed import cases
from benchmarks.speed.cases import Case
from benchmarks.speed.memory import MAKERS, peak_memory
from benchmarks.speed.timing import flops, interleaved, products
from sb3_rpto.dynamics.matmul_precision import pays
from sb3_rpto.files import write_json

#: What must hold, of ratios to the plain version and of shares of the floor.
REQUIRED = {
    "SAC update": (2.2, 0.6),
    "ensemble training": (2.0, 0.7),
    "100,000 rollouts": (15.0, None),
    "RPTO.learn()": (2.0, None),
}
ROUNDS = {"quick": 3, "full": 5}


def main(arguments: Sequence[str] | None = None) -> int:
    """Time all cases with each number of threads, one after the other, and write and print the table.

    :param arguments: without the study's name; default: those of the process
    :return: exit code, 0: a missed number is a result
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks speed", description=__doc__)
    parser.add_argument("--out", metavar="PATH", type=Path, default=Path("runs/speed"), help="without a suffix")
    parser.add_argument("--scale", choices=tuple(ROUNDS), default="quick", help="rounds and sizes (default: quick)")
    parser.add_argument("--threads", metavar="N", type=int, nargs="+", default=[1, 2], help="torch threads (1 2)")
    parser.add_argument("--device", default="cpu", help="where networks are computed (default: cpu)")
    asked = parser.parse_args(arguments)
    out, scale, device = asked.out, asked.scale, asked.device
    before, found = th.get_num_threads(), list[Row]()
    command = f"python -m benchmarks speed --scale {scale} --threads {' '.join(map(str, asked.threads))}"
    gpu = th.cuda.get_device_name() if device.startswith("cuda") else "unmeasured"
    made = manifest(f"{command} --device {device}", gpu=gpu, onednn_products_chosen=pays())

    def keep(row: Row) -> None:
        found.append(row)
        write_table(out.with_name(f"{out.name}.csv"), found)

    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out.with_name(f"{out.name}.json"), made)
    try:
        for count in asked.threads:
            th.set_num_threads(count)
            for case in _cases(scale, device):
                keep({"threads": count, **measure(case, ROUNDS[scale], device)})
                print(line(found[-1]), file=sys.stderr, flush=True)
        th.set_num_threads(min(asked.threads))
        for row in growth(scale, device):
            keep(row)
    finally:
        th.set_num_threads(before)
    print(table(found))
    return 0


def _cases(scale: str, device: str) -> list[Case]:
    small = scale == "quick"
    return [
        cases.update(device, 20 if small else 100),
        cases.ensemble_training(device, 16),
        cases.rollouts(device, 10_000 if small else 100_000),
        cases.whole_loop(device, 30 if small else 100, 50 if small else 200),
        cases.columns(50 if small else 400),
        cases.substeps(100 if small else 2_000, 200),
    ]


def measure(case: Case, rounds: int, device: str = "cpu") -> Row:
    """Time a case: milliseconds a unit of each variant, the ratio, and the share of the floor that ours reaches."""
    variants = dict(case.variants)
    if case.floor:
        variants["floor"] = products(case.floor, device)
    times = interleaved(variants, rounds, device)
    ratio, low, high = times.ratio(case.plain, "ours")
    row: Row = {
        "case": case.name,
        "unit": case.unit,
        "milliseconds": {name: round(1e3 * times.median(name) / case.count, 4) for name in variants},
        "against": case.plain,
        "ratio": round(ratio, 3),
        "range": [round(low, 3), round(high, 3)],
    }
    if case.floor:
        share, low, high = times.ratio("floor", "ours")
        row |= {"floor_share": round(share, 3), "floor_range": [round(low, 3), round(high, 3)]}
        row["gflops"] = round(1e-9 * flops(case.floor) / times.median("floor"), 1)
    return row


def growth(scale: str, device: str) -> Iterator[Row]:
    """How update and memory grow with observation, batch, replay, and the ensemble's training with its members."""
    small = scale == "quick"
    rounds, count = (1, 5) if small else (5, 20)
    for what, values in (("observation", (17, 111, 376)), ("batch", (64, 256, 1_024)), ("rows", (10_000, 200_000))):
        for value in values[:2] if small else values:
            found = measure(cases.update(device, count, **{what: value}), rounds, device)
            yield {"what": f"update, {what}", "value": value, **found}
    for members in (3, 7) if small else (3, 7, 15):
        found = measure(cases.ensemble_training(device, 16, members), rounds, device)
        yield {"what": "ensemble, members", "value": members, **found}
    for size in (10_000,) if small else (10_000, 100_000, 400_000):
        megabytes = {whose: round(peak_memory(whose, size, 17)) for whose in MAKERS}
        yield {"what": "peak memory, rows in the buffer", "value": size, "megabytes": megabytes}


def line(row: Row) -> str:
    """One case in words."""
    share = f", {row['floor_share']:.0%} of the floor" if row.get("floor_share") is not None else ""
    low, high = row["range"]
    return f"{row['case']}: {row['ratio']:.2f} [{low:.2f}, {high:.2f}] x {row['against']}{share}"


def table(found: Sequence[Row]) -> str:
    """The figures in Markdown, of rows as :func:`main` writes them."""
    rows, grown = ([row for row in found if bool(row.get("what")) == of_growth] for of_growth in (False, True))
    text = ["| threads | case | plain | ours | ratio [range] | share of the floor | required | met |", "|" + "---|" * 8]
    for row in rows:
        ms, (low, high) = row["milliseconds"], row["range"]
        ratio, least = REQUIRED.get(row["case"], (None, None))
        met = "–"
        if ratio is not None:
            enough = row["ratio"] >= ratio and (least is None or row["floor_share"] >= least)
            met = "yes" if enough else "no"
        share = f"{row['floor_share']:.0%}" if row.get("floor_share") is not None else "–"
        required = "–" if ratio is None else f"{ratio:g}" + (f", {least:.0%}" if least else "")
        text.append(
            f"| {row['threads']} | {row['case']} | {row['against']}: {ms[row['against']]:.3g} {row['unit']} | "
            f"{ms['ours']:.3g} | {row['ratio']:.2f} [{low:.2f}, {high:.2f}] | {share} | {required} | {met} |"
        )
    text += ["", "| growth with | value | plain | ours | ratio |", "|---|---|---|---|---|"]
    for row in grown:
        if row.get("megabytes"):
            plain, ours = (row["megabytes"][whose] for whose in MAKERS)
            text.append(f"| {row['what']} | {row['value']:,} | {plain:,} MB | {ours:,} MB | – |")
        else:
            ms = row["milliseconds"]
            cells = f"{ms[row['against']]:.3g} ms | {ms['ours']:.3g} ms | {row['ratio']:.2f}"
            text.append(f"| {row['what']} | {row['value']:,} | {cells} |")
    return "\n".join(text) + "\n"
