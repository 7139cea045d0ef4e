"""Parameters: the numbers that are fitted, their names, and the transform of each.

The scene's parameters are a pytree of any structure. Its P numbers end to end are one vector; F unknowns move those
that are free through their transforms.

**Numbers of records.** A leaf that is `per_record` has one value for each of R records, end to end among all numbers;
the scene sees one of them. So all numbers are a longer vector, of which every record has P, at its own places, and a
record depends on the unknowns that all share and on its own: its `columns` among the F.
"""

import functools
import re
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._fit.model._law_parameters import find_laws, plain_dicts
from lagjax._fit.model._transforms import AbstractTransform, Smooth, Unbounded
from lagjax._interface import as_arrays, labelled_leaves, require_finite


class _PerRecord:
    """In `free` of `lagjax.fit`: the number, or each number of the array, has a value of its own in every record.

    An offset, a gain, a delay, a clock or a start that differs from recording to recording, while the others are
    shared. The scene's functions see the number of the record that they follow; `fit.params` has the records as first
    axis there, in the order of `records`, those of several systems one after another.

    ```python
    import numpy as np, lagjax

    scene = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 - 0.5 * params["k"] * q**2)
    ts = np.linspace(0.0, 5.0, 101)
    records = [lagjax.Record(ts, a * np.cos(1.5 * ts) + 0.1 * a) for a in (0.5, 1.0)]
    shown = lambda q, qdot, params: q + params["offset"]
    free = {"k": True, "offset": lagjax.per_record}
    fit = lagjax.fit(scene, records, {"k": 2.0, "offset": 0.0}, observe=shown, free=free)
    print(fit.params["offset"])  # [0.05 0.1]
    ```
    """

    def __repr__(self) -> str:
        return "lagjax.per_record"


per_record = _PerRecord()


class Part(NamedTuple):
    """The free numbers of one leaf.

    Their places among all numbers, their transform, and the record of each unknown that moves them, −1 for all records.
    """

    label: str
    places: np.ndarray
    transform: AbstractTransform
    owners: np.ndarray


@dataclass(frozen=True)
class Parameters:
    """The numbers of a pytree of parameters, and those among them that are free.

    - `leaves`, `tree`: the pytree with arrays for numbers; a leaf that is no number is a part of the program.
    - `first`: all numbers at the start of the search; `places` (R, P): where those of every record stand among them.
    - `owners` (R,): the record of the user whose numbers each has.
    - `names` (X,): what the free numbers are called, `params['m']`.
    - `parts`: the leaves among them, each with its transform. All of their u end to end are the F unknowns.
    """

    leaves: list
    tree: Any
    first: np.ndarray
    places: np.ndarray
    owners: np.ndarray
    names: tuple[str, ...]
    parts: tuple[Part, ...]

    @classmethod
    def from_pytree(
        cls, params: PyTree, free: PyTree = None, transforms: PyTree = None, records: int = 1
    ) -> "Parameters":
        """The parameters of the user, of this many records; `free` and `transforms` are prefixes. Raises, and names the
        wrong one."""
        require_finite(params, "params0")
        labels, leaves, tree = labelled_leaves(as_arrays(params, np.float64, "params0"), "params")
        is_free = _broadcast_prefix(True if free is None else free, tree, leaves, "free")
        moved_by = _broadcast_prefix(Unbounded() if transforms is None else transforms, tree, leaves, "transforms")
        learned = {
            f"{one.label}[{name!r}]": own for one in find_laws(params) for name, own in one.law.transforms.items()
        }
        numbers, places, names, parts, count = [np.zeros(0)], [np.zeros((records, 0), int)], [], [], 0
        for label, leaf, may_move, transform in zip(labels, leaves, is_free, moved_by, strict=True):
            if not eqx.is_array_like(leaf):
                continue
            if label in learned:
                transform = _require_own_transform(label, transform, learned[label])
            fitted, values = _fitted_mask(label, leaf, may_move, free), np.asarray(leaf, np.float64).ravel()
            shape, copies = np.shape(leaf), 1
            if may_move is per_record and fitted.any():
                copies = _require_several(label, records)
                shape = copies, *shape
            own = _split_leaf(label, np.shape(leaf), values, transform, fitted, count, copies) if fitted.any() else []
            for place in np.concatenate([np.zeros(0, int), *(part.places for part in own)]):
                index = np.unravel_index(place - count, shape)
                names.append(f"{label}[{', '.join(map(str, index))}]" if shape else label)
            parts += own
            numbers.append(np.tile(values, copies))
            each = count + np.arange(copies * values.size).reshape(copies, -1)
            places.append(np.broadcast_to(each, (records, values.size)))
            count += copies * values.size
        if not names and free is None:
            raise ValueError(
                "No parameter is free: give params0 at least one float for which `free` is True, or free=False to fit "
                "starts and noise alone."
            )
        every = np.concatenate(places, axis=1)
        return cls(leaves, tree, np.concatenate(numbers), every, np.arange(records), tuple(names), tuple(parts))

    def select(self, rows) -> "Parameters":
        """The parameters of M records that have the numbers of the records `rows` (M,) of these."""
        return replace(self, places=self.places[rows], owners=self.owners[rows])

    @functools.cached_property
    def cuts(self) -> list[tuple[slice, slice, Part]]:
        cuts, begin, u_begin = [], 0, 0
        for part in self.parts:
            size = len(part.owners)
            cuts.append((slice(u_begin, u_begin + size), slice(begin, begin + len(part.places)), part))
            begin, u_begin = begin + len(part.places), u_begin + size
        return cuts

    @functools.cached_property
    def free_places(self) -> np.ndarray:
        """The places of the free numbers among all (X,)."""
        return np.concatenate([np.zeros(0, int), *(part.places for part in self.parts)])

    @functools.cached_property
    def _owner_of(self) -> np.ndarray:
        """The record whose numbers each unknown (F,) moves, −1 for those of all records."""
        return np.concatenate([np.zeros(0, int), *(part.owners for part in self.parts)])

    @functools.cached_property
    def unknowns(self) -> "Unknowns":
        """The unknowns that the numbers of each record depend on."""
        shared = np.flatnonzero(self._owner_of < 0)
        if len(shared) == len(self):
            return Unknowns(np.tile(shared, (len(self.owners), 1)), self.owners, 0, len(self))
        own = [np.flatnonzero(self._owner_of == owner) for owner in self.owners]
        room = max(map(len, own), default=0)
        filled = [np.append(some, np.full(room - len(some), len(self))) for some in own]
        rows = [np.append(some, shared) for some in filled]
        return Unknowns(np.array(rows, int).reshape(len(own), -1), self.owners, room, len(self))

    def __len__(self) -> int:
        """F, the number of unknowns."""
        return self.cuts[-1][0].stop if self.parts else 0

    def inverse(self, values: np.ndarray) -> np.ndarray:
        """The unknowns u (F,) whose free numbers are those among all `values` (P,)."""
        return np.concatenate([np.zeros(0), *(part.transform.inverse(values[part.places]) for part in self.parts)])

    def numbers(self, u, xp: Any = np):
        """All numbers (P,) at unknowns u (F,)."""
        if xp is np:
            values = self.first.copy()
            values[self.free_places] = self.values(u)
            return values
        return xp.asarray(self.first, u.dtype).at[self.free_places].set(self.values(u, xp))

    def values(self, u, xp: Any = np):
        """The free numbers (X,) at unknowns u (F,); infinite beyond the range of floats: a trial that fails."""
        with np.errstate(over="ignore", invalid="ignore"):
            return xp.concatenate([u[:0], *[part.transform.value(u[own], xp) for own, _, part in self.cuts]])

    def _slopes(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The derivatives of the free numbers by u that are not zero by construction: rows, columns, and values."""
        rows, columns, values = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
        for own, free, part in self.cuts:
            with np.errstate(over="ignore", invalid="ignore"):
                i, j, slopes = part.transform.slopes(u[own])
            rows.append(free.start + i)
            columns.append(own.start + j)
            values.append(slopes)
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """The derivative of the free numbers by u, (X, F)."""
        matrix, (rows, columns, values) = np.zeros((len(self.names), len(self))), self._slopes(u)
        matrix[rows, columns] = values
        return matrix

    @functools.cached_property
    def _derivative_places(self) -> tuple[np.ndarray, ...]:
        """The places of derivatives in `directions`, (record, column, number), and which of `_slopes` each is; those of
        the first record where all records share their unknowns."""
        rows, columns, _ = self._slopes(self.inverse(self.first))
        found = []
        for record in range(len(self.places) if self.unknowns.own else 1):
            places, own = self.places[record], self.unknowns.columns[record]
            number, column = np.full(len(self.first), -1), np.full(len(self) + 1, -1)
            number[places], column[own] = np.arange(len(places)), np.arange(len(own))
            number, column = number[self.free_places[rows]], column[columns]
            which = np.flatnonzero((number >= 0) & (column >= 0))
            found.append(np.stack([np.full(len(which), record), column[which], number[which], which]))
        return tuple(np.concatenate(found, axis=1))

    def directions(self, u: np.ndarray) -> np.ndarray:
        """The derivatives of the numbers of every record by the unknowns that these depend on, (R, L, P)."""
        found = np.zeros((*self.unknowns.columns.shape, self.places.shape[1]))
        record, column, number, which = self._derivative_places
        found[record if self.unknowns.own else slice(None), column, number] = self._slopes(u)[2][which]
        return found

    def ends(self, u: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends (X,) of intervals of the free numbers at u (F,), of half widths `spread` (X,), inside their sets."""
        x, low, high = self.values(u), np.empty(len(spread)), np.empty(len(spread))
        for _, rows, part in self.cuts:
            low[rows], high[rows] = part.transform.ends(x[rows], spread[rows])
        return low, high

    def covariance(self, u: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """The covariance (X, X) of the free numbers from that of u, (F, F); infinite, with NaN beside it, as there."""
        jacobian, unseen = self.jacobian(u), ~np.isfinite(np.diag(matrix))
        finite = np.where(unseen[:, None] | unseen, 0.0, matrix)
        moved = jacobian @ finite @ jacobian.T
        lost = (jacobian[:, unseen] != 0).any(axis=1)
        moved[lost], moved[:, lost] = np.nan, np.nan
        moved[lost, lost] = np.inf
        return moved

    def log_volume(self, u, xp: Any = np):
        """log of the volume of the free numbers per volume of u, up to a constant."""
        return sum(part.transform.log_volume(u[own], xp) for own, _, part in self.cuts)

    @functools.cached_property
    def prior_weights(self) -> np.ndarray:
        """The weights w (F,) of a prior density exp(−Σ (w u)²/2) of the unknowns: zero but for learned functions."""
        each = (part.transform.prior_weights(rows.stop - rows.start) for _, rows, part in self.cuts)
        return np.concatenate([np.zeros(0), *each])

    def replace_strengths(self, strengths: dict[str, float]) -> "Parameters":
        """A copy with new strengths of the priors of learned functions, by the labels of their leaves."""
        parts = []
        for part in self.parts:
            if isinstance(part.transform, Smooth):
                part = part._replace(transform=replace(part.transform, strength=strengths[part.label]))
            parts.append(part)
        return replace(self, parts=tuple(parts))

    def draw(self, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Random unknowns (F,) to begin a search from; numbers of a single record keep their values."""
        drawn = np.concatenate([u[:0], *(part.transform.draw(u[own], rng) for own, _, part in self.cuts)])
        return np.where(self._owner_of < 0, drawn, u)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the unknowns (F,): as their numbers, or as the whole leaf that they move together."""
        found = []
        for own, rows, part in self.cuts:
            found += self.names[rows] if part.transform.separable else [part.label] * (own.stop - own.start)
        return tuple(found)

    def limits(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) between which one step of the search from u (F,) may lie."""
        return self._join_limits([part.transform.limits(u[own]) for own, _, part in self.cuts])

    def leaps(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) of the steps from u (F,) that end anywhere in the sets of numbers."""
        return self._join_limits([part.transform.leaps(u[own]) for own, _, part in self.cuts])

    def _join_limits(self, pairs: list) -> tuple[np.ndarray, np.ndarray]:
        low, high = (np.concatenate([np.zeros(0), *(pair[k] for pair in pairs)]) for k in range(2))
        return low, high

    def take_step(self, u: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The end of a step (F,) from u (F,): along the tangent of x(u), where every number moves by itself."""
        parts = [part.transform.take_step(u[own], step[own]) for own, _, part in self.cuts]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def maps(self) -> tuple[AbstractTransform, ...]:
        return tuple(part.transform for own, _, part in self.cuts for _ in range(own.stop - own.start))

    @property
    def reach(self) -> np.ndarray:
        """The largest change of each u (F,) in one step."""
        return np.array([transform.reach for transform in self.maps])

    @property
    def room(self) -> np.ndarray:
        """The distance (F,) from one value of each u to the next that counts as different."""
        return np.array([transform.room for transform in self.maps])

    def sizes(self, u: np.ndarray) -> np.ndarray:
        """Changes of u (F,), each of which changes the free numbers by about their own size."""
        x, jacobian = self.values(u), self.jacobian(u)
        size = np.where(x != 0, np.abs(x), 1.0)
        return np.minimum(1.0 / (np.abs(jacobian) / size[:, None]).max(axis=0, initial=1e-300), self.reach)

    def row(self, name: str) -> int:
        """The place among the free numbers of the one of this name, or of the only one whose name ends in it. `dry` is
        `params['joint']['dry']`, `l[1]` is `params['l'][1]`. Raises `ValueError` where none or several are."""
        if name in self.names:
            return self.names.index(name)
        cut = name.rfind("[") if name.endswith("]") else len(name)
        key, index = name[:cut], name[cut:]
        ends = f"[{key!r}]{index}", f".{key}{index}"
        rows = [k for k, own in enumerate(self.names) if own.endswith(ends)]
        if len(rows) != 1:
            several = [self.names[k] for k in rows]
            reason = f"{name!r} may be {', '.join(several)}" if rows else f"No free parameter is called {name!r}"
            raise ValueError(f"{reason}; there are {', '.join(self.names) or 'none: all are kept'}.")
        return rows[0]

    def unknown(self, name: str) -> int:
        """The index of the unknown that moves the free number called `name` (`row`), and no other.

        Raises `ValueError`.
        """
        row = self.row(name)
        name = self.names[row]
        own, rows, part = next(cut for cut in self.cuts if cut[1].start <= row < cut[1].stop)
        if not part.transform.separable:
            raise ValueError(
                f"{name} moves only together with the other numbers of {part.label}, whose transform is "
                f"{part.transform!r}: one of them cannot be kept while the others move."
            )
        return own.start + row - rows.start

    def fix(self, u: np.ndarray, kept: np.ndarray) -> "Parameters":
        """The parameters at u (F,), where the unknowns `kept` (F,) stay: each of them moves a number of its own, or
        stays with all others of its leaf."""
        parts, names = [], []
        for own, rows, part in self.cuts:
            stays = kept[own] if part.transform.separable else np.full(len(part.places), kept[own].all())
            if not stays.all():
                owners = part.owners[~stays] if part.transform.separable else part.owners
                parts.append(part._replace(places=part.places[~stays], owners=owners))
            names += [name for name, kept_too in zip(self.names[rows], stays, strict=True) if not kept_too]
        return replace(self, first=self.numbers(u), parts=tuple(parts), names=tuple(names))

    def zero(self, u: np.ndarray, stays: np.ndarray) -> "Parameters":
        """The parameters at u (F,), where the numbers that the unknowns `stays` (F,) move are zero and stay."""
        fewer = self.fix(u, stays)
        first = fewer.first.copy()
        first[np.setdiff1d(self.free_places, fewer.free_places)] = 0.0
        return replace(fewer, first=first)

    def extend(self, u: np.ndarray, rows: slice) -> tuple["Parameters", np.ndarray]:
        """The parameters of one more record with numbers of its own, and u (F,) where these are in the middle of those
        of the records `rows`."""
        own, moved = self.unknowns.columns[rows, : self.unknowns.own], np.append(u, 0.0)
        moved[own[0]] = moved[own].mean(axis=0)
        return self.select([rows.start]), moved[:-1]

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of the free numbers (X,) without the record: `params['bias']`, or `params['bias'][:, 0]`."""
        found = list(self.names)
        for _, rows, part in self.cuts:
            for k in range(rows.start, rows.stop) if part.owners.max() >= 0 else ():
                found[k] = re.sub(r"\[\d+(?:, )?([\d, ]*)\]$", lambda m: f"[:, {m[1]}]" if m[1] else "", found[k])
        return tuple(found)

    @property
    def example(self) -> np.ndarray:
        """The first numbers (P,) of one record."""
        return self.first[self.places[0]]

    def restore(self, numbers) -> PyTree:
        """The parameters as the scene's functions see them, from the numbers (P,) of one record."""
        leaves, begin = [], 0
        for leaf in self.leaves:
            if eqx.is_array_like(leaf):
                end = begin + np.size(leaf)
                leaf = numbers[begin:end].reshape(np.shape(leaf)).astype(np.asarray(leaf).dtype)
                begin = end
            leaves.append(leaf)
        return jax.tree.unflatten(self.tree, leaves)

    def restore_records(self, numbers) -> PyTree:
        """The parameters from all numbers: with the records as first axis where each has a number of its own."""
        if not (self.places != self.places[0]).any():
            return self.restore(numbers)
        each = [self.restore(numbers[places]) for places in self.places]
        own = iter((self.places != self.places[0]).any(axis=0))

        def combine(leaf, *others):
            if not eqx.is_array_like(leaf):
                return leaf
            differs = any([next(own) for _ in range(np.size(leaf))])
            return (jnp if isinstance(leaf, jax.Array) else np).stack([leaf, *others]) if differs else leaf

        return jax.tree.map(combine, *each)


class Unknowns(NamedTuple):
    """The unknowns, of F in all, that the numbers of each of R records depend on.

    - `columns` (R, L): their places among all; F stands for none.
    - `owners` (R,): whose the first `own` of them are. Those behind are shared by all records.
    """

    columns: np.ndarray
    owners: np.ndarray
    own: int
    count: int

    @property
    def shared(self) -> np.ndarray:
        """The indices (L − own,) of the unknowns that all records share."""
        return self.columns[0, self.own :]

    def select(self, rows) -> "Unknowns":
        return self._replace(columns=self.columns[rows], owners=self.owners[rows])

    def spread(self, local: np.ndarray) -> np.ndarray:
        """Rows (R, ..., L) of columns of records as rows (R, ..., F) of columns of all unknowns."""
        found: np.ndarray = np.zeros((*local.shape[:-1], self.count + 1))
        columns = self.columns.reshape(len(local), *[1] * (local.ndim - 2), -1)
        np.put_along_axis(found, np.broadcast_to(columns, local.shape), local, axis=-1)
        return found[..., :-1]

    def add(self, squares: np.ndarray) -> np.ndarray:
        """The sum (F, F) of matrices (R, L, L) of the columns of records."""
        total = np.zeros((self.count + 1, self.count + 1))
        if self.own:
            np.add.at(total, (self.columns[:, :, None], self.columns[:, None]), squares)
        elif len(squares):
            total[np.ix_(self.shared, self.shared)] = squares.sum(axis=0)
        return total[:-1, :-1]

    def norms(self, lengths: np.ndarray) -> np.ndarray:
        """The lengths (F,) of the columns of all unknowns from those of records (R, L), also where squares are no
        numbers."""
        largest, total = np.zeros(self.count + 1), np.zeros(self.count + 1)
        np.maximum.at(largest, self.columns, lengths)
        unit = np.where(largest > 0, largest, 1.0)
        np.add.at(total, self.columns, (lengths / unit[self.columns]) ** 2)
        return (np.sqrt(total) * unit)[:-1]

    def stack_by_owner(self, rows: np.ndarray) -> np.ndarray:
        """The rows (R, M, C) of records that have the same numbers below each other, (O, M′, C), filled with zeros."""
        return stack_rows(rows, np.unique(self.owners, return_inverse=True)[1])

    @property
    def owner_rows(self) -> "Unknowns":
        """Those of one record of each owner, in the order of `stack_by_owner`."""
        return self.select(np.unique(self.owners, return_index=True)[1])


def stack_rows(rows: np.ndarray, which: np.ndarray) -> np.ndarray:
    """The rows (R, M, C) that belong to the same of O owners, `which` (R,), below each other, (O, M′, C), filled with
    zeros."""
    counts, order = np.bincount(which), np.argsort(which, kind="stable")
    if (counts == 1).all():
        return rows[order]
    found = np.zeros((len(counts), counts.max(), *rows.shape[1:]))
    places = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    found[which[order], places] = rows[order]
    return found.reshape(len(counts), -1, rows.shape[-1])


def _broadcast_prefix(prefix: PyTree, tree, leaves: list, name: str) -> list:
    whole = plain_dicts(jax.tree.unflatten(tree, leaves))
    try:
        spread = jax.tree.broadcast(plain_dicts(prefix), whole, is_leaf=lambda leaf: leaf is None)
        return jax.tree.structure(whole).flatten_up_to(spread)
    except ValueError:
        raise ValueError(
            f"{name} must be one value for all parameters, or name every one of them as params0 does; got {prefix!r}. "
            f"The parameters are {', '.join(labelled_leaves(whole, 'params')[0][:12])}."
        ) from None


def _require_own_transform(label: str, given, own: AbstractTransform) -> AbstractTransform:
    if not (given is None or isinstance(given, Unbounded)):
        raise ValueError(f"{label} has a transform of its own, {own!r}; got {given!r} in transforms: leave it out.")
    return own


def _require_several(label: str, records: int) -> int:
    if records < 2:
        raise ValueError(f"{label} is lagjax.per_record, and there is one record: say True, which is the same.")
    return records


def _fitted_mask(label: str, leaf, may_move, free) -> np.ndarray:
    """True for each number of a leaf (n,) that is fitted. Raises where the user asks to fit one that cannot move."""
    wanted = np.asarray(True if may_move is per_record else may_move)
    if wanted.dtype != bool:
        raise TypeError(f"free must hold True or False, or lagjax.per_record; got {may_move!r} for {label}.")
    if wanted.shape not in ((), np.shape(leaf)):
        raise ValueError(
            f"free must hold True, False, or an array of them of the shape {np.shape(leaf)} for {label}; got one of "
            f"the shape {wanted.shape}."
        )
    if not np.issubdtype(np.asarray(leaf).dtype, np.floating):
        if wanted.any() and not any(free is whole for whole in (None, True, per_record)):
            raise TypeError(f"{label} is free but not a float: write 1.0 instead of 1, or leave it out of `free`.")
        return np.zeros(np.size(leaf), bool)
    return np.broadcast_to(wanted, np.shape(leaf)).ravel()


def _split_leaf(label: str, shape, values: np.ndarray, transform, fitted: np.ndarray, begin: int, copies: int):
    """The parts of a leaf whose values, or as many copies of them, one for each record, begin at a place of all."""
    parts, records = [], np.arange(copies)
    for one, some in _split_by_transform(label, transform, fitted, shape):
        if isinstance(one, AbstractTransform) and not (len(some) == values.size or one.separable):
            raise ValueError(f"{label} is free as a whole or not at all: its transform is {one!r}.")
        one = _specialize_transform(label, one, values[some], shape)
        places = begin + some + values.size * records[:, None]
        if copies == 1:
            parts.append(Part(label, places[0], one, np.full(one.count_unknowns(len(some)), -1)))
        elif one.separable:
            parts.append(Part(label, places.ravel(), one, np.repeat(records, len(some))))
        else:
            each = one.count_unknowns(len(some))
            parts += [Part(f"{label}[{k}]", own, one, np.full(each, k)) for k, own in enumerate(places)]
    return parts


def _split_by_transform(
    label: str, transform, fitted: np.ndarray, shape: tuple[int, ...]
) -> list[tuple[Any, np.ndarray]]:
    """Neighbours among the fitted numbers of a leaf that share a transform, each with their places in it, in order."""
    places = np.flatnonzero(fitted)
    if not isinstance(transform, np.ndarray):
        return [(transform, places)]
    if transform.shape != shape:
        raise ValueError(
            f"transforms must hold one for {label}, or an array of them of its shape {shape}; got one of the shape "
            f"{transform.shape}."
        )
    each = transform.ravel()
    edges = [k for k in range(1, len(places)) if each[places[k]] != each[places[k - 1]]]
    return [(each[some[0]], some) for some in np.split(places, edges)]


def _specialize_transform(label: str, transform, values: np.ndarray, shape: tuple[int, ...]) -> AbstractTransform:
    """The transform of a free leaf. Raises where it is none, or where the values start outside of its set."""
    transform = Unbounded() if transform is None else transform
    if not isinstance(transform, AbstractTransform):
        raise TypeError(
            "transforms must hold lagjax.positive, lagjax.between(a, b), lagjax.angle, lagjax.simplex, lagjax.inertia "
            f"or None; got {transform!r} for {label}."
        )
    if reason := transform.refuses(values):
        raise ValueError(f"{label} {reason}; got {values if values.size > 1 else values[0]}.")
    return transform.specialize(values, shape)
