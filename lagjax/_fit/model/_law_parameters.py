"""Laws: functions of a scene whose numbers a fit does not only move, but chooses, or smooths.

A law is a function of the user's scene, and `params0` its numbers as a branch of the scene's parameters: a dict that
knows its law. So a fit reads off the parameters what it has to do with them, wherever they stand, and the scene's
functions see a dict of numbers. `Terms` is a sum of candidate terms, of which a fit keeps those that evidence asks for.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
from jaxtyping import PyTree

from lagjax._fit.model._transforms import AbstractTransform

_BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


class AbstractLaw:
    """A function of a scene, known by its identity, whose numbers are a branch of the scene's parameters."""

    selects = False  # whether a fit chooses which of the numbers are not zero
    transforms: Mapping[str, AbstractTransform] = {}  # of its numbers, by name, that a fit smooths

    @property
    def params0(self) -> "LawParameters":
        raise NotImplementedError


class LawParameters(dict):
    """The numbers of a law by name: a dict, in all that JAX does to pytrees, that knows its law.

    It stays one under `|`, `copy` and everything of `jax.tree`; `dict(params)` is a plain dict, whose numbers a fit
    moves like all others.
    """

    def __init__(self, law: AbstractLaw, numbers: Mapping[str, Any]):
        super().__init__(numbers)
        self.law = law

    def __or__(self, other):
        # A number of a term that is written without a point is a float, which a fit moves, as the others are.
        whole = {name: float(number) if type(number) is int else number for name, number in other.items()}
        return LawParameters(self.law, {**self, **whole})

    def copy(self) -> "LawParameters":
        return LawParameters(self.law, self)


def _flatten_with_keys(params: LawParameters):
    names = sorted(params)
    return [(jax.tree_util.DictKey(name), params[name]) for name in names], (params.law, tuple(names))


def _flatten(params: LawParameters):
    names = sorted(params)
    return [params[name] for name in names], (params.law, tuple(names))


def _unflatten(law_and_names, numbers) -> LawParameters:
    law, names = law_and_names
    return LawParameters(law, dict(zip(names, numbers, strict=True)))


jax.tree_util.register_pytree_with_keys(LawParameters, _flatten_with_keys, _unflatten, _flatten)


class FoundLaw(NamedTuple):
    """A law in a pytree of parameters: what its branch is called, `params['friction']`, and its numbers."""

    label: str
    params: LawParameters

    @property
    def law(self) -> AbstractLaw:
        return self.params.law


def find_laws(params: PyTree) -> list[FoundLaw]:
    """The laws in a pytree of parameters, in the order of its leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(params, is_leaf=_is_law)
    return [FoundLaw("params" + jax.tree_util.keystr(path), leaf) for path, leaf in leaves if _is_law(leaf)]


def plain_dicts(params: PyTree) -> PyTree:
    """A copy of a pytree with plain dicts for the parameters of laws, its leaves in the same order."""

    def replace_law(branch):
        return {name: plain_dicts(value) for name, value in branch.items()} if _is_law(branch) else branch

    return jax.tree.map(replace_law, params, is_leaf=lambda leaf: _is_law(leaf) or leaf is None)


def _is_law(leaf) -> bool:
    return isinstance(leaf, LawParameters)


@dataclass(frozen=True, eq=False)
class Terms(AbstractLaw):
    """A sum of candidate terms; what `terms` returns. `asked` are the names that each term asks for, None for any."""

    terms: dict[str, Callable]
    asked: dict[str, frozenset[str] | None]

    selects = True

    @functools.cached_property
    def params0(self) -> LawParameters:
        """The start of a fit: no term, zero for each."""
        return LawParameters(self, dict.fromkeys(self.terms, 0.0))

    def __repr__(self) -> str:
        return f"lagjax.terms of {', '.join(map(repr, self.terms))}"

    def __call__(self, *roles, params: Mapping[str, Any], **extras):
        """Σ params[name] · term(*roles), and of the extras what each term asks for by name."""
        if not isinstance(params, Mapping) or params.keys() != self.terms.keys():
            got = f"numbers for {', '.join(map(repr, params))}" if isinstance(params, Mapping) else repr(params)
            raise TypeError(
                f"params of {self!r} must have a number for each term, and no other; got {got}. Call the law with the "
                'branch of the parameters that begins as law.params0: law(q, params=params["law"]).'
            )
        if unasked := [key for key in extras if not any(self._asks(name, key) for name in self.terms)]:
            raise TypeError(f"No term of {self!r} asks for {unasked[0]!r}.")
        total = None
        for name, term in self.terms.items():
            own = {key: value for key, value in extras.items() if self._asks(name, key)}
            part = jax.tree.map(lambda x, weight=params[name]: weight * x, term(*roles, **own))
            total = part if total is None else jax.tree.map(lambda a, b: a + b, total, part)
        return total

    def _asks(self, name: str, key: str) -> bool:
        asked = self.asked[name]
        return asked is None or key in asked


def terms(candidates: Mapping[str, Callable]) -> Terms:
    r"""A law as a sum of candidate terms, Σ params[name] · term(…), of which `fit` keeps those that evidence asks for.

    Call the law where the scene needs it, in the potential, the kinetic energy, forces or dissipation, with whatever
    its terms take, and with its own branch of the parameters: `law(q, params=params["law"])`. Every term is called
    with the same arguments by position, and with those by keyword that it asks for by name: `law(qdot, t=t,
    params=…)`. A number inside of a term, such as the velocity of Stribeck's rise, is one of these arguments:
    `law(qdot, params["slow"], params=…)`. A term returns a number, an array, or a pytree of them, as its neighbours do.

    `law.params0` is where a fit begins, zero for each term; `law.params0 | {"q4": 1.0}` begins elsewhere.

    A fit of parameters that hold it chooses by the motion: it is fitted with all terms, then without the one that it
    misses least, and so forth; `Fit.selection` is the list of these fits. Where what is left is noise, that of the
    smallest BIC is taken, with the effective number of samples. Where the scene lacks something, and there are three
    records, it is the smallest that follows records left out as well as the best does, within one standard error. In
    `fit.params` the other terms are exactly 0. Terms that the data cannot tell apart are named in `fit.message`.

    **Raises** `TypeError` for what is no dict of functions, or where a term asks for `params`.

    Source: Brunton, Proctor & Kutz, PNAS 113 (2016) 3932, for sums of candidates, there on derivatives of the data;
    Schwarz, Ann. Stat. 6 (1978) 461, for BIC; Hastie, Tibshirani & Friedman, *The Elements of Statistical Learning*
    (2009), §7.10, for one standard error.

    ```python
    import numpy as np, lagjax

    law = lagjax.terms({"q2": lambda q: q**2 / 2, "q3": lambda q: q**3 / 3, "q4": lambda q: q**4 / 4})
    scene = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 - law(q, params=params))
    ts = np.linspace(0.0, 10.0, 201)
    true = law.params0 | {"q2": 1.0, "q4": 0.5}
    motion = np.asarray(lagjax.simulate(scene, 1.0, 0.0, ts, true).q)
    record = lagjax.Record(ts, motion + 1e-3 * np.random.default_rng(0).normal(size=ts.size))
    fit = lagjax.fit(scene, record, law.params0)
    print(fit.params["q3"], fit)
    ```
    """
    if not (isinstance(candidates, Mapping) and candidates and all(isinstance(name, str) for name in candidates)):
        raise TypeError(f"terms takes a dict of functions by name, at least one; got {candidates!r}.")
    asked: dict[str, frozenset[str] | None] = {}
    for name, term in candidates.items():
        if not callable(term):
            raise TypeError(f"The term {name!r} must be a function, such as lambda q: q**4 / 4; got {term!r}.")
        asked[name] = _read_names(term)
        if "params" in (asked[name] or ()):
            raise TypeError(
                f"The term {name!r} asks for `params`, which are the numbers of the law. Give it what it needs by "
                'another name: law(q, slow=params["slow"], params=params["law"]).'
            )
    return Terms(dict(candidates), asked)


def _read_names(term: Callable) -> frozenset[str] | None:
    """The names by which a function takes arguments; None where it takes any."""
    try:
        found = inspect.signature(term).parameters.values()
    except (TypeError, ValueError):  # some built-in functions have no signature, and take arguments by position
        return frozenset()
    if any(one.kind is inspect.Parameter.VAR_KEYWORD for one in found):
        return None
    return frozenset(one.name for one in found if one.kind in _BY_NAME)
