"""The cart-pole's panels: a source policy is whole, or not there."""

from pathlib import Path

import pytest

from benchmarks.transfer import cartpole as panels


def test_a_killed_training_of_a_source_policy_leaves_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(panels.SAC_SETTINGS, "learning_starts", 10**6)
    seen = iter([20.0, 30.0, KeyboardInterrupt, *[10.0] * 20, 600.0, 600.0])

    def evaluated(*_: object) -> float:
        found = next(seen)
        if found is KeyboardInterrupt:
            raise found
        return found

    monkeypatch.setattr(panels, "evaluate", evaluated)
    monkeypatch.setattr(panels.SAC, "learn", lambda self, *_, **__: self)
    with pytest.raises(KeyboardInterrupt):
        panels.source_policy(tmp_path, 0)
    assert Path(panels.source_policy(tmp_path, 0)).name == "source_0.zip"
    assert next(seen, "none") == "none", "it was trained anew, to the end"
    assert panels.source_policy(tmp_path, 0) == str(tmp_path / "source_0.zip")
