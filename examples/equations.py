"""A double pendulum's equations of motion, printed; and compiled from C, which swings as lagjax does.

python examples/equations.py
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax
import numpy as np

import lagjax

jax.config.update("jax_enable_x64", True)


def compile_c(text: str) -> ctypes.CDLL:
    """The functions of a text in C, by this machine's compiler."""
    folder = Path(tempfile.mkdtemp())
    (folder / "scene.c").write_text(text)
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, folder / "scene.c", "-o", folder / "scene.so", "-lm"], check=True)
    return ctypes.CDLL(str(folder / "scene.so"))


scene = lagjax.scenes.double_pendulum()
print(scene.system.equations(scene.q0, scene.qdot0, params=scene.params))

text = scene.system.to_c(scene.q0, scene.qdot0, params=scene.params, name="pendulum")
print(f"\nin C: {text.count(chr(10))} lines")

if shutil.which("cc"):
    library = compile_c(text)
    q, qdot = np.array(scene.q0), np.array(scene.qdot0)
    numbers = np.array(jax.tree.leaves(scene.params))
    places = [ctypes.c_void_p(x.ctypes.data) for x in (q, qdot, numbers)]
    library.pendulum_step(*places[:2], ctypes.c_double(0.0), places[2], ctypes.c_double(1e-3), ctypes.c_long(1000))
    end = lagjax.simulate(scene.system, scene.q0, scene.qdot0, np.array([0.0, 1.0]), scene.params).q[-1]
    difference = float(np.abs(q - end).max())
    print(f"after a second, in steps of 1 ms: {q} in C, {end} by Taylor series, difference {difference:.1e}")
