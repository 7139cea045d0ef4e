"""What a scene's functions read may change between two calls: the new values give the new motion, old ones the old one.

And where nothing has changed, nothing is derived anew, whatever objects lie about: a compilation for every call is as
bad as a wrong number.
"""

import collections
import dataclasses
import enum
import functools
import itertools
import sys
import threading
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax._equations import _derivation
from lagjax._interface.reads import Edition

TS = np.linspace(0.0, 1.0, 3)


def spring(k, q, v):
    return 0.5 * v**2 - 0.5 * k * q**2


def end(scene):
    return float(lagjax.simulate(scene, 1.0, 0.0, TS).end.q)


@pytest.fixture
def derived(monkeypatch):
    """The derivations that are made, one by one."""
    made, real = [], _derivation._derive_structure

    def counted(key, unhashable=None):
        made.append(key)
        return real(key, unhashable)

    monkeypatch.setattr(_derivation, "_derive_structure", counted)
    monkeypatch.setattr(_derivation, "_derived_once", functools.lru_cache(maxsize=64)(counted))
    return made


# ---- what a function may read its stiffness from: (the function, what sets it) -------------------------------------


def cell(text, **names):
    """A function written in a notebook's cell, with the names that stand there."""
    space = {"jnp": jnp, "np": np, "jax": jax, "functools": functools, "__name__": "__main__", **names}
    exec(text, space)
    return space


def by_global():
    space = cell("def L(q, v): return 0.5 * v**2 - 0.5 * K * q**2")
    return space["L"], lambda k: space.update(K=k)


def by_closure():
    stiffness = None

    def change(k):
        nonlocal stiffness
        stiffness = k

    return lambda q, v: spring(stiffness, q, v), change


def by_numpy_array():
    table = np.zeros(3)
    return lambda q, v: spring(table[1], q, v), lambda k: table.__setitem__(1, k)


def by_view_of_an_array():
    whole = np.zeros((3, 3))
    part = whole[:, 1]
    return lambda q, v: spring(part[1], q, v), lambda k: whole.__setitem__((1, 1), k)


def by_jax_array():
    held = {}
    return lambda q, v: spring(held["k"][0], q, v), lambda k: held.update(k=jnp.array([k, 0.0]))


def by_numpy_scalar():
    space = cell("def L(q, v): return 0.5 * v**2 - 0.5 * K * q**2")
    return space["L"], lambda k: space.update(K=np.float64(k))


def by_dict():
    held = {"k": {"inner": 0.0}}
    return lambda q, v: spring(held["k"]["inner"], q, v), lambda k: held["k"].update(inner=k)


def by_list():
    held = [0.0, [0.0]]
    return lambda q, v: spring(held[1][0], q, v), lambda k: held[1].__setitem__(0, k)


def by_deque():
    held = collections.deque([0.0])
    return lambda q, v: spring(held[0], q, v), lambda k: held.__setitem__(0, k)


class Callable:
    def __init__(self):
        self.k, self.inner = 0.0, types.SimpleNamespace(k=0.0)

    def __call__(self, q, v):
        return spring(self._gain(), q, v)

    def _gain(self):
        return self.k

    def of_inner(self, q, v):
        return spring(self.inner.k, q, v)

    @property
    def stiffness(self):
        return 2.0 * self.k

    def by_property(self, q, v):
        return spring(0.5 * self.stiffness, q, v)

    def by_getattr(self, q, v):
        return spring(getattr(self, "".join(["k"])), q, v)


def by_attribute(method="__call__"):
    thing = Callable()
    return (thing if method == "__call__" else getattr(thing, method)), lambda k: setattr(thing, "k", k)


def by_inner_attribute():
    thing = Callable()
    return thing.of_inner, lambda k: setattr(thing.inner, "k", k)


def by_class_attribute():
    space = cell("class Of:\n    k = 0.0\ndef L(q, v): return 0.5 * v**2 - 0.5 * Of.k * q**2")
    return space["L"], lambda k: setattr(space["Of"], "k", k)


def by_attribute_over_that_of_its_class():
    space = cell("class Of:\n    k = 0.0\nof = Of()\ndef L(q, v): return 0.5 * v**2 - 0.5 * of.k * q**2")
    return space["L"], lambda k: setattr(space["of"], "k", k)


def by_slots():
    space = cell("class Of:\n    __slots__ = ('k',)\nof = Of()\ndef L(q, v): return 0.5 * v**2 - 0.5 * of.k * q**2")
    return space["L"], lambda k: setattr(space["of"], "k", k)


def by_operator():
    text = "class Of:\n    def __mul__(self, x): return K * x\nof = Of()\ndef L(q, v): return 0.5 * (v**2 - of * q**2)"
    space = cell(text)
    return space["L"], lambda k: space.update(K=k)


def by_dataclass():
    made = dataclasses.make_dataclass("Of", ["k"])(0.0)
    return lambda q, v: spring(made.k, q, v), lambda k: setattr(made, "k", k)


def by_helper():
    space = cell(
        "def gain(): return inner()\ndef inner(): return K\ndef L(q, v): return 0.5 * v**2 - 0.5 * gain() * q**2"
    )
    return space["L"], lambda k: space.update(K=k)


def by_helper_that_is_written_again():
    space = cell("def L(q, v): return 0.5 * v**2 - 0.5 * gain() * q**2")
    return space["L"], lambda k: exec(f"def gain(): return {k!r}", space)


def by_module():
    helpers, inner = types.ModuleType("helpers"), types.ModuleType("inner")
    helpers.inner, inner.f = inner, lambda q, v: spring(inner.K, q, v)
    return lambda q, v: helpers.inner.f(q, v), lambda k: setattr(inner, "K", k)


def by_number_on_a_function():
    def gain():
        return gain.k

    return lambda q, v: spring(gain(), q, v), lambda k: setattr(gain, "k", k)


def by_default():
    def lagrangian(q, v, *, of=[0.0]):  # noqa: B006
        return spring(of[0], q, v)

    return functools.partial(lagrangian, of=(kept := [0.0])), lambda k: kept.__setitem__(0, k)


def by_default_of_a_helper():
    def gain(of=[0.0]):  # noqa: B006
        return of[0]

    return lambda q, v: spring(gain(), q, v), lambda k: gain.__defaults__[0].__setitem__(0, k)


def by_branch_that_jax_keeps():
    space = cell(
        "def soft(q): return 0.5 * K * q**2\ndef L(q, v):\n"
        "    return 0.5 * v**2 - jax.lax.cond(q > 10.0, lambda q: 0.0 * q, soft, q)"
    )
    return space["L"], lambda k: space.update(K=k)


def by_jitted_helper():
    space = cell("@jax.jit\ndef V(q): return 0.5 * K * q**2\ndef L(q, v): return 0.5 * v**2 - V(q)")
    return space["L"], lambda k: space.update(K=k)


def by_checkpointed_helper():
    space = cell("V = jax.checkpoint(lambda q: 0.5 * K * q**2)\ndef L(q, v): return 0.5 * v**2 - V(q)")
    return space["L"], lambda k: space.update(K=k)


class Module(eqx.Module):
    held: list = eqx.field(static=True)

    def __call__(self, q, v):
        return spring(self.held[0], q, v)


def by_static_field():
    module = Module([0.0])
    return module, lambda k: module.held.__setitem__(0, k)


def by_mapping():
    held = collections.UserDict(k=0.0)
    return lambda q, v: spring(held["k"], q, v), lambda k: held.update(k=k)


def by_object_array():
    held = np.array([None, None])
    return lambda q, v: spring(held[0], q, v), lambda k: held.__setitem__(0, k)


def by_import_inside(name="reads_inside"):
    sys.modules[name] = module = types.ModuleType(name)
    space = cell(f"def L(q, v):\n    from {name} import K\n    return 0.5 * v**2 - 0.5 * K * q**2")
    return space["L"], lambda k: setattr(module, "K", k)


def by_recursion():
    text = "def power(n): return 1.0 if n == 0 else K * power(n - 1)\n"
    space = cell(text + "def L(q, v): return 0.5 * (v**2 - power(1) * q**2)")
    return space["L"], lambda k: space.update(K=k)


def by_name_that_comes_later():
    space = cell("def L(q, v): return 0.5 * (v**2 - abs(4.0) * q**2)")
    return space["L"], lambda k: space.update(abs=lambda x: k)


WAYS = {name: thing for name, thing in list(globals().items()) if name.startswith("by_")}
WAYS |= {
    "by_method": functools.partial(by_attribute, "by_property"),
    "by_getattr": functools.partial(by_attribute, "by_getattr"),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_new_value_gives_the_new_motion_and_the_old_one_the_old(way, derived):
    function, change = WAYS[way]()
    change(4.0)
    scene = lagjax.System(function)
    for k in (4.0, 1.0, 1.0, 4.0):
        change(k)
        np.testing.assert_allclose(end(scene), np.cos(np.sqrt(k)), atol=1e-8)
        np.testing.assert_allclose(scene.acceleration(1.0, 0.0), -k, atol=1e-12)
    assert len(derived) == 2  # and what was derived from a value serves it again


# ---- nothing has changed -------------------------------------------------------------------------------------------


class Counting:
    """A Lagrangian that counts its calls, keeps a list of them, and remembers a number."""

    def __init__(self):
        self.calls, self.seen, self.table, self.buffer = 0, [], {}, np.zeros(3)

    @functools.cached_property
    def k(self):
        return 4.0

    def __call__(self, q, v):
        self.calls += 1
        self.seen.append(len(self.seen))
        self.table[self.calls] = self.calls
        self.buffer[0] += 1.0
        self.last = self.calls
        return spring(self.k, q, v)


class Odd:
    """An object that cannot be compared, hashed, shown, or copied."""

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self):
        self.k, self.unread = 4.0, 0

    def __eq__(self, other):
        raise ValueError("no comparison")

    def __repr__(self):
        raise ValueError("no text")

    def __getattr__(self, name):
        raise AttributeError(name)


class Arraylike:
    k = 4.0

    def __eq__(self, other):
        return np.array([True, False])

    def __hash__(self):
        return 1


class Colour(enum.IntEnum):
    RED = 4


def counter():
    space = cell("calls = 0\ndef L(q, v):\n    global calls\n    calls += 1\n    return 0.5 * (v**2 - 4.0 * q**2)")
    return space["L"]


def reading(thing, k=lambda thing: 4.0):
    return lambda q, v: spring(k(thing), q, v)


def forever():
    loop: list = [4.0]
    loop.append(loop)
    return loop


QUIET = {
    "nan": lambda: reading(float("nan")),
    "array of nan": lambda: reading(np.full(3, np.nan)),
    "counts its calls": Counting,
    "counts in a global": counter,
    "generator": lambda: reading(x for x in range(3)),
    "advances an iterator": lambda: reading(itertools.count(), lambda it: 4.0 + 0.0 * next(it)),
    "random numbers": lambda: reading(np.random.default_rng(0), lambda rng: 4.0 + 0.0 * rng.normal()),
    "odd object": lambda: reading(Odd(), lambda x: x.k),
    "array for ==": lambda: reading(Arraylike(), lambda x: x.k),
    "lock": lambda: reading(threading.Lock()),
    "enumeration": lambda: reading(Colour.RED, lambda x: float(x)),
    "contains itself": lambda: reading(forever(), lambda x: x[0]),
    "cycle of objects": lambda: reading(types.SimpleNamespace(k=4.0, up=[]), lambda x: x.up.append(x) or x.k),
    "memory": lambda: reading(functools.cache(lambda x: 4.0 * x), lambda f: f(1.0)),
    "large array": lambda: reading(np.full(1_000_000, 4.0), lambda x: x[3]),
    "large list": lambda: reading([4.0] * 100_000, lambda x: x[3]),
    "module": lambda: reading(np),
    "trajectory": lambda: reading(lagjax.simulate(lagjax.System(reading(0)), 1.0, 0.0, TS)),
    "file": lambda: reading(sys.stdout),
}


@pytest.mark.parametrize("kind", QUIET)
def test_nothing_is_derived_anew_where_nothing_has_changed(kind, derived):
    scene = lagjax.System(QUIET[kind]())
    made = []
    for _ in range(4):
        np.testing.assert_allclose(end(scene), np.cos(2.0), atol=1e-8)
        made.append(len(derived))
    assert made[-1] == made[0]


def test_what_one_function_changes_another_one_may_read(derived):
    seen = []

    def lagrangian(q, v):
        seen.append("L")
        return spring(4.0, q, v)

    def forces(q, v):
        seen.append("Q")
        return -1.0 * v

    scene = lagjax.System(lagrangian, forces=forces)
    for _ in range(3):
        end(scene)
    assert len(derived) == 1 and {"L", "Q"} == set(seen)


def test_equal_values_and_functions_are_not_derived_anew(derived):
    space = cell("")
    text = "class Of:\n    k = 4.0\ndef gain(x): return Of.k * x\ndef L(q, v): return 0.5 * (v**2 - gain(K) * q**2)"
    for _ in range(3):  # a notebook's cells run again
        exec(text + "\nK = np.ones(3).sum() / 3.0", space)
        np.testing.assert_allclose(end(lagjax.System(space["L"])), np.cos(2.0), atol=1e-8)
    for k in (1.0, 4.0, 1.0):  # and a function of a loop
        np.testing.assert_allclose(end(lagjax.System(functools.partial(spring, k))), np.cos(np.sqrt(k)), atol=1e-8)
    assert len(derived) == 3


def test_attributes_that_no_code_names_do_not_matter(derived):
    thing = Odd()
    scene = lagjax.System(reading(thing, lambda x: x.k))
    for k in range(3):
        thing.unread, thing.new = k, k
        end(scene)
    assert len(derived) == 1


def test_functions_that_differ_in_what_cannot_be_seen_are_two():
    one, two = (Edition.from_function(reading(x for x in range(3))) for _ in range(2))
    assert one.text == two.text and one != two and one == one.now()


# ---- every public function -----------------------------------------------------------------------------------------


def of_state(method):
    return lambda scene: getattr(scene, method)(1.0, 0.5)


def bounced(scene):
    wall = lagjax.Transition("free", "free", lambda q, v: q - 0.1, -1, lambda q, v: (q, -v))
    return lagjax.simulate(lagjax.Hybrid({"free": scene}, [wall], "free"), 1.0, 0.0, np.array([0.0, 2.0])).end.q


def fitted(scene):
    ts = np.linspace(0.0, 3.0, 31)
    dragged = lagjax.System(scene.lagrangian.code.function, forces=lambda q, v, params: -params * v)
    return lagjax.fit(dragged, lagjax.Record(ts, np.cos(ts) * np.exp(-0.1 * ts)), 0.3).params


def same(scene):
    return bool(lagjax.same_motion(scene, lagjax.System(functools.partial(spring, 4.0)), 1.0, 0.5).same)


def crossed(scene):
    return lagjax.crossings(scene, lambda q, v: q - 0.1, 1.0, 0.0, np.array([0.0, 9.0])).t


PUBLIC = {
    "simulate": end,
    "simulate by diffrax": lambda scene: lagjax.simulate(scene, 1.0, 0.0, TS, dt=0.05).end.q,
    "simulate_batch": lambda scene: lagjax.simulate_batch(scene, np.ones(2), np.zeros(2), TS).end.q,
    "jit": lambda scene: jax.jit(lambda q: lagjax.simulate(scene, q, 0.0, TS).end.q)(1.0),
    "grad": lambda scene: jax.grad(lambda q: lagjax.simulate(scene, q, 0.0, TS).end.q)(1.0),
    "crossings": crossed,
    "a hybrid motion": bounced,
    "energy": of_state("energy"),
    "acceleration": of_state("acceleration"),
    "momentum": of_state("momentum"),
    "mass_matrix": of_state("mass_matrix"),
    "generalized_force": of_state("generalized_force"),
    "explain": lambda scene: str(scene.explain(1.0, 0.5)),
    "energy of a trajectory": lambda scene: lagjax.simulate(scene, 1.0, 0.0, TS).energy(),
    "health": lambda scene: str(lagjax.simulate(scene, 1.0, 0.0, TS).health()),
    "check": lambda scene: str(lagjax.check(scene, 1.0, 0.5)),
    "equilibrium": lambda scene: lagjax.equilibrium(scene, 0.3).q,
    "linearize": lambda scene: lagjax.linearize(scene, 0.0).stiffness,
    "normal_modes": lambda scene: lagjax.normal_modes(scene, 0.0).frequencies,
    "conserved_quantities": lambda scene: [c.charge(1.0, 0.5) for c in lagjax.conserved_quantities(scene, 1.0, 0.5)],
    "noether_charge": lambda scene: lagjax.noether_charge(scene, lambda q: q)(1.0, 0.5),
    "cyclic_coordinates": lambda scene: str(lagjax.cyclic_coordinates(scene, 1.0, 0.5)),
    "same_motion": same,
    "hamiltonian": lambda scene: lagjax.hamiltonian(scene).equations(1.0, 0.5),
    "change_coordinates": lambda scene: end(lagjax.change_coordinates(scene, lambda Q: 2.0 * Q).system),
    "periodic_orbit": lambda scene: lagjax.periodic_orbit(scene, 1.0, 0.0, 6.4 * SPACE["T"]).period,
    "lyapunov_exponent": lambda scene: lagjax.lyapunov_exponent(scene, 1.0, 0.5, 3.0).value,
    "action": lambda scene: lagjax.action(scene, lambda t: jnp.cos(t), 0.0, 1.0),
    "find_path": lambda scene: lagjax.find_path(scene, 1.0, 0.5, 0.0, 1.0).action,
    "fit": fitted,
}
SPACE = cell("def gain(x): return K * x\ndef L(q, v): return 0.5 * M * v**2 - 0.5 * gain(q) * q")
SCENE = lagjax.System(SPACE["L"])


SLOW = (
    "fit|simulate by diffrax|a hybrid motion|equilibrium|conserved_quantities|linearize|hamiltonian|normal_modes|action"
)


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] if x in SLOW.split("|") else []) for x in PUBLIC]
)
def test_every_public_function_sees_the_present_values(name):
    found = []
    for k, m in ((4.0, 1.0), (1.0, 2.0)):
        SPACE.update(K=k, M=m, T=np.sqrt(m / k))
        found.append(PUBLIC[name](SCENE))
    fresh = PUBLIC[name](lagjax.System(lambda q, v: 0.5 * 2.0 * v**2 - 0.5 * 1.0 * q * q))
    for one, other in zip(*map(jax.tree.leaves, (found[1], fresh)), strict=True):
        if not isinstance(one, str):
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)
        elif name != "explain":
            assert one == other


# ---- numbers that are being traced ---------------------------------------------------------------------------------


def moved(k, c=0.0, **options):
    """The end of an oscillator with a stiffness and a friction that its functions close over."""

    def gain(q):
        return k * q

    held = {"c": [c]}
    scene = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * gain(q) * q, forces=lambda q, v: -2.0 * held["c"][0] * v)
    return lagjax.simulate(scene, 1.0, 0.0, TS, **options).end


def exact(k, c):
    """x(1) of ẍ + 2c ẋ + k x = 0 from rest at 1."""
    w = jnp.sqrt(k - c**2)
    return jnp.exp(-c) * (jnp.cos(w) + c / w * jnp.sin(w))


def end_of(k, c):
    return moved(k, c).q


def test_numbers_that_are_closed_over_while_they_are_traced_are_parameters(derived):
    for k, c in ((4.0, 0.1), (9.0, 0.3)):
        found = jax.value_and_grad(end_of, argnums=(0, 1))(k, c)
        expected = jax.jit(jax.value_and_grad(exact, argnums=(0, 1)))(k, c)
        np.testing.assert_allclose(jax.tree.leaves(found), jax.tree.leaves(expected), atol=1e-8)
    assert len(derived) == 1  # for both values, and the functions of all calls, with machine code


@pytest.mark.slow
def test_closed_over_tracers_under_every_transformation(derived):
    both, (ks, cs) = {"argnums": (0, 1)}, (np.array([1.0, 4.0, 9.0]), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(
        jax.hessian(end_of, **both)(ks[1], cs[1]), jax.jit(jax.hessian(exact, **both))(ks[1], cs[1]), atol=1e-7
    )
    np.testing.assert_allclose(jax.vmap(end_of)(ks, cs), exact(ks, cs), atol=1e-8)
    compiled, of_exact = (jax.vmap(jax.grad(f, **both)) for f in (end_of, exact))
    np.testing.assert_allclose(jax.jit(compiled)(ks, cs), of_exact(ks, cs), atol=1e-8)
    assert len(derived) == 1


@pytest.mark.slow
def test_closed_over_tracers_beside_params_events_and_members():
    def ends(k, level):
        scene = lagjax.System(lambda q, v, params: 0.5 * params["m"] * v**2 - 0.5 * k * q**2)
        run = lagjax.simulate(
            scene, 1.0, 0.0, np.array([0.0, 3.0]), {"m": 1.0, "kind": "spring"}, event=lambda q, v: q - level
        )
        assert run.params["kind"] == "spring" and run.engine == "MachineCode"
        several = lagjax.simulate_batch(
            scene, 1.0, 0.0, TS, {"m": jnp.array([1.0, 4.0])}, batch_axes=(None, None, {"m": 0})
        )
        assert several.engine == "MachineCode"
        return run.end.t, several.end.q

    t, q = ends(4.0, 0.5)
    by_k, by_level = zip(*jax.jacobian(ends, argnums=(0, 1))(4.0, 0.5), strict=True)
    np.testing.assert_allclose(t, np.pi / 6, atol=1e-8)  # cos(2 t) = 1/2
    np.testing.assert_allclose(q, np.cos([2.0, 1.0]), atol=1e-8)
    np.testing.assert_allclose(by_k[0], -np.pi / 6 / 8, atol=1e-8)  # t = arccos(level)/√k
    np.testing.assert_allclose(by_level[0], -1 / np.sqrt(0.75) / 2, atol=1e-8)
    np.testing.assert_allclose(by_k[1], [-np.sin(2.0) / 4, -np.sin(1.0) / 8], atol=1e-8)
    np.testing.assert_allclose(by_level[1], 0.0, atol=1e-12)
