"""Null directions: what is found, who belongs to one, and who is held."""

import numpy as np
import pytest

from sb3_rpto.fitting.identifiability import (
    confounded_parameters,
    null_directions,
    parameters_to_fix,
    sensitive,
)

rng = np.random.default_rng(0)
A, B, C = rng.standard_normal((3, 40))


@pytest.mark.parametrize(
    ("columns", "shown", "together", "held"),
    [
        ([A, B, C], None, [], []),
        ([A, A, C], None, [0, 1], [1]),
        ([A, -0.2 * A, C], None, [0, 1], [1]),
        ([-1e-4 * A, A, C], None, [0], [0]),  # plausible sizes of the weak one hardly change the strong one
        ([A, C, A, A], None, [0, 2, 3], [2, 3]),
        ([A, B, A + B, C, 2 * C], None, [0, 1, 2, 3, 4], [2, 4]),
        ([A, 0 * A, C], None, [], []),  # no direction: nothing is seen of it at all
        ([A, A, C], [True, False, True], [], []),
        ([A, A + 1e-2 * B, C], None, [], []),  # hard to tell apart, but told
        ([A], None, [], []),
    ],
)
def test_directions_are_found(columns, shown, together, held):
    shown = np.ones(len(columns), dtype=bool) if shown is None else np.array(shown)
    slopes = np.stack(columns, axis=1)
    directions = null_directions(slopes.T @ slopes, shown)
    np.testing.assert_allclose(slopes @ directions, 0, atol=1e-6)
    assert np.flatnonzero(confounded_parameters(directions)).tolist() == together
    assert np.flatnonzero(parameters_to_fix(directions)).tolist() == held


def test_who_shares_in_what_is_not_told_does_not_hang_on_the_solver(monkeypatch):
    """Of several directions every rotation is as good: which one comes out is up to rounding."""
    columns = [A, 0.03 * A, B, 30 * B, C]
    slopes = np.stack(columns, axis=1)
    normal, shown, solve = slopes.T @ slopes, np.ones(5, dtype=bool), np.linalg.eigh
    shares = []
    for angle in (0.0, 0.5, 1.0, 1.5):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

        def turned(matrix, turn=turn):
            values, vectors = solve(matrix)
            return values, np.concatenate([vectors[:, :2] @ turn, vectors[:, 2:]], axis=1)

        monkeypatch.setattr(np.linalg, "eigh", turned)
        directions = null_directions(normal, shown)
        np.testing.assert_allclose(directions.T @ directions, np.eye(2), atol=1e-12)
        shares.append((confounded_parameters(directions).tolist(), parameters_to_fix(directions).tolist()))
    assert shares == [shares[0]] * 4
    np.testing.assert_allclose(slopes @ directions, 0, atol=1e-6)


def test_a_parameter_is_sensitive_where_it_moves_the_residuals_by_a_share_of_their_size():
    residuals = np.full(4, 10.0)
    jacobian = np.outer(np.ones(4), [0.0, 0.009, 0.011, 5.0])
    assert sensitive(jacobian, residuals).tolist() == [False, False, True, True]
    assert sensitive(np.outer(np.ones(4), [0.0, 1e-8]), np.zeros(4)).tolist() == [False, True]
