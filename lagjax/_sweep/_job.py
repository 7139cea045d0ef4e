"""`Job`: a store with the functions that belong to it, in a process that is to compute."""

import hashlib
import json
import os
import platform
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import jax
import numpy as np
from llvmlite import binding as llvm

from lagjax._sweep._batch import Batches, Kept, batches_of
from lagjax._sweep._members import Grid
from lagjax._sweep._scene import Motions, difference, texts, unpacked
from lagjax._sweep._store import RESULT, Store


@dataclass(frozen=True)
class Job:
    """A store, its description, and what computes its members."""

    store: Store
    spec: dict
    grid: Grid
    motions: Motions
    batches: Batches

    @classmethod
    def of(cls, store: Store, spec: dict, motions: Motions) -> "Job":
        """The job of a store whose functions are at hand."""
        if spec.get("cpu", cpu()) != cpu():
            warnings.warn(
                f"{store.path} was begun on a CPU of the kind {spec['cpu']}, and goes on here on {cpu()}: members that "
                "are computed here may differ from what that one would give, as by a change of rounding.",
                stacklevel=4,
            )
        batches = batches_of(motions, spec["conserves"])
        batches.quantities = [q for q in store.quantities({**spec, "reduce": {}}) if q != RESULT]
        return cls(store, spec, store.grid(spec), motions, batches)

    def require_engine(self, kept: Kept) -> None:
        """Raise `ValueError` where another engine integrates here than where the store was begun."""
        if kept.engine != self.spec["engine"]:
            raise ValueError(
                f"{self.store.path} was begun with the engine {self.spec['engine']}, here {kept.engine} integrates: "
                "the bits would differ. Choose the same device, by JAX_PLATFORMS=cpu for machine code."
            )


def in_doubles() -> bool:
    """True if JAX computes in double precision here."""
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


@contextmanager
def precision(doubles: bool) -> Iterator[None]:
    """With numbers of the precision that the store was begun with, in this thread and in those of XLA.

    XLA calls callbacks of `keep` from threads of its own, which see the setting of the process alone: that is changed
    for so long, where it is another one. Of several stores in one process the first to come decides on it.
    """
    with _sharing:
        if not _inside:
            _before.append(_of_process())
            _set_of_process(doubles)
        _inside.append(doubles)
    try:
        with jax.enable_x64(doubles):
            yield
    finally:
        with _sharing:
            _inside.remove(doubles)
            if not _inside:
                _set_of_process(_before.pop())


_sharing = threading.Lock()
_inside: list[bool] = []  # the precisions of all who are inside
_before: list[bool] = []  # that of the process before the first one came, while somebody is inside


def _of_process() -> bool:
    """True if this process computes in doubles, whatever this thread has chosen: as a thread sees it that has not."""
    seen: list[bool] = []
    thread = threading.Thread(target=lambda: seen.append(in_doubles()))
    thread.start()
    thread.join()
    return seen[0]


def _set_of_process(doubles: bool) -> None:
    if _of_process() != doubles:
        jax.config.update("jax_enable_x64", doubles)


def goes_on_from(motions: Motions, store: Store) -> str | None:
    """The store of the ends of motions, as a path from this one's folder: both may be moved, or seen, elsewhere."""
    return None if motions.left is None else os.path.relpath(motions.left.path, store.path.parent)


def _left_here(motions: Motions, store: Store, path: str | None) -> Motions:
    """The motions of a store, left where `path` leads from its folder. Raises `FileNotFoundError` if that is gone."""
    if motions.left is None or path is None:
        return motions
    other = Store((store.path.parent / path).resolve())
    other.spec()
    return replace(motions, left=motions.left._replace(path=str(other.path)))


def opened(path: str) -> Job:
    """The job of a store in a process that knows nothing but its path. Raises where it is not what was begun.

    A store that was removed and made anew is another one; each is opened once.
    """
    store = Store(Path(path))
    return _opened(path, hashlib.sha256(json.dumps(store.spec()).encode() + store.scene()).hexdigest())


@lru_cache(maxsize=4)
def _opened(path: str, content: str) -> Job:
    store = Store(Path(path))
    spec = store.spec()
    require_versions(store, spec)
    with precision(bool(spec["x64"])):
        motions = _left_here(unpacked(store.scene(), spec["path"]), store, spec["goes_on_from"])
        names = [name for axis in spec["axes"] for name in axis["names"]]
        if change := difference(spec["scene"], texts(motions, names)):
            raise ValueError(f"{store.path}: the scene is not here what it was when the store was begun.\n{change}")
        return Job.of(store, spec, motions)


@lru_cache(maxsize=1)
def cpu() -> str:
    """The kind of the CPU, on which the last bits depend as well: by the width of its vectors, and what it fuses."""
    return f"{llvm.get_host_cpu_name()} ({platform.machine()})"


def versions() -> dict[str, str]:
    """Of what the bits of a store depend on, and of Python, whose code travels."""
    of_packages = {name: metadata.version(name) for name in ("jax", "jaxlib", "diffrax", "numpy")}
    return {"lagjax": _own_version(), "python": ".".join(platform.python_version_tuple()[:2]), **of_packages}


def _own_version() -> str:
    try:
        return metadata.version("lagjax")
    except metadata.PackageNotFoundError:
        return "unknown"


def require_versions(store: Store, spec: dict) -> None:
    """Raise `ValueError` where this process would compute other bits, or cannot read the functions."""
    here = versions()
    other = [f"{name} {was}, here {here[name]}" for name, was in spec["versions"].items() if here.get(name) != was]
    if other:
        raise ValueError(
            f"{store.path} was begun with {'; '.join(other)}: its numbers would not be of one program. Install that "
            "version to go on, or begin another store. What is there can be read."
        )
