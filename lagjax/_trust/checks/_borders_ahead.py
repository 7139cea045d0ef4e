"""Borders and narrow features ahead of a motion that show nowhere near its state: one number decides on each.

A force that is switched on at t = 5, or a barrier at q = 3, is found from the program before anything runs. A switching
number u that reads one coordinate, one velocity or the time alone is followed by Newton's method from many places along
it, and so is the largest value of what an exponential is taken of. Exact where u is linear, or quadratic; u may
be periodic: the nearest ones are named. The rest are left to the search nearby (`_jumps_nearby`).
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from lagjax._equations import Sample
from lagjax._interface import join_names
from lagjax._program import BELOW, Borders, Unlowerable, eliminate_dead_code
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._jumps_nearby import OF_FORCE
from lagjax._trust.checks._scene_at_start import CheckedScene

_PLACES = np.concatenate([s * np.geomspace(1e-3, 1e3, 61) for s in (-1, 1)])  # to start from, in sizes of the number
_NEWTON = 30  # iterations: a linear number takes two, and what has not come to rest by then is left out
_AT_REST = 1e-9
_UNSEEN = -30.0  # an exponential below this is rounding beside a force of order one
_NAMED = 4  # of many, as of a periodic force, the nearest


class _VariedInput(NamedTuple):
    """The motion's state with input number `i` varied alone, and what the accelerations decide on there."""

    scene: CheckedScene
    borders: Borders
    i: int

    @property
    def start(self) -> float:
        return float(self.scene.point[self.i])

    def function(self, node: int) -> Callable[[np.ndarray], np.ndarray]:
        """A node of the program with pieces, (S,), where the input is (S,): on the pieces that belong there."""
        borders, line = self.borders, self.borders.program.line
        first, count = borders.program.size - len(borders.switches), len(borders.switches)
        read = sorted(k - first for k in borders.read_by(node) if k >= first)
        value = eliminate_dead_code(line, [node])
        decide = eliminate_dead_code(borders.decide, [borders.decide.outputs[j] for j in read])

        def evaluate_node(x):
            columns, pieces = self._sample(x).columns, np.zeros((count, len(x)))
            if read:
                pieces[read] = np.nan_to_num(decide.evaluate([*columns, *np.zeros(2 * count)]))
            return value.evaluate([*columns, *pieces])[0]

        return evaluate_node

    def accelerations(self, x: np.ndarray) -> np.ndarray:
        return self._sample(x).acceleration().T

    def _sample(self, x: np.ndarray) -> Sample:
        points = np.tile(self.scene.point, (len(x), 1))
        points[:, self.i] = x
        return self.scene.sample_at(points)


def findings(scene: CheckedScene) -> list[Finding]:
    """Advice about what jumps, and about what is narrow, at a known value of one number."""
    try:
        borders = scene.derivation.borders
    except Unlowerable:
        return []
    if borders is None:
        return []
    names, places = (*scene.names[:-1], "t"), {}
    exponentials = [
        node for node, feature in zip(borders.arguments, borders.features, strict=True) if feature.kind == BELOW
    ]
    for nodes, report in ((borders.switches, _jumps), (exponentials, _bumps)):
        of_input: dict[int, list[int]] = {}
        for node in nodes:
            if len(read := _moving(borders, node, len(names))) == 1:
                of_input.setdefault(min(read), []).append(node)
        for i in sorted(of_input):
            along = _VariedInput(scene, borders, i)
            for what, where in report(along, [along.function(node) for node in of_input[i]], names[i]):
                places.setdefault((what, where), []).append(names[i])
    return [_finding(what, where, tuple(of)) for (what, where), of in places.items()]


def _moving(borders: Borders, node: int, moving: int) -> set[int]:
    """The inputs, of the first `moving` ones, that a node reads by itself and through the pieces it depends on."""
    first, read, seen, waiting = borders.program.size - len(borders.switches), set(), set(), [node]
    while waiting:
        inputs = borders.read_by(waiting.pop())
        read |= {k for k in inputs if k < moving}
        pieces = {k - first for k in inputs if k >= first} - seen
        seen |= pieces
        waiting += [borders.switches[j] for j in pieces]
    return read


def _jumps(along: _VariedInput, switches: list[Callable], name: str) -> Iterator[tuple[str, str]]:
    """A kind of finding, and the places where an acceleration jumps along the number."""
    places = np.sort(np.concatenate([_zeros(switch, along.start) for switch in switches]))
    places = places[np.diff(places, prepend=-np.inf) > 1e-8 * (1 + np.abs(places))]  # once each, to rounding
    beside = 1e-7 * (1 + np.abs(places))
    before, after, more = (along.accelerations(places + k * beside) for k in (-1, 1, 3))
    size = np.abs([before, after, more]).max(axis=(0, 1))
    with np.errstate(invalid="ignore"):
        jumps = np.abs(after - before).max(axis=0) > 1e-3 * size + 10 * np.abs(more - after).max(axis=0)
    if nearest := _nearest(places[jumps], along.start, name):
        yield "border", nearest


def _bumps(along: _VariedInput, exponents: list[Callable], name: str) -> Iterator[tuple[str, str]]:
    """A kind of finding, and where an exponential that cannot be seen from the state has its peak, and how wide."""
    for exponent in exponents:
        tops, bends = _tops(exponent, along.start)
        seen = (exponent(tops) > _UNSEEN) & (bends < 0)
        if exponent(np.array([along.start]))[0] < _UNSEEN and seen.any():
            width = np.sqrt(8 * np.log(2) / np.max(-bends[seen]))
            if nearest := _nearest(tops[seen], along.start, name):
                yield "narrow_feature", f"{nearest}, {width:.2g} wide"


def _nearest(places: np.ndarray, start: float, name: str) -> str:
    ahead = places[places >= start] if name == "t" else places
    nearest = np.sort(ahead[np.argsort(np.abs(ahead - start))][:_NAMED]) + 0.0
    return ", ".join(f"{x:.6g}" for x in nearest) + (" and more" if len(ahead) > _NAMED else "")


def _finding(kind: str, places: str, names: tuple[str, ...]) -> Finding:
    where = f"{join_names(names)} = {places}"
    message = {
        "border": f"The accelerations jump at {where}. {OF_FORCE}",
        "narrow_feature": (
            f"An exponential of one number alone, zero to rounding at this state, has its peak at {where}. Machine "
            "code looks out for it; with a solver of diffrax bound the steps."
        ),
    }[kind]
    return Finding(kind, "advice", names, message)


# ---- functions of one number -----------------------------------------------------------------------------------------


def _zeros(function: Callable, start: float) -> np.ndarray:
    """Zeros of a function of (S,)."""

    def newton_step(x):
        step = 1e-6 * (1 + np.abs(x))
        low, middle, high = (function(x + k * step) for k in (-1, 0, 1))
        return middle * 2 * step / (high - low)

    return _iterate_to_rest(newton_step, start, _AT_REST)


def _tops(function: Callable, start: float) -> tuple[np.ndarray, np.ndarray]:
    """The stationary points of a function of (S,), by parabolas through three places; its second derivatives there."""
    step = 1e-2

    def parabola(x):
        low, middle, high = (function(x + k * step) for k in (-1, 0, 1))
        return (high - low) / (2 * step), (high - 2 * middle + low) / step**2

    places = _iterate_to_rest(lambda x: np.divide(*parabola(x)), start, 1e-6)
    places = np.unique(np.round(places, 6))
    return places, parabola(places)[1]


@np.errstate(all="ignore")
def _iterate_to_rest(newton_step: Callable, start: float, rest: float) -> np.ndarray:
    """The places where Newton's method, from many of them, moves by no more than `rest` of their size."""
    x, rests = start + _PLACES * max(1.0, abs(start)), np.zeros(len(_PLACES), bool)
    for _ in range(_NEWTON):
        if rests.all():
            break
        step = newton_step(x)
        x = x - np.where(np.isfinite(step), step, 0.0)
        rests = np.abs(step) <= rest * (1 + np.abs(x))
    return x[rests]
