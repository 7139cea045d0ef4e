"""The law of impacts on numbers, as machine code runs it, against all patterns that there are, and its conditions."""

import itertools

import numpy as np
import scipy.optimize

from lagjax._native import compile_loops
from lagjax._run.contacts._law import drop_dependent, find_impulses, find_pattern

COUNT = 300


def run(law, *arguments):
    law(*(x.ctypes.data if isinstance(x, np.ndarray) else x for x in arguments))


class Impact:
    """A random impact of k contacts, of which the first r have friction in d directions; its coupling G Gᵀ."""

    def __init__(self, rng, k: int, r: int, d: int, n: int | None = None, most: float = 0.0):
        self.k, self.r, self.d, self.size = k, r, d, k + r * d
        g = rng.normal(size=(self.size, self.size + 2 if n is None else n))
        self.gradients, self.coupling = g, g @ g.T
        self.v = rng.normal(size=g.shape[1])
        self.rates, self.mu, self.rough = g @ self.v, rng.uniform(0.0, most, r), np.arange(r)
        self.touches = (rng.uniform(size=k) < 0.9).astype(float)
        self.restitution = rng.uniform(0.0, 1.0, k)
        if k == 1:  # a single contact is asked for where it hits
            self.touches[:], self.rates[0] = 1.0, -abs(self.rates[0])
        self.targets = -self.restitution * self.rates[:k]

    def find(self):
        """The pattern, (push, sticks, direction), and its impulses, by machine code."""
        pattern = np.zeros(self.k), np.zeros(self.r), np.zeros((self.r, self.d))
        impulses, work = np.zeros(self.size), np.zeros(10000)
        of_pattern, of_impulses = compile_loops(find_pattern, find_impulses)
        scene = self.k, self.r, self.d, self.rough, self.mu, self.coupling, self.rates
        run(of_pattern, *scene, self.touches, self.restitution, *pattern, work)
        run(of_impulses, *scene, *pattern, self.targets, impulses, work)
        return pattern, impulses

    def solve(self, push, moves) -> np.ndarray:
        """The impulses of a pattern in a plane: which contacts push, and which slips stick (0), or go to one side."""
        matrix, right = np.eye(self.size), np.zeros(self.size)
        for i in range(self.k):
            if push[i]:
                matrix[i], right[i] = self.coupling[i], self.targets[i] - self.rates[i]
        for c in range(self.r):
            row = self.k + c
            if push[c] and not moves[c]:
                matrix[row], right[row] = self.coupling[row], -self.rates[row]
            elif push[c]:
                matrix[row, c] = self.mu[c] * moves[c]
        return np.linalg.solve(matrix, right)

    def obeys(self, push, moves, impulses) -> bool:
        """True where impulses in a plane obey the law."""
        behind = self.rates + self.coupling @ impulses
        for i in range(self.k):
            if (impulses[i] < 0) if push[i] else (self.touches[i] and behind[i] < self.targets[i]):
                return False
        return not any(
            (behind[self.k + c] * moves[c] < 0) if moves[c] else abs(impulses[self.k + c]) > self.mu[c] * impulses[c]
            for c in range(self.r)
            if push[c]
        )

    def enumerate(self) -> list[np.ndarray]:
        """The impulses of all patterns in a plane that obey the law."""
        found = []
        for push in itertools.product(*((0, 1) if there else (0,) for there in self.touches)):
            for moves in itertools.product(*((0, 1, -1) if push[c] else (0,) for c in range(self.r))):
                impulses = self.solve(push, moves)
                if self.obeys(push, moves, impulses):
                    found.append(impulses)
        return found


def test_patterns_are_those_of_all_that_obey_the_law():
    """A positive definite coupling, and little friction: there is one solution (Cottle, Pang & Stone, §3.1)."""
    rng = np.random.default_rng(2)
    for case in range(COUNT):
        k = int(rng.integers(1, 5))
        r = 0 if case % 3 == 0 else int(rng.integers(0, min(k, 3) + 1))
        impact = Impact(rng, k, r, 1, most=0.3)
        (only,) = impact.enumerate()
        _, impulses = impact.find()
        np.testing.assert_allclose(impulses, only, rtol=1e-9, atol=1e-9 * abs(only).max())


def test_impulses_in_space_obey_the_law():
    rng = np.random.default_rng(3)
    for _ in range(COUNT):
        k = int(rng.integers(1, 4))
        impact = Impact(rng, k, int(rng.integers(1, k + 1)), 2, most=0.3)
        (push, sticks, _), impulses = impact.find()
        behind, pushed = impact.rates + impact.coupling @ impulses, impulses[: impact.k]
        fastest = abs(impact.rates).max()
        away = behind[: impact.k] - impact.targets
        there = impact.touches > 0
        assert (pushed >= -1e-14 * abs(pushed).max()).all() and (away[there] >= -1e-10 * fastest).all()
        np.testing.assert_allclose(pushed[push == 0], 0.0, atol=1e-14 * abs(pushed).max())
        np.testing.assert_allclose(away[push > 0], 0.0, atol=1e-10 * fastest)
        for c in np.flatnonzero(push[: impact.r]):
            force, slip = impulses[impact.k :].reshape(-1, 2)[c], behind[impact.k :].reshape(-1, 2)[c]
            most = impact.mu[c] * pushed[c]
            if sticks[c]:
                np.testing.assert_allclose(slip, 0.0, atol=1e-10 * fastest)
                assert np.linalg.norm(force) <= most * (1 + 1e-12)
            else:
                np.testing.assert_allclose(np.linalg.norm(force), most, rtol=1e-12)
                np.testing.assert_allclose(force, -most * slip / np.linalg.norm(slip), atol=1e-12 * most)


def test_what_is_redundant_does_not_matter():
    """With more contacts than coordinates velocities behind an impact are still the only ones, by least squares."""
    rng = np.random.default_rng(4)
    for _ in range(COUNT):
        n = int(rng.integers(1, 4))
        impact = Impact(rng, n + int(rng.integers(1, 3)), 0, 1, n=n)
        impact.touches[:], impact.restitution[:] = 1.0, rng.uniform()
        impact.targets = -impact.restitution * impact.rates
        _, impulses = impact.find()
        best, _ = scipy.optimize.nnls(impact.gradients.T, -(1 + impact.restitution[0]) * impact.v)
        np.testing.assert_allclose(impact.gradients.T @ impulses, impact.gradients.T @ best, atol=1e-9)


def test_rows_that_depend_on_those_before_them_are_let_go():
    rng = np.random.default_rng(5)
    (drop,) = compile_loops(drop_dependent)
    for _ in range(COUNT):
        rows = rng.integers(-2, 3, (int(rng.integers(1, 7)), int(rng.integers(1, 5)))).astype(float)
        asked = rng.uniform(size=len(rows)) < 0.8
        held, kept = asked.astype(float), []
        run(drop, rows @ rows.T, held, len(rows), np.zeros(len(rows) ** 2))
        for i in np.flatnonzero(asked):
            if np.linalg.matrix_rank(rows[[*kept, i]]) > len(kept):
                kept.append(i)
        np.testing.assert_array_equal(np.flatnonzero(held), kept)
