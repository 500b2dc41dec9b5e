"""``python -m benchmarks``: studies by their names, and the options of each."""

from __future__ import annotations

import importlib.util
import sys

import pytest

from benchmarks import __main__ as benchmarks


def test_options_of_a_study_are_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    module = type(sys)("fake_study")
    module.main = lambda options: len(options)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fake_study", module)
    monkeypatch.setitem(benchmarks.STUDIES, "tracing", {"": "fake_study", "part": "fake_study"})
    assert benchmarks.main(["tracing", "--help", "-x", "1"]) == 3
    assert benchmarks.main(["tracing", "part", "-x", "1"]) == 2


def test_every_part_of_every_study_is_there() -> None:
    for parts in benchmarks.STUDIES.values():
        assert all(importlib.util.find_spec(module.partition(":")[0]) for module in parts.values())


def test_an_unknown_study_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmarks.main(["nothing"]) == 2
    assert "closed_loop" in capsys.readouterr().err
    assert benchmarks.main(["--help"]) == 0
