"""Machine code kept on disk: the same code, made once for all processes, whatever happens to the files."""

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import lagjax
from lagjax import _native
from lagjax._engine import Problem
from lagjax._engine.taylor import flow_of
from lagjax._interface import Layout
from lagjax._native.code import _ir, _objects

SCENE = lagjax.scenes.spherical_pendulum()
TS = np.linspace(0.0, 1.0, 5)


def run() -> np.ndarray:
    """The path of a motion by a kernel of its own."""
    problem = Problem.from_arguments(
        SCENE.system, Layout.from_state(SCENE.q0, SCENE.qdot0), SCENE.q0, SCENE.qdot0, TS, SCENE.params
    )
    flow = flow_of(problem)
    kernel = _native.Kernel(flow.program, flow.size, flow.projection, flow.guards, flow.groups, flow.nesting)
    return kernel(TS[None], np.asarray(problem.y0)[None], np.asarray(problem.vector)[None], 1e-9, 1e-12, 1000).path


@pytest.fixture
def made(monkeypatch):
    """The texts that LLVM is asked to make objects of."""
    texts, make = [], _ir._compile_object
    monkeypatch.setattr(_ir, "_compile_object", lambda text, level: texts.append(text) or make(text, level))
    return texts


@pytest.fixture
def cache(monkeypatch, tmp_path):
    _native.handler()  # the one of this process is there before
    monkeypatch.setenv("LAGJAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.slow
def test_another_process_finds_what_one_has_made(cache, made, monkeypatch):
    code = "import jax; jax.config.update('jax_enable_x64', True); import test_objects as t; t.run()"
    hashes = {"PYTHONHASHSEED": "12345"}  # in whose order sets of names are gone through
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=os.path.dirname(__file__), env=os.environ | hashes,
        timeout=200, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    files = set(cache.iterdir())
    assert len(files) == 2  # the kernel, and the handler of that process
    monkeypatch.setattr(_ir, "LEVELS", [2, 1])  # as there
    found = run()
    assert not made and set(cache.iterdir()) == files
    monkeypatch.setenv("LAGJAX_CACHE", "off")
    np.testing.assert_array_equal(run(), found)
    assert len(made) == 1 and set(cache.iterdir()) == files


def test_files_that_are_damaged_are_made_again(cache, made):
    expected = run()
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    middle = len(whole) // 2
    for content in (b"", whole[:middle], whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]):
        file.write_bytes(content)
        made.clear()
        np.testing.assert_array_equal(run(), expected)
        assert len(made) == 1 and file.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_no_failure(cache, monkeypatch, tmp_path, made):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("LAGJAX_CACHE", str(tmp_path / "file"))
    assert np.isfinite(run()).all() and np.isfinite(run()).all()
    assert len(made) == 2


OWN = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="owners and modes are those of POSIX")


def kept(text="a") -> bytes:
    """The object that was kept for a text, or one that is made now, which is another one each time."""
    return _objects.load_or_make(lambda: os.urandom(8), text)


def give_to_another_user(monkeypatch, path) -> None:
    if os.geteuid() == 0:
        os.chown(path, 12345, -1)
    else:  # whoever runs the tests is another user from now on
        monkeypatch.setattr(os, "geteuid", lambda: 12345)


@OWN
def test_what_another_user_has_written_is_not_read(cache, monkeypatch):
    mine = kept()
    assert kept() == mine
    (file,) = cache.iterdir()
    give_to_another_user(monkeypatch, file)
    assert kept() != mine


@pytest.mark.filterwarnings("ignore:os.fork")  # the child calls nothing of JAX
@pytest.mark.skipif(not hasattr(os, "fork") or os.geteuid() != 0, reason="only root can be two users")
@pytest.mark.parametrize("inside", ["", "lagjax-0"])
def test_a_neighbour_on_the_machine_plants_nothing(monkeypatch, inside):
    """Objects of another user in a folder like /tmp, or in the one that would be made there, have the right names."""
    with tempfile.TemporaryDirectory() as shared:
        os.chmod(shared, 0o1777)
        monkeypatch.setenv("LAGJAX_CACHE", shared)
        place = Path(shared) / inside
        if (neighbour := os.fork()) == 0:
            with contextlib.suppress(BaseException):
                os.setuid(12345)
                place.mkdir(0o755, exist_ok=True)
                _objects.private_folder = lambda _: place
                kept()
            os._exit(0)
        os.waitpid(neighbour, 0)
        (planted,) = place.glob("*.o")
        with pytest.warns(UserWarning, match="not kept") if inside else contextlib.nullcontext():
            assert not planted.read_bytes().endswith(kept())
        assert planted.stat().st_uid == 12345


@OWN
@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770])
def test_in_a_folder_that_others_may_write_to_there_is_one_of_the_users_own(cache, mode):
    cache.mkdir()
    cache.chmod(mode)
    mine = kept()
    assert kept() == mine and [path.name for path in cache.iterdir()] == [f"lagjax-{os.geteuid()}"]
    assert next(cache.iterdir()).stat().st_mode & 0o777 == 0o700


@OWN
def test_without_a_folder_of_the_users_own_nothing_is_kept_and_one_warning_says_so(cache, monkeypatch):
    inside = cache / f"lagjax-{os.geteuid()}"
    inside.mkdir(parents=True)
    cache.chmod(0o777)
    inside.chmod(0o777)
    with pytest.warns(UserWarning, match="is no folder that only you can write to. Set LAGJAX_CACHE") as warned:
        assert kept() != kept()
    assert len(warned) == 1 and not list(inside.iterdir())


@OWN
def test_links_and_pipes_are_no_objects(cache, tmp_path):
    mine = kept()
    (file,) = cache.iterdir()
    elsewhere = tmp_path / "elsewhere"
    file.rename(elsewhere)
    file.symlink_to(elsewhere)
    assert kept() != mine
    file.unlink(missing_ok=True)
    os.mkfifo(file)  # to read it would wait for ever
    again = kept()
    assert again != mine and kept() == again


@OWN
def test_the_home_of_a_user_is_found_in_a_path(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("LAGJAX_CACHE", "~/kept")
    assert _objects.object_folder() == tmp_path / "kept"


def test_what_was_not_used_for_longest_goes_first(cache, monkeypatch):
    monkeypatch.setattr(_objects, "LARGEST_CACHE", 10_000)
    for k in range(9):  # of 1000 bytes and some, of which a tenth does not fit
        assert _objects.load_or_make(lambda k=k: bytes([k]) * 1000, str(k)) == bytes([k]) * 1000
        for file in cache.iterdir():  # in order, however coarse the clock of the files is
            age = time.time() - 1000 + file.read_bytes()[-1]
            os.utime(file, (age, age))
    assert _objects.load_or_make(lambda: b"unused", "0") == bytes(1000)  # it is used now
    _objects.load_or_make(lambda: bytes([9]) * 1000, "9")
    left = {file.read_bytes()[-1] for file in cache.iterdir()}
    assert {0, 9} < left and left <= {0, 3, 4, 5, 6, 7, 8, 9}


def test_many_may_write_and_read_at_once(cache):
    def work():
        for k in range(50):
            content = bytes([k % 5]) * 10_000
            assert _objects.load_or_make(lambda content=content: content, str(k % 5)) == content
            if k % 7 == 0:
                for file in cache.iterdir():
                    file.unlink(missing_ok=True)
        ended.append(1)

    ended = []
    threads = [threading.Thread(target=work) for _ in range(8)]
    for step in (threading.Thread.start, threading.Thread.join):
        for thread in threads:
            step(thread)
    assert len(ended) == 8 and not list(cache.glob("*.part"))


def test_the_folder_is_where_caches_belong(monkeypatch, tmp_path):
    monkeypatch.delenv("LAGJAX_CACHE", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _objects.object_folder() == tmp_path / "lagjax" / "objects"
    for word in ("off", "0"):
        monkeypatch.setenv("LAGJAX_CACHE", word)
        assert _objects.object_folder() is None
