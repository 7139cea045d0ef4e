"""The text of all machine code that a list of scenes and forms needs: does a change of the compiler change any of it?

    python -m benchmarks.emitted --write FOLDER      # at the commit before
    python -m benchmarks.emitted --compare FOLDER    # at the one after: exit code 0 where no text differs

A step that only says the compiler in other words must leave every line. The texts are those of LLVM's modules before
any pass, as `_native.code._ir.compile_module` gets them, one file for each scene, form and module in the order of their
making. They depend on the width of vectors: compare on one kind of machine.
"""

import argparse
import difflib
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from lagjax._native.code import _ir

TS = jnp.linspace(0.0, 1.0, 5)
_SHOWN = 20  # lines of a difference that are printed


def springs(count: int) -> lagjax.System:
    """A row of masses with springs that harden: straight lines for few, tables for many."""

    def lagrangian(q, v, params):
        stretched = jnp.diff(q, prepend=0.0, append=0.0)
        return 0.5 * v @ v - params["k"] * jnp.sum(0.5 * stretched**2 + 0.25 * stretched**4)

    return lagjax.System(lagrangian)


def block(q, v, params):
    """A block on a spring, whose dry friction makes it stick."""
    return -params["dry"] * jnp.sign(v)


def driven(q, v, t, params):
    """A force read off samples whose values are parameters."""
    return lagjax.samples(np.linspace(-1.0, 2.0, 7), params["u"], "linear")(t)


def scenes() -> dict[str, tuple]:
    """(system, q0, qdot0, params) by name: for each kind of piece that a step may have."""
    ready = {}
    for make in (
        lagjax.scenes.pendulum,
        lagjax.scenes.double_pendulum,
        lagjax.scenes.cartesian_pendulum,
        lagjax.scenes.chain,
        lagjax.scenes.knife_edge,
    ):
        scene = make()
        ready[make.__name__] = scene.system, scene.q0, scene.qdot0, scene.params
    spring = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * q**2, forces=block)
    push = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2, forces=driven)
    for count in (4, 100):
        q = 0.1 * jnp.cos(jnp.arange(float(count)))
        ready[f"springs_{count}"] = springs(count), q, jnp.zeros(count), {"k": 1.3}
    ready["dry_friction"] = spring, 1.0, 0.0, {"dry": 0.3}
    ready["samples"] = push, 1.0, 0.0, {"u": jnp.sin(jnp.arange(7.0))}
    return ready


def motion(system, q, v, params):
    return lagjax.simulate(system, q, v, TS, params).q


def batch(system, q, v, params):
    some = jax.tree.map(lambda x: jnp.stack([1.0 * x] * 8), (q, v))
    return lagjax.simulate_batch(system, *some, TS, params).q


def total(system, q, v, params):
    return sum(jnp.sum(x[-1]) for x in jax.tree.leaves(motion(system, q, v, params)))


def floats(params):
    return jax.tree.map(lambda x: jnp.asarray(x, float), params)


def forward(system, q, v, params):
    return jax.jacfwd(lambda p: total(system, q, v, p))(floats(params))


def reverse(system, q, v, params):
    return jax.grad(lambda p: total(system, q, v, p))(floats(params))


def second(system, q, v, params):
    return jax.hessian(lambda p: total(system, q, v, p))(floats(params))


def first_of(q):
    return jnp.ravel(jax.tree.leaves(q)[0])[0]


def event(system, q, v, params):
    place = 0.9 * first_of(jax.tree.map(jnp.asarray, q)) - 0.01
    return lagjax.simulate(system, q, v, TS, params, event=lambda q, v: first_of(q) - place, throw=False).q


def crossings(system, q, v, params):
    place = 0.9 * first_of(jax.tree.map(jnp.asarray, q)) - 0.01
    return lagjax.crossings(system, lambda q, v: first_of(q) - place, q, v, (0.0, 1.0), params, count=4).t


FORMS: tuple[Callable, ...] = (motion, batch, forward, reverse, second, event, crossings)
# Of large scenes, and of constraints, the forms that say something new.
FEW = {"springs_100": (motion, batch, reverse), "knife_edge": (motion, reverse), "chain": (motion, batch, forward)}


def texts() -> dict[str, str]:
    """The text of every module, by scene, form and number."""
    found: dict[str, str] = {}
    before = _ir.load_or_make
    for name, scene in scenes().items():
        for form in FEW.get(name, FORMS):
            made: list[str] = []

            def noted(make, text, *more, made=made):
                made.append(text)
                return before(make, text, *more)

            _ir.load_or_make = noted
            try:
                jax.block_until_ready(form(*scene))
            finally:
                _ir.load_or_make = before
            found |= {f"{name}.{form.__name__}.{k}.ll": text for k, text in enumerate(made)}
    return found


def compare(found: dict[str, str], folder: Path) -> int:
    """How many texts differ from those in a folder; each difference is printed, but for its end."""
    kept = {file.name: file.read_text() for file in folder.glob("*.ll")}
    count = 0
    for name in sorted(kept.keys() | found.keys()):
        one, other = kept.get(name), found.get(name)
        if one == other:
            continue
        count += 1
        if one is None or other is None:
            print(f"{name}: {'is new' if one is None else 'is not made any more'}")
            continue
        lines = list(difflib.unified_diff(one.splitlines(), other.splitlines(), "before", "after", n=1, lineterm=""))
        print(f"{name}: {len(lines)} lines", *lines[:_SHOWN], sep="\n    ")
    print(f"{len(found)} texts, {sum(map(len, found.values())) / 1e6:.1f} MB; {count} differ")
    return count


def main(arguments=None) -> int:
    """Write the texts, or compare them with others."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument("--write", type=Path, metavar="FOLDER")
    chosen.add_argument("--compare", type=Path, metavar="FOLDER")
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    found = texts()
    if given.compare is not None:
        return int(compare(found, given.compare) > 0)
    given.write.mkdir(parents=True, exist_ok=True)
    for name, text in found.items():
        (given.write / name).write_text(text)
    print(f"{len(found)} texts, {sum(map(len, found.values())) / 1e6:.1f} MB, in {given.write}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
