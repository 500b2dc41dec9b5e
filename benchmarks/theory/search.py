"""Settings that put a statement to the test: random ones of several kinds, and the worst that a search finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.theory.bounds import Bound, Setting
from benchmarks.theory.mdp import FloatArray, TabularMDP, perturb, random_mdp, random_policy


def random_setting(rng: np.random.Generator, index: int) -> Setting:
    """Draw a setting of one of six kinds, which take turns with ``index``.

    Dense; near-deterministic with sparse rewards; two states at a small discount; tiny perturbations; rewards that are
    never positive; unrelated dynamics and policies.
    """
    kind = index % 6
    n_states, n_actions = (2, 2) if kind == 2 else (int(rng.integers(2, 7)), int(rng.integers(2, 5)))
    gamma = float(rng.uniform(0.02, 0.3) if kind == 2 else rng.choice([0.3, 0.5, 0.9, 0.99]))
    concentration = 0.05 if kind == 1 else 1.0
    source = random_mdp(
        rng,
        n_states,
        n_actions,
        gamma,
        concentration,
        reward_range=(-1.0, 0.0) if kind == 4 else (-1.0, 1.0),
        reward_density=0.2 if kind == 1 else 1.0,
    )
    policy = random_policy(rng, n_states, n_actions, concentration)
    if kind == 5:
        others = [random_mdp(rng, n_states, n_actions, gamma).transition for _ in range(2)]
        old_policy = random_policy(rng, n_states, n_actions)
    else:
        sizes = 10 ** rng.uniform(-3, -2, 3) if kind == 3 else rng.uniform(0, 0.5, 3)
        others = [perturb(rng, source.transition, size) for size in sizes[:2]]
        old_policy = perturb(rng, policy, sizes[2])
    target, old_source = (replace(source, transition=transition) for transition in others)
    return Setting(target, source, old_source, policy, old_policy)


def _mutate(setting: Setting, rng: np.random.Generator) -> Setting:
    """Change one row of one distribution, one reward or the initial distribution."""
    source, target, old_source = setting.source, setting.target, setting.old_source
    transitions = [target.transition.copy(), source.transition.copy(), old_source.transition.copy()]
    policies = [setting.policy.copy(), setting.old_policy.copy()]
    reward, initial = source.reward.copy(), source.initial.copy()
    state, action = int(rng.integers(reward.shape[0])), int(rng.integers(reward.shape[1]))
    share = float(rng.choice([1.0, 0.3, 0.03, 0.003]))

    def towards_vertex(row: FloatArray) -> None:
        row *= 1 - share
        row[rng.integers(len(row))] += share
        row /= row.sum()

    choice = int(rng.integers(7))
    if choice == 0:
        towards_vertex(initial)
    elif choice == 1:
        reward[state, action] = rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], size=len(initial) if share < 1 else ())
    elif choice <= 3:
        rows = [array[state, action] for array in transitions]
        towards_vertex(rows[int(rng.integers(3))])
        if choice == 3:  # most rows should agree, or the worst of them sets delta for nothing
            rows[int(rng.choice([0, 2]))][:] = rows[1]
    elif choice == 4:
        for array in transitions:
            array[state, action] = transitions[1][state, action]
    else:
        towards_vertex(policies[int(rng.integers(2))][state])
        if choice == 6:
            policies[1][state] = policies[0][state]
    mdps = [TabularMDP(transition, reward, initial, setting.gamma) for transition in transitions]
    return Setting(mdps[0], mdps[1], mdps[2], policies[0], policies[1])


def worst_case(statement: Callable[[Setting], Bound], seed: int, steps: int) -> tuple[Bound, Setting]:
    """Climb to a setting with the largest lhs / rhs without gradients, from one random start at each of four discounts.

    :param statement: for example one of :data:`benchmarks.theory.table.STATEMENTS`
    :param seed: makes the search reproducible
    :param steps: evaluations in all
    :return: the worst bound and the setting that attains it
    """

    def score(bound: Bound) -> float:
        return bound.lhs / max(bound.rhs, 1e-4)

    gammas, found = (0.05, 0.3, 0.6, 0.9), []
    for start, gamma in enumerate(gammas):
        rng = np.random.default_rng([seed, start])
        drawn = random_setting(rng, 0)
        mdps = [replace(mdp, gamma=gamma) for mdp in (drawn.target, drawn.source, drawn.old_source)]
        best = Setting(mdps[0], mdps[1], mdps[2], drawn.policy, drawn.old_policy)
        bound = statement(best)
        for _ in range(steps // len(gammas)):
            candidate = _mutate(best, rng)
            value = statement(candidate)
            if score(value) >= score(bound):
                best, bound = candidate, value
        found.append((bound, best))
    return max(found, key=lambda pair: score(pair[0]))
