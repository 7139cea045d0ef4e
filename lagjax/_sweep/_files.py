"""`Files`: a folder that is a zarr group for readers, and the job for workers.

    STORE/zarr.json, <name>/zarr.json, <name>/c/…    arrays, one chunk a unit: plain numbers and their checksum
    STORE/.sweep/spec.json, scene.pkl                the description, with its own hash, and the functions
    STORE/.sweep/copied/UNIT.npz                     members and starts of a unit that another store had
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
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lagjax import designs
from lagjax._show import import_package
from lagjax._sweep._members import Axis, Grid, hash_columns

FORMAT = 5
_CHECKSUM = 4  # bytes of it, at the end of a chunk
_STATISTICS = "/statistics"  # among the hashes of a record; no quantity has a slash in its name
_RECORD_ENTRIES = {"sha256", "members", "results", "failed", "slow", "seconds"}
_ADVICE = (
    "Begin the same sweep, with the same `unit`, in another folder, and copy this one file from there: it is the same. "
    "Then run the sweep again."
)
_READERS, _AHEAD = 8, 1024  # threads that look at files at once, as a disk far away answers late; units given to them
_DEAD = 3600.0  # seconds after which a file aside belongs to a dead worker; a live one writes for seconds
_ABANDONED = 86_400.0  # seconds after which a store that was never made ready is removed; to make one takes minutes
_FULL = (errno.ENOSPC, errno.EDQUOT)
_REFUSED = (errno.EROFS, errno.EACCES, errno.EPERM)


@dataclass(frozen=True)
class Quantity:
    """A kept quantity: its name, shape and dtype for one member."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def dimensions(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{k}" for k in range(len(self.shape)))

    @property
    def filling(self) -> Any:
        """The number that stands for a missing value: NaN; the least signed or greatest unsigned integer; False."""
        kind = self.dtype.kind
        if kind in "fc":
            return self.dtype.type(np.nan)
        if kind == "b":
            return False
        return np.iinfo(self.dtype).min if kind == "i" else np.iinfo(self.dtype).max


RESULT, NOT_DONE = Quantity("result", (), np.dtype("int16")), -1


class Copied(NamedTuple):
    """Of a unit: members (m,) that are not computed, their values by name, and starts of all members by name."""

    members: np.ndarray
    values: dict[str, np.ndarray]
    starts: dict[str, np.ndarray]


@dataclass(frozen=True)
class Files:
    path: Path

    @property
    def job(self) -> Path:
        return self.path / ".sweep"

    # ---- the description ----

    def spec(self) -> dict:
        """The description. Raises `FileNotFoundError` or `ValueError` if there is no readable store."""
        file = self.job / "spec.json"
        if not self.exists() or not file.exists():
            why = "is no store of a sweep, for it has no .sweep/spec.json: name another folder, or empty this one"
            raise FileNotFoundError(errno.ENOENT, f"{self.path} {why}")
        try:
            spec: Any = json.loads(file.read_bytes())
            written, fault = spec.pop("sha256", None), "it is not what was written"
        except (ValueError, AttributeError, TypeError) as why:  # of what is no UTF-8, no JSON, no dict
            spec, written, fault = {"format": FORMAT}, None, str(why)
        if spec.get("format") != FORMAT:
            raise ValueError(
                f"{self.path} is a store of format {spec.get('format')}, written by lagjax "
                f"{spec.get('versions', {}).get('lagjax')}; this lagjax writes format {FORMAT}. xarray can read it as "
                "it is; to continue it, use that version."
            )
        if _file_hash(_read_json(spec)) != written:
            raise ValueError(f"{file} cannot be read ({fault}): the store is damaged. {_ADVICE}")
        names = [name for x in (*spec["axes"], *spec["kept"]) for name in x.get("names", [x.get("name")])]
        if bad := [name for name in names if not is_file_name(name)]:  # a stranger's store stays in its folder
            raise ValueError(f"{file} cannot be read ({bad[0]!r} is no name): the store is damaged. {_ADVICE}")
        return spec

    def require_arrays(self, spec: dict) -> None:
        """Raise `ValueError` if the metadata of an array, or a coordinate, differ from what `create` has written.

        Links are refused, too: what is written to a store stays in it.
        """
        grid, zarr = self.grid(spec), require_zarr()
        sizes = {name: axis["size"] for axis in spec["axes"] for name in axis["names"]}
        wanted: dict = {name: ((n,), (min(n, designs.SLICE),), np.dtype(float)) for name, n in sizes.items()}
        wanted |= {q.name: (grid.shape + q.shape, grid.chunk + q.shape, q.dtype) for q in self.quantities(spec)}
        for name, expected in wanted.items():
            own = self.path / name
            if own.is_symlink() or (own / "c").is_symlink():
                raise ValueError(f"{own} is a link, or its chunks are: a store has none. Move the whole store instead.")
            for folder in (self.path, own):
                try:
                    whole = folder == self.path
                    array: Any = zarr.open_consolidated(str(folder), mode="r")[name] if whole else self.array(name)
                    here = array.shape, array.chunks, array.dtype
                    fault = None if here == expected else f"it tells of {here}, where {expected} was written"
                except Exception as why:  # whatever zarr makes of bytes that it did not write
                    fault = str(why) or type(why).__name__
                if fault:
                    raise ValueError(f"{folder}/zarr.json cannot be read ({fault}): the store is damaged. {_ADVICE}")
        for axis in (axis for axis in spec["axes"] if axis["rule"] == "values"):
            if axis["sha256"] != hash_columns(self.coordinates([axis], (slice(None),))[0].values()):
                raise self._damaged_coordinates(axis)

    def identity(self) -> str:
        """Return a hash of the description and the functions, which differs if the store is created anew."""
        return _file_hash((self.job / "spec.json").read_bytes() + self.scene())

    def scene(self) -> bytes:
        return (self.job / "scene.pkl").read_bytes()

    def grid(self, spec: dict) -> Grid:
        return Grid(tuple(spec["shape"]), tuple(spec["chunk"]))

    def quantities(self, spec: dict) -> list[Quantity]:
        kept = [Quantity(x["name"], tuple(x["shape"]), np.dtype(x["dtype"])) for x in spec["kept"]]
        return [*(q for q in kept if q.name not in spec["reduce"]), RESULT]

    def exists(self) -> bool:
        """True if the path exists and is not an empty folder."""
        with self.explain_errors("no store can be there"):
            return self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir()))

    @contextmanager
    def create_aside(self) -> "Iterator[Files]":
        """Context with a new store in a folder beside this one, which is renamed to its path at the end.

        So a store is complete once it is there. Of several processes that create it at once the first one's stays.
        """
        with self.explain_errors("the store was not made"):
            place = self.path.resolve()
            place.parent.mkdir(parents=True, exist_ok=True)
            begun = f".{place.name}.begun-"
            for folder in place.parent.glob(glob.escape(begun) + "*"):
                if folder.stat().st_mtime < time.time() - _ABANDONED:
                    shutil.rmtree(folder, ignore_errors=True)
            aside = Files(place.parent / f"{begun}{os.getpid()}-{os.urandom(4).hex()}")
            try:
                yield aside
                os.rename(aside.path, place)
            except OSError:
                if not (aside.job / "spec.json").exists() or not self.exists():
                    raise  # else another process was first
            finally:
                shutil.rmtree(aside.path, ignore_errors=True)

    def create(self, spec: dict, scene: bytes, axes: tuple[Axis, ...], title: str, codes: dict[int, str]) -> None:
        zarr = require_zarr()
        for folder in ("done", "aside", "copied"):
            (self.job / folder).mkdir(parents=True)
        group = zarr.create_group(str(self.path), overwrite=False, attributes={"title": title})
        group.attrs["coordinates"] = " ".join(name for axis in axes for name in axis.names)

        def add_array(name, shape, chunk, dtype, filling, dimensions, attributes=None):
            return group.create_array(
                name, shape=shape, chunks=chunk, dtype=dtype, fill_value=filling, dimension_names=dimensions,
                attributes=attributes, compressors=zarr.codecs.Crc32cCodec(), filters=None,
            )  # fmt: skip

        for axis in axes:
            size = (axis.size,), (min(axis.size, designs.SLICE),)
            arrays = [add_array(name, *size, "float64", np.nan, (axis.dimension,)) for name in axis.names]
            for start, values in axis.pieces():
                for column, array in zip(values.T, arrays, strict=True):
                    array[start : start + len(column)] = column
        grid, dimensions = self.grid(spec), tuple(axis.dimension for axis in axes)
        flags = {"flag_values": list(codes), "flag_meanings": " ".join(codes.values())}
        for q in self.quantities(spec):
            filling, attributes = (NOT_DONE, flags) if q == RESULT else (q.filling, None)
            size = grid.shape + q.shape, grid.chunk + q.shape
            add_array(q.name, *size, q.dtype, filling, dimensions + q.dimensions, attributes)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is no part of the format yet; readers then list no folders
            zarr.consolidate_metadata(str(self.path))
        self.write(self.job / "scene.pkl", scene)
        self.write(self.job / "spec.json", _read_json({"sha256": _file_hash(_read_json(spec)), **spec}))

    def coordinates(self, axes: list[dict], box: tuple[slice, ...]) -> list[dict[str, np.ndarray]]:
        """Return the values along each axis of a box of members, by name; raise `ValueError` if they are damaged."""
        sides = []
        for axis, part in zip(axes, box, strict=True):
            try:
                sides.append({name: np.asarray(self.array(name)[part]) for name in axis["names"]})
            except ValueError as why:  # its checksum
                raise self._damaged_coordinates(axis) from why
        return sides

    def _damaged_coordinates(self, axis: dict) -> ValueError:
        names = " or ".join(f"{self.path / name}/c" for name in axis["names"])
        return ValueError(f"{names} has different values from those written: the store is damaged. {_ADVICE}")

    def array(self, name: str):
        return require_zarr().open_array(str(self.path / name), mode="r")

    # ---- units ----

    def finished_units(self) -> set[int]:
        names = (name.split(".") for name in os.listdir(self.job / "done"))
        return {int(first) for first, *rest in names if rest == ["json"] and first.isdecimal()}

    def has_finished(self, unit: int) -> bool:
        return (self.job / "done" / f"{unit}.json").exists()

    def record(self, unit: int) -> dict:
        """Return the record of a finished unit; raise `ValueError` if it is damaged."""
        record = json.loads((self.job / "done" / f"{unit}.json").read_bytes())
        if not isinstance(record, dict) or not _RECORD_ENTRIES <= set(record):
            raise ValueError("it is no record of a unit")
        return record

    def statistics(self, unit: int) -> bytes:
        return (self.job / "done" / f"{unit}.npz").read_bytes()

    def read_copied(self, unit: int) -> Copied:
        file = self.job / "copied" / f"{unit}.npz"
        if not file.exists():
            return Copied(np.zeros(0, int), {}, {})
        with np.load(file) as arrays:
            values, starts = ({name[3:]: arrays[name] for name in arrays if name[:3] == x} for x in ("of ", "at "))
            return Copied(arrays["members"], values, starts)

    def write_copied(self, unit: int, copied: Copied) -> None:
        arrays = {f"of {name}": x for name, x in copied.values.items()}
        arrays |= {f"at {name}": x for name, x in copied.starts.items()}
        self.write(self.job / "copied" / f"{unit}.npz", arrays_as_bytes({"members": copied.members, **arrays}))

    def write_unit(self, spec: dict, unit: int, values: dict[str, np.ndarray], record: dict, statistics: bytes) -> None:
        """Write the chunks of a unit (values (members, …) by name), then its record, which marks it as done."""
        grid, hashes = self.grid(spec), {}
        with self.explain_errors(f"unit {unit} was not written"):
            for q in self.quantities(spec):
                data = _encode_chunk(grid, unit, q, values[q.name])
                hashes[q.name] = _file_hash(data)
                self.write(self.chunk_file(grid, unit, q), data)
            if statistics:
                hashes[_STATISTICS] = _file_hash(statistics)
                self.write(self.job / "done" / f"{unit}.npz", statistics)
            self.write(self.job / "done" / f"{unit}.json", json.dumps(record | {"sha256": hashes}).encode())

    def chunk_file(self, grid: Grid, unit: int, q: Quantity) -> Path:
        """Return the path at which zarr looks for the chunk of a unit."""
        return self.path / q.name / "c" / "/".join(map(str, grid.place(unit) + (0,) * len(q.shape)))

    def mark_undone(self, spec: dict, unit: int) -> None:
        """Mark a unit as not done, also for those who read `result`."""
        with self.explain_errors(f"unit {unit} is damaged, and stays so"):
            (self.job / "done" / f"{unit}.json").unlink(missing_ok=True)
            if unit < self.grid(spec).unit_count:
                self.chunk_file(self.grid(spec), unit, RESULT).unlink(missing_ok=True)

    def find_damage(self, spec: dict, units: Iterable[int], whole: bool = False) -> dict[int, str]:
        """Return {unit: message} of finished units with files missing or of wrong size or, `whole`, of wrong hash."""
        units, damage = sorted(units), {}
        with ThreadPoolExecutor(_READERS) as readers:
            for k in range(0, len(units), _AHEAD):
                these = units[k : k + _AHEAD]
                damage |= dict(zip(these, readers.map(partial(self._describe_damage, spec, whole), these), strict=True))
        return {unit: text for unit, text in damage.items() if text}

    def _describe_damage(self, spec: dict, whole: bool, unit: int) -> str | None:
        grid = self.grid(spec)
        if unit >= grid.unit_count:
            return f"unit {unit}: there are but {grid.unit_count} units"
        try:
            hashes = self.record(unit)["sha256"]
        except (ValueError, OSError):
            return f"unit {unit}: its record cannot be read"
        files: list[tuple[str, str, Path, int | None]] = []
        for q in self.quantities(spec):
            size = _CHECKSUM + q.dtype.itemsize * math.prod(grid.chunk + q.shape)
            files.append((f"chunk of {q.name!r}", q.name, self.chunk_file(grid, unit, q), size))
        if spec["reduce"]:
            files.append(("file of statistics", _STATISTICS, self.job / "done" / f"{unit}.npz", None))
        for what, name, file, size in files:
            there = file.stat().st_size if file.exists() else None
            if there is None or size not in (None, there):
                have = "is not there" if there is None else f"has {there} bytes, where it should have {size}"
                return f"unit {unit}: its {what} {have}"
            if whole and _file_hash(file.read_bytes()) != hashes.get(name):
                return f"unit {unit}: its {what} is not what was written"
        return None

    # ---- files ----

    def write(self, file: Path, data) -> None:
        """Write a file under a temporary name, flush it to the disk, and rename it."""
        aside = self.job / "aside" / f"{os.getpid()}-{os.urandom(4).hex()}-{file.name}"
        try:
            write_through(aside, data)
            file.parent.mkdir(parents=True, exist_ok=True)
            os.replace(aside, file)
        finally:
            with suppress(OSError):  # read-only: there is nothing to remove
                aside.unlink(missing_ok=True)

    def require_writable(self) -> None:
        """Raise `OSError`, with a message, if nothing can be written here; remove files that dead workers left."""
        with self.explain_errors("nothing was computed"):
            probe = self.job / "aside" / f"probe-{os.getpid()}-{os.urandom(4).hex()}"
            self.write(probe, b"")
            now = probe.stat().st_mtime  # by the clock of the disk
            probe.unlink(missing_ok=True)
            for file in (self.job / "aside").iterdir():
                with suppress(FileNotFoundError):  # another one removes it
                    if file.stat().st_mtime < now - _DEAD:
                        file.unlink()

    @contextmanager
    def explain_errors(self, what: str) -> Iterator[None]:
        """Context that raises errors of the disk again with a message; `what` says what was lost."""
        try:
            yield
        except OSError as error:
            if error.errno in _FULL:
                text = "the disk is full. Make room and run the sweep again"
            elif error.errno in _REFUSED:
                text = f"the store is read-only for this process ({os.strerror(error.errno)})"
            elif error.errno == errno.ENAMETOOLONG:
                raise OSError(error.errno, f"{what}: the name of the folder is too long, {self.path}") from error
            else:
                raise
            text = f"{self.path}: {what}: {text}; all units that are done are kept, and nothing is lost"
            raise OSError(error.errno, text) from error


def is_file_name(name: Any) -> bool:
    """True if a name can be that of an array, which is a folder of the store."""
    return isinstance(name, str) and bool(name) and not set(name) & set("/\\\0") and name[0] != "."


def _encode_chunk(grid: Grid, unit: int, q: Quantity, values: np.ndarray) -> bytes:
    """Return a chunk in zarr's format: the values of a box, filling beyond the grid, and the checksum."""
    import google_crc32c  # which zarr's codec takes it from

    whole = np.full(grid.chunk + q.shape, NOT_DONE if q == RESULT else q.filling, q.dtype.newbyteorder("<"))
    shape = grid.box_shape(unit)
    whole[tuple(map(slice, shape))] = np.reshape(values, shape + q.shape)
    data = whole.tobytes()
    return data + google_crc32c.value(data).to_bytes(_CHECKSUM, "little")


def _read_json(spec: dict) -> bytes:
    return json.dumps(spec, indent=1, ensure_ascii=False).encode()


def _file_hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def arrays_as_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def write_through(file: Path, data) -> None:
    with open(file, "wb") as opened:
        opened.write(data)
        opened.flush()
        os.fsync(opened.fileno())


def require_zarr():
    return import_package("sweep()", "zarr", '"zarr>=3"', "codecs")
