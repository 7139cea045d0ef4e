"""`Edition`: a user's function with all values that it read at one time; the key of caches of compiled results.

On the next call `Edition.now` checks whether all of these values are unchanged. If not, the function is walked again,
and a different text makes a new edition, for which everything is derived anew. Two functions with the same text, such
as a lambda in a loop, are the same edition.

JAX caches the traces of helpers that a function passes to it, such as the branches of `jax.lax.cond` or functions under
`jax.jit`, by the helper alone. A trace under another context is another entry: see `Edition.traced`.
"""

import collections
import contextlib
import functools
import pickle
import threading
import types
from collections.abc import Callable, Iterator
from operator import is_
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from lagjax._interface.reads._identity import CHANGING, Walk, array_text, index_of
from lagjax._interface.reads._marks import LARGEST_ARRAY, LARGEST_CONTAINER, SIZE, Marks

_MOST_THINGS = 2000  # functions, classes and objects of one walk, some 50 ms; what is beyond is known by its identity
# Part of the key under which JAX keeps traces. JAX wants it to be made before anything is traced: here.
_context = jax.make_user_context(None)
_inside = threading.local()  # whether a function of the user is being traced


class Edition:
    """A user's function with all that it read when this edition was made; equal if both are the same."""

    __slots__ = ("__weakref__", "_hash", "_held", "_watch", "function", "helped", "text", "tracers")

    def __init__(
        self, function: Callable, text: str, held=(), tracers=(), helped=False, watch: "_EditionWatch | None" = None
    ):
        self.function, self._watch = function, watch
        self.text, self._held, self.tracers = text, tuple(held), tuple(tracers)
        self.helped = helped  # by other functions, whose traces JAX may keep
        self._hash = hash(text)

    @classmethod
    def from_function(cls, function: Callable) -> "Edition":
        is_plain = isinstance(function, types.FunctionType)
        return (_watch_of(function) if is_plain else _EditionWatch(function)).edition()

    def trace_edition(self, function: Callable, how: str) -> "Edition":
        """Return the edition of a jaxpr of this function whose tracers became arguments; `how` is part of its key."""
        return Edition(function, f"{how}: {self.text}", self._held)

    def now(self) -> "Edition":
        """Return the current edition of the function: `self` if nothing that it reads has changed."""
        return self if self._watch is None else self._watch.edition()

    def require_present(self) -> None:
        """Raise `ValueError` if a value that the function reads has changed since this edition."""
        now = self.now()
        if now is not self and now != self:
            raise ValueError(
                f"{_change_text(self, now)} Derive the result again with the new value, or set the former one back; "
                "values that change often belong into `params`."
            )

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: Any) -> bool:
        if self is other or not isinstance(other, Edition) or self.text != other.text:
            return self is other
        ours, theirs = (*self._held, *self.tracers), (*other._held, *other.tracers)
        return len(ours) == len(theirs) and all(map(is_, ours, theirs))

    @property
    def __wrapped__(self) -> Callable:
        return self.function  # with which a walk continues

    def __repr__(self) -> str:
        return repr(self.function)

    def __reduce__(self):
        """Pickle the function by name; without an importable name, as a lambda, by value with cloudpickle."""
        try:
            pickle.dumps(self.function)
            return _pickled_edition, (self.function,)
        except (pickle.PicklingError, AttributeError, TypeError) as reason:
            try:
                import cloudpickle
            except ImportError:
                raise pickle.PicklingError(
                    f"{self.function!r} has no name by which another process could find it: define it with def at the "
                    "top of a module, or pip install cloudpickle."
                ) from reason
            return _rebuild_edition, (cloudpickle.dumps(self.function),)

    @contextlib.contextmanager
    def traced(self) -> Iterator[None]:
        """Context in which the function is called; raises `ValueError` if this is not its current edition."""
        # What the function itself changes while it runs (it counts its calls, it remembers results) is found out here,
        # and is not watched any more.
        if getattr(_inside, "is_traced", False):  # what it calls is part of what was read
            yield
            return
        self.require_present()
        _inside.is_traced = True
        try:
            with _context(self) if self.helped else contextlib.nullcontext():
                yield
        finally:
            _inside.is_traced = False
            if self._watch is not None:
                self._watch.drop_own_writes()


def _pickled_edition(function: Callable) -> Edition:
    """Rebuild an edition from a pickle; a function, as cloudpickle would pack a class method with all that it reads."""
    return Edition.from_function(function)


def _rebuild_edition(packed: bytes) -> Edition:
    return Edition.from_function(pickle.loads(packed))


# Places that functions change while they are traced, held under what finds them: counters, lists of calls, memories.
# What is changed by one function, another one may read. Beyond this many the first are forgotten, and found again.
_own: dict[tuple[int, str | None], Any] = {}
_MOST_OWN = 1000


class _EditionWatch:
    """A function, its latest edition, and the places where all values that it read were found."""

    def __init__(self, function: Callable):
        self.function = function
        self._latest: tuple[Marks, Edition] | None = None

    def edition(self) -> Edition:
        latest = self._latest
        if latest is not None and latest[0].hold():
            return latest[1]
        walk, text = self._walk()
        if latest is not None and all(map(_own.__contains__, _changed_places(latest[0], walk))):
            edition = latest[1]
        else:
            edition = Edition(self.function, text, walk.held, walk.tracers, len(walk.things) > 1, self)
        self._latest = walk.marks, edition
        return edition

    def _walk(self) -> "tuple[_LiveWalk, str]":
        wanted: set[str] | None = set()
        while True:  # ends, as names only become more
            walk = _LiveWalk(wanted)
            text, code = walk.text(self.function), walk.code
            names = None if wanted is None or code.reflects else wanted | code.globals | code.attributes
            if names == wanted:
                return walk, text
            wanted = names

    def drop_own_writes(self) -> None:
        """After a call: stop watching places that the function itself has written to."""
        latest = self._latest
        if latest is None or latest[0].hold():
            return
        walk, _ = self._walk()
        _own.update({key: x for key, x in _changed_places(latest[0], walk).items() if walk.is_own(x, key[1])})
        for key in list(_own)[:-_MOST_OWN]:
            _own.pop(key, None)
        self.edition()


def _changed_places(before: Marks, now: "_LiveWalk") -> dict[tuple[int, str | None], Any]:
    """Return the places, by id and key, whose value differs between `before` and `now`."""
    keys = before.keys
    new = {key: place for key, place in now.marks.keys.items() if key not in keys}
    return new | {(id(place), key): place for place, key in before.changed() if key is not SIZE}


# Holds the functions and what they close over; a signature and a walk take as long as a short motion.
_watch_of = functools.lru_cache(maxsize=64)(_EditionWatch)


class _LiveWalk(Walk):
    """A walk in this process: it records where every value is (`Marks`), and skips attributes that no code names."""

    # A mapping of another class is an object: what it gives may be made anew each time.
    containers = (dict, types.MappingProxyType, list, tuple, set, frozenset, collections.deque)
    most_things, largest_container = _MOST_THINGS, LARGEST_CONTAINER

    def __init__(self, wanted: set[str] | None):
        super().__init__(wanted)
        self.marks, self.tracers = Marks(), []

    def is_own(self, place: Any, key: str | None) -> bool:
        """True if code that was visited may itself have changed the value at this place."""
        if key is None or self.wanted is None:
            return place is not None
        return key in self.code.stored or id(place) in self.of_libraries

    def read(self, place: Any, key: Any, value: Any) -> Any:
        if (id(place), key) in _own:
            return CHANGING
        self.marks.mark(place, key, value)
        return value

    def describe_array(self, array: Any) -> str:
        if isinstance(array, Tracer):
            return f"tracer {index_of(self.tracers, array)}: {array.shape} {array.dtype} {array.weak_type}"
        if isinstance(array, np.ndarray):
            if self.read(array, None, array) is CHANGING:
                return CHANGING
            if array.dtype == object and array.size <= LARGEST_CONTAINER:
                return f"{array.shape} {[self.name(x) for x in array.flat]}"
        if array.nbytes > LARGEST_ARRAY:
            return f"{array.dtype}{array.shape} {self.hold(array)}"
        try:
            return array_text(array)
        except Exception:  # an array that is not in this process, or was given away
            return self.hold(array)


def _change_text(old: Edition, now: Edition) -> str:
    name = getattr(old.function, "__name__", type(old.function).__name__)
    pairs = zip(old.text.split("\n"), now.text.split("\n"), strict=False)
    was, is_now = next(((a.strip(), b.strip()) for a, b in pairs if a != b), ("another value", "this one"))
    return f"{name} read {was} when this was derived from it, and reads {is_now} now."
