"""`Store`: a folder that is a zarr group for readers, and the job for workers.

    STORE/zarr.json, <name>/zarr.json, <name>/c/…    arrays, one chunk a unit: plain numbers and their checksum
    STORE/.sweep/spec.json, scene.pkl                what is swept
    STORE/.sweep/done/UNIT.json, UNIT.npz            a unit that is finished: counts, hashes, statistics
    STORE/.sweep/aside/                              files that are being written
    .STORE.begun-…                                   a store that is being made, beside the place that it will take

A file appears under its name when all of it is on the disk (written aside, then renamed), and a unit is done when the
last of its files is. To write a unit again changes nothing, so that it does no harm if two workers do.
"""

import errno
import glob
import hashlib
import io
import json
import math
import os
import shutil
import time
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lagjax import designs
from lagjax._sweep._members import Axis, Grid, hash_columns
from lagjax.designs import Design

FORMAT = 4
_CHECKSUM = 4  # bytes of it, at the end of a chunk
_STATISTICS = "/statistics"  # among the hashes of a record; no quantity has a slash in its name
_OF_RECORD = {"sha256", "members", "results", "failed", "slow", "seconds"}
_OF_SPEC = (
    "versions", "x64", "engine", "conserves", "continues", "scene", "path", "ts", "rtol", "atol", "max_steps", "solver",
    "crossings",
)  # fmt: skip
_ADVICE = (
    "Begin the same sweep, with the same `unit`, in another folder, and copy this one file from there: it is the same. "
    "Then run the sweep again."
)
_READERS, _AHEAD = 8, 1024  # threads that look at files at once, as a disk far away answers late; units given to them
JOB = ".sweep"
KNOWN = "known"  # the folder of members that were taken from another store
_LEFT = 3600.0  # seconds after which a file aside belongs to a dead worker; a live one writes for seconds
_ABANDONED = 86_400.0  # seconds after which a store that was never made ready is removed; to make one takes minutes
_FULL = (errno.ENOSPC, errno.EDQUOT)
_REFUSED = (errno.EROFS, errno.EACCES, errno.EPERM)


@dataclass(frozen=True)
class Quantity:
    """A kept quantity: its name, shape and type for one member."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def dimensions(self) -> tuple[str, ...]:
        """The names of the axes of its shape."""
        return tuple(f"{self.name}_{k}" for k in range(len(self.shape)))

    @property
    def filling(self) -> Any:
        """The filling where there is no value: NaN; of whole numbers the least, or greatest, of their type."""
        kind = self.dtype.kind
        if kind in "fc":
            return self.dtype.type(np.nan)
        if kind == "b":
            return False
        return np.iinfo(self.dtype).min if kind == "i" else np.iinfo(self.dtype).max


RESULT, NOT_DONE = Quantity("result", (), np.dtype("int16")), -1


@dataclass(frozen=True)
class Store:
    """The files of one sweep."""

    path: Path

    @property
    def job(self) -> Path:
        """The folder of what is for workers alone."""
        return self.path / JOB

    # ---- the description ----

    def spec(self) -> dict:
        """The description. Raises `FileNotFoundError` or `ValueError` where this is no store that can be read."""
        file = self.job / "spec.json"
        if not file.exists():
            raise FileNotFoundError(
                errno.ENOENT,
                f"{self.path} is no store of a sweep, for it has no {JOB}/spec.json: name another folder, or empty "
                "this one",
            )
        try:
            spec: Any = json.loads(file.read_bytes())
            fault = None if isinstance(spec, dict) else "it is no description"
        except ValueError as why:  # of what is no UTF-8, too
            spec, fault = None, str(why)
        if not fault and spec.get("format") != FORMAT:
            raise ValueError(
                f"{self.path} is a store of format {spec.get('format')}, written by lagjax "
                f"{spec.get('versions', {}).get('lagjax')}; this lagjax writes format {FORMAT}. xarray can read it as "
                "it is; to continue it, use that version."
            )
        if fault := fault or _fault_of(spec):
            raise ValueError(f"{file} cannot be read ({fault}): the store is damaged. {_ADVICE}")
        return spec

    def require_arrays(self, spec: dict) -> None:
        """Raise `ValueError` where what zarr knows of an array, or a coordinate, is not what `create` has written.

        Links are refused, too: what is written to a store stays in it.
        """
        grid, one = self.grid(spec), np.dtype(float)
        axes = {name: axis for axis in spec["axes"] for name in axis["names"]}
        wanted = {name: ((axis["size"],), (min(axis["size"], designs.SLICE),), one) for name, axis in axes.items()}
        wanted |= {q.name: (grid.shape + q.shape, grid.chunk + q.shape, q.dtype) for q in self.quantities(spec)}
        for name, expected in wanted.items():
            own = self.path / name
            if own.is_symlink() or (own / "c").is_symlink():
                raise ValueError(f"{own} is a link, or its chunks are: a store has none. Move the whole store instead.")
            for folder, open_array in (
                (self.path, lambda name=name: require_zarr().open_consolidated(str(self.path), mode="r")[name]),
                (own, partial(self.array, name)),
            ):
                try:
                    array: Any = open_array()
                    found = array.shape, array.chunks, array.dtype
                    fault = None if found == expected else f"it tells of {found}, where {expected} was written"
                except Exception as why:  # whatever zarr makes of bytes that it did not write
                    fault = str(why) or type(why).__name__
                if fault:
                    raise ValueError(f"{folder}/zarr.json cannot be read ({fault}): the store is damaged. {_ADVICE}")
        for axis in spec["axes"]:
            if axis["rule"] != "values":  # designs are drawn again
                continue
            columns = [np.asarray(self.array(name)[:]) for name in axis["names"]]
            if hash_columns(columns) != axis["sha256"]:
                names = " or ".join(f"{self.path / name}/c" for name in axis["names"])
                raise ValueError(f"{names} has other values than were written: the store is damaged. {_ADVICE}")

    def scene(self) -> bytes:
        """The functions of the sweep, as bytes."""
        return (self.job / "scene.pkl").read_bytes()

    def grid(self, spec: dict) -> Grid:
        return Grid(tuple(spec["shape"]), tuple(spec["chunk"]))

    def quantities(self, spec: dict) -> list[Quantity]:
        """The quantities that are stored of each member, `result` last."""
        kept = [Quantity(x["name"], tuple(x["shape"]), np.dtype(x["dtype"])) for x in spec["kept"]]
        return [*(q for q in kept if q.name not in spec["reduce"]), RESULT]

    def exists(self) -> bool:
        """True if there is something by this name; an empty folder is nothing."""
        return self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir()))

    @contextmanager
    def create_aside(self) -> "Iterator[Store]":
        """A store in a folder beside this one's, which takes its place when the `with` statement ends.

        So a store is there when it is whole. Of several processes that make it at once the first one's stays.
        """
        with self.explain_errors("the store was not made"):
            place = self.path.resolve()
            place.parent.mkdir(parents=True, exist_ok=True)
            begun = f".{place.name}.begun-"
            for folder in place.parent.glob(glob.escape(begun) + "*"):
                if folder.stat().st_mtime < time.time() - _ABANDONED:
                    shutil.rmtree(folder, ignore_errors=True)
            aside = Store(place.parent / f"{begun}{os.getpid()}-{os.urandom(4).hex()}")
            try:
                yield aside
                os.rename(aside.path, place)
            except OSError:
                if not (aside.job / "spec.json").exists() or not self.exists():
                    raise  # else another process was first
            finally:
                shutil.rmtree(aside.path, ignore_errors=True)

    def create(self, spec: dict, scene: bytes, axes: tuple[Axis, ...], title: str, codes: dict[int, str]) -> None:
        """Make the store with empty arrays and the coordinates."""
        zarr = require_zarr()
        for folder in ("done", "aside"):
            (self.job / folder).mkdir(parents=True)
        group = zarr.create_group(str(self.path), overwrite=False, attributes={"title": title})
        group.attrs["coordinates"] = " ".join(name for axis in axes for name in axis.names)
        for axis in axes:
            _write_axis(group, axis)
        grid, dimensions = self.grid(spec), tuple(axis.dimension for axis in axes)
        for q in self.quantities(spec):
            about: dict = {}
            if q == RESULT:
                about = {"flag_values": list(codes), "flag_meanings": " ".join(codes.values())}
            group.create_array(
                q.name, shape=grid.shape + q.shape, chunks=grid.chunk + q.shape, dtype=q.dtype,
                compressors=zarr.codecs.Crc32cCodec(), filters=None,
                fill_value=NOT_DONE if q == RESULT else q.filling, dimension_names=dimensions + q.dimensions,
                attributes=about,
            )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is no part of the format yet; readers then list no folders
            zarr.consolidate_metadata(str(self.path))
        self.write(self.job / "scene.pkl", scene, "spec")
        self.write(self.job / "spec.json", json.dumps(spec, indent=1, ensure_ascii=False).encode(), "spec")

    def coordinates(self, axes: list[dict], box: tuple[slice, ...]) -> list[dict[str, np.ndarray]]:
        """The values along each axis of a box of members, by names; those of designs are drawn, and written if new."""
        sides = []
        for axis, part in zip(axes, box, strict=True):
            names = axis["names"]
            if axis["rule"] == "values":
                sides.append({name: np.asarray(self.array(name)[part]) for name in names})
                continue
            first = part.start // designs.SLICE
            pieces = [self._draw(axis, k) for k in range(first, (part.stop - 1) // designs.SLICE + 1)]
            inside = slice(part.start - first * designs.SLICE, part.stop - first * designs.SLICE)
            sides.append(dict(zip(names, np.concatenate(pieces)[inside].T, strict=True)))
        return sides

    def _draw(self, axis: dict, k: int) -> np.ndarray:
        """Piece k of the coordinates of a design (members, names), which is written where no chunk is there."""
        values = Design.from_axis(axis).piece(tuple(axis["names"]), k * designs.SLICE)
        for name, column in zip(axis["names"], values.T, strict=True):
            file, chunk = self.path / name / "c" / str(k), np.full(min(axis["size"], designs.SLICE), np.nan)
            if not file.exists():  # whoever does writes the same
                chunk[: len(column)] = column
                self.write(file, chunk.astype("<f8", copy=False).data, f"{name}-{k}")
        return values

    def array(self, name: str):
        return require_zarr().open_array(str(self.path / name), mode="r")

    # ---- units ----

    def finished_units(self) -> set[int]:
        names = (name.split(".") for name in os.listdir(self.job / "done"))
        return {int(first) for first, *rest in names if rest == ["json"] and first.isdecimal()}

    def has_finished(self, unit: int) -> bool:
        return (self.job / "done" / f"{unit}.json").exists()

    def record(self, unit: int) -> dict:
        """The notes on a finished unit. Raises `ValueError` where they are not what was written."""
        record = json.loads((self.job / "done" / f"{unit}.json").read_bytes())
        if not isinstance(record, dict) or not _OF_RECORD <= set(record):
            raise ValueError("it is no record of a unit")
        return record

    def statistics(self, unit: int) -> bytes:
        """The statistics of a unit, as bytes."""
        return (self.job / "done" / f"{unit}.npz").read_bytes()

    def copied_members(self, unit: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Members of a unit that were taken from another store: which of it, and what is kept of them by name."""
        file = self.job / KNOWN / f"{unit}.npz"
        if not file.exists():
            return np.zeros(0, int), {}
        with np.load(file) as arrays:
            return arrays["which"], {name[3:]: arrays[name] for name in arrays if name.startswith("of ")}

    def write_unit(self, spec: dict, unit: int, values: dict[str, np.ndarray], record: dict, statistics: bytes) -> None:
        """Write the chunks of a unit (values (members, …) by name), and then that it is done."""
        grid, hashes = self.grid(spec), {}
        with self.explain_errors(f"unit {unit} was not written"):
            for q in self.quantities(spec):
                data = _append_checksum(self._chunk(grid, unit, q, values[q.name]))
                hashes[q.name] = hashlib.sha256(data.data).hexdigest()
                self.write(self.chunk_file(grid, unit, q.name, q.shape), data, f"{unit}-{q.name}")
            if statistics:
                hashes[_STATISTICS] = hashlib.sha256(statistics).hexdigest()
                self.write(self.job / "done" / f"{unit}.npz", statistics, f"{unit}-statistics")
            text = json.dumps(record | {"sha256": hashes})
            self.write(self.job / "done" / f"{unit}.json", text.encode(), f"{unit}-done")

    def _chunk(self, grid: Grid, unit: int, q: Quantity, values: np.ndarray) -> np.ndarray:
        """The bytes of a chunk: the values of a box in their place, what lies beyond the grid filled."""
        shape = grid.box_shape(unit)
        values = np.ascontiguousarray(values, q.dtype).reshape(shape + q.shape)
        if shape != grid.chunk:
            whole = np.full(grid.chunk + q.shape, NOT_DONE if q == RESULT else q.filling, q.dtype)
            whole[tuple(map(slice, shape))] = values
            values = whole
        little = values.astype(values.dtype.newbyteorder("<"), copy=False)
        return np.ascontiguousarray(little).reshape(-1).view(np.uint8)

    def chunk_file(self, grid: Grid, unit: int, name: str, inner: tuple[int, ...]) -> Path:
        """The path at which zarr looks for the chunk of a unit."""
        return self.path / name / "c" / "/".join(map(str, grid.place(unit) + (0,) * len(inner)))

    def undo(self, spec: dict, unit: int) -> None:
        """Make a unit one that is still to be done, for those who read `result` too."""
        with self.explain_errors(f"unit {unit} is damaged, and stays so"):
            (self.job / "done" / f"{unit}.json").unlink(missing_ok=True)
            if unit < self.grid(spec).units:
                self.chunk_file(self.grid(spec), unit, RESULT.name, RESULT.shape).unlink(missing_ok=True)

    def find_damage(self, spec: dict, units: Iterable[int], whole: bool = False) -> dict[int, str]:
        """The damage of finished units, in words: files that lack or have another size or, `whole`, hash.

        A unit of four chunks takes 0.3 ms; to read them a tenth of that more, and a second for a gigabyte.
        """
        units, found = sorted(units), {}
        with ThreadPoolExecutor(_READERS) as readers:
            for k in range(0, len(units), _AHEAD):
                some = units[k : k + _AHEAD]
                found |= dict(zip(some, readers.map(partial(self._damage_of, spec, whole), some), strict=True))
        return {unit: text for unit, text in found.items() if text}

    def _damage_of(self, spec: dict, whole: bool, unit: int) -> str | None:
        grid = self.grid(spec)
        if unit >= grid.units:
            return f"unit {unit}: there are but {grid.units} units"
        try:
            hashes = self.record(unit)["sha256"]
        except (ValueError, OSError):
            return f"unit {unit}: its record cannot be read"
        files: list[tuple[str, str, Path, int | None]] = [
            (f"chunk of {q.name!r}", q.name, self.chunk_file(grid, unit, q.name, q.shape), _chunk_bytes(grid, q))
            for q in self.quantities(spec)
        ]
        if spec["reduce"]:
            files.append(("file of statistics", _STATISTICS, self.job / "done" / f"{unit}.npz", None))
        for what, name, file, size in files:
            there = file.stat().st_size if file.exists() else None
            if there is None or size not in (None, there):
                have = "is not there" if there is None else f"has {there} bytes, where it should have {size}"
                return f"unit {unit}: its {what} {have}"
            if whole and hashlib.sha256(file.read_bytes()).hexdigest() != hashes.get(name):
                return f"unit {unit}: its {what} is not what was written"
        return None

    # ---- files ----

    def write(self, file: Path, data, name: str) -> None:
        """Write a file aside, have it on the disk, and rename it."""
        aside = self.job / "aside" / f"{os.getpid()}-{os.urandom(4).hex()}-{name}"
        try:
            write_through(aside, data)
            file.parent.mkdir(parents=True, exist_ok=True)
            os.replace(aside, file)
        finally:
            try:
                aside.unlink(missing_ok=True)
            except OSError:  # read-only: there is nothing to remove
                pass

    def require_writable(self) -> None:
        """Raise `OSError`, with a sentence, where nothing can be written here; remove what dead workers have left."""
        with self.explain_errors("nothing was computed"):
            probe = self.job / "aside" / f"probe-{os.getpid()}-{os.urandom(4).hex()}"
            self.write(probe, b"", "probe")
            now = probe.stat().st_mtime  # by the clock of the disk
            probe.unlink(missing_ok=True)
            for file in (self.job / "aside").iterdir():
                try:
                    if file.stat().st_mtime < now - _LEFT:
                        file.unlink()
                except FileNotFoundError:  # another one removes it
                    pass

    @contextmanager
    def explain_errors(self, what: str) -> Iterator[None]:
        """A context in which an error of the disk is raised again as a sentence; `what` it cost."""
        try:
            yield
        except OSError as error:
            if error.errno in _FULL:
                text = "the disk is full. Make room and run the sweep again"
            elif error.errno in _REFUSED:
                text = f"the store is read-only for this process ({os.strerror(error.errno)})"
            else:
                raise
            raise OSError(
                error.errno,
                f"{self.path}: {what}: {text}; all units that are done are kept, and nothing is lost",
            ) from error


def _chunk_bytes(grid: Grid, q: Quantity) -> int:
    """The size of a chunk, with its checksum."""
    return _CHECKSUM + q.dtype.itemsize * math.prod(grid.chunk + q.shape)


def is_file_name(name: Any) -> bool:
    """True for the name of an array, which is that of a folder of the store."""
    return isinstance(name, str) and bool(name) and not set(name) & set("/\\\0") and name[0] != "."


def _fault_of(spec: dict) -> str | None:
    """A reason, in words, why a description is not what was written; None where it may be."""
    try:
        shape, chunk = spec["shape"], spec["chunk"]
        sizes = [*shape, *chunk, spec["batch"], *(size + 1 for x in spec["kept"] for size in x["shape"])]
        if not all(type(size) is int and size > 0 for size in sizes):
            return f"{sizes} are no sizes"
        fits = shape == [axis["size"] for axis in spec["axes"]]
        if not fits or any(part > size for part, size in zip(chunk, shape, strict=True)):
            return f"shape {shape} and chunk {chunk} do not fit its axes"
        names = [name for x in (*spec["axes"], *spec["kept"]) for name in x.get("names", [x.get("name")])]
        if bad := [name for name in names if not is_file_name(name)]:
            return f"{bad[0]!r} is no name"
        if bad := [x["dtype"] for x in spec["kept"] if np.dtype(x["dtype"]).kind not in "fciub"]:
            return f"{bad[0]!r} is no type of numbers"
        missing = [name for name in _OF_SPEC if name not in spec] + [x for x in spec["reduce"] if x not in names]
        return f"{missing[0]!r} is missing" if missing else None
    except (KeyError, TypeError, ValueError, AttributeError) as why:
        return f"{type(why).__name__}: {why}"


def _append_checksum(data: np.ndarray) -> np.ndarray:
    """The bytes of a chunk as the codec crc32c of zarr writes them: the checksum behind the numbers."""
    import google_crc32c  # which zarr's codec takes it from

    return np.append(data, np.frombuffer(google_crc32c.value(data.tobytes()).to_bytes(_CHECKSUM, "little"), np.uint8))


def arrays_as_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """Arrays by name as one file."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def write_through(file: Path, data) -> None:
    """Write a file and wait until the disk has it."""
    with open(file, "wb") as opened:
        opened.write(data)
        opened.flush()
        os.fsync(opened.fileno())


def _is_drawn_late(rule: str, size: int) -> bool:
    """True if the coordinates of an axis are written by those who compute its members: so that 10⁸ cost no time."""
    return rule != "values" and size > designs.SLICE


def _write_axis(group, axis: Axis) -> None:
    """The values along an axis as coordinates, some at a time."""
    chunk = min(axis.size, designs.SLICE)
    arrays = [
        group.create_array(
            name, shape=(axis.size,), chunks=(chunk,), dtype="float64", compressors=None, filters=None,
            fill_value=np.nan, dimension_names=(axis.dimension,),
        )
        for name in axis.names
    ]  # fmt: skip
    if isinstance(axis.source, Design) and _is_drawn_late(axis.source.kind, axis.size):
        return
    for start, values in axis.pieces():
        for column, array in zip(values.T, arrays, strict=True):
            for begin in range(0, len(column), designs.SLICE):
                array[start + begin : start + begin + designs.SLICE] = column[begin : begin + designs.SLICE]


def require_zarr():
    """The package zarr. Raises `ImportError`, with a sentence, where it is not installed."""
    try:
        import zarr
        import zarr.codecs
    except ImportError:
        raise ImportError('sweep() needs the package zarr, version 3: pip install "zarr>=3".') from None
    return zarr
