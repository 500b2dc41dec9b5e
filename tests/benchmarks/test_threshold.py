"""The threshold that complete sets ask for."""

import json

import pytest

from benchmarks.tracing import threshold


@pytest.mark.slow
def test_a_complete_set_needs_a_threshold() -> None:
    row = threshold.needed("pendulum", 1e-3, 1, episodes=6, duration=2.0)
    assert row["candidates"] > 5
    assert 0 <= row["t"] < 10


def test_what_is_measured_is_not_measured_again(tmp_path, monkeypatch, capsys) -> None:
    seen = []

    def needed(system: str, noise: float, seed: int) -> threshold.Row:
        seen.append(seed)
        return {"system": system, "noise": noise, "seed": seed, "t": float(len(seen))}

    monkeypatch.setattr(threshold, "needed", needed)
    assert threshold.main(["--out", str(tmp_path), "--sets", "3"]) == 0
    assert threshold.main(["--out", str(tmp_path), "--sets", "11"]) == 0
    assert seen == list(range(threshold.FIRST, threshold.FIRST + 11))
    found = json.loads((tmp_path / "threshold.json").read_text())
    assert found["quantile"] == pytest.approx(10.5)
    assert {row["noise"] for row in found["sets"]} == set(threshold.NOISES)
    assert len({row["system"] for row in found["sets"]}) == 5
    assert "of 11 complete sets need less than 10.50; 8 need more than 3.5" in capsys.readouterr().out
    with pytest.raises(ValueError, match="sets"):
        threshold.main(["--out", str(tmp_path), "--sets", "0"])
