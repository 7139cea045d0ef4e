"""Loops in machine code against the same functions in Python; and what they do not know, as a `TypeError`."""

import types
from math import atan2, cos, inf, isfinite, nan, sin, sqrt

import numpy as np
import pytest

from lagjax._native import Floats, Struct, Wholes, compile_loops, loop

COUNT, HALF = np.int64(3), 0.5  # constants that loops know


@loop
def decide(x: Floats, w: Wholes, n: int, a: float, out: Floats):
    """`if` with all its parts, conditions that are combined, and what is not evaluated as it does not matter."""
    flag = 0 < n <= 4 and not a > HALF
    if flag:
        out[0] = 1.0
    elif a > 0.9 or n == 0:
        out[0] = 2.0
    else:
        out[0] = 3.0
    if n >= len_of(w) or x[n] < 0:
        out[1] = -1.0
    if n < len_of(w) and w[n] != 2 and True:
        out[2] = float(w[n])
    out[3] = x[n] if n < len_of(w) else (1.0 if a < HALF else 0.0)
    out[4] = float(flag) + float(w[0] if w[0] > 1 else a)
    if w[1]:
        return
    out[5] = 4.0


@loop
def len_of(w: Wholes) -> int:
    """The length of the arrays of these tests."""
    return 6 + 0 * w[0]


@loop
def repeat(x: Floats, w: Wholes, n: int, a: float, out: Floats):
    """`while` and `for`, which end and go on early; what a variable is behind its loop."""
    i, turns = 0, 0
    while True:
        i += 1
        if i % 2 == 0:
            continue
        turns += 1
        if i > n or x[i] > 0.8:
            break
    out[0], out[1] = float(i), float(turns)
    k = -1
    for k in range(n):
        if x[k] < 0:
            break
        out[2] += x[k]
    out[3] = float(k)
    for i in range(2, 6):
        for j in range(5, i - 1, -1):
            if w[j] == 1:
                continue
            out[4] += x[i] * x[j]
        i = 0
    for j in range(1, 6, 2):
        out[5] += x[j]
    while n > 0:
        n -= 2
    out[1] += float(n) + a


@loop
def calculate(x: Floats, w: Wholes, n: int, a: float, out: Floats):
    """Arithmetic of both kinds of numbers, and what is known of functions."""
    out[0] = a * x[0] - x[1] / (2 + w[0]) + (w[1] // 2 - w[2] % 2) * 2 - -a + -w[3] / 4
    out[1] = abs(x[2]) + abs(n - 3) + max(x[0], w[0], a) - min(w[1], w[2]) + min(x[3], 0)
    out[2] = sqrt(abs(x[4])) + cos(a) * sin(x[5]) + atan2(x[0], x[1]) + cos(n)
    out[3] = float(isfinite(x[0])) + 2.0 * isfinite(a / x[2]) if a != x[3] else a
    out[4] = float(int(4.0 * a)) + (x[0] + n) ** 2 + COUNT * HALF + w[0] ** 2
    out[5] += 2
    out[5] *= x[0]
    out[5] /= 3
    w[0] += 1
    w[n] = w[0] * 2
    total = 1.5
    total -= n
    out[3] += total + float(a <= x[0]) + float(a >= x[0]) + float(a == x[0])


@loop
def part(x: Floats, w: Wholes, n: int, a: float, out: Floats):
    """Parts of arrays, which share their numbers, and calls."""
    out[0], out[1] = add(x[n:], w[1:][1:], 6 - max(n, 2)), a
    rest = out[2:]
    put(rest, 2, a)
    x[0], x[1] = x[1], x[0]
    rest[2:][0] = x[0] + float(is_odd(n))
    if is_odd(n) and not is_odd(n + 1):
        put(rest[3:], 1, add(x, w, 2))


@loop
def add(x: Floats, w: Wholes, count: int) -> float:
    """A sum of products."""
    total = 0.0
    for i in range(count):
        total += x[i] * w[i]
    return total


@loop
def put(into: Floats, count: int, value: float):
    """The same number everywhere."""
    for i in range(count):
        into[i] = value


@loop
def is_odd(n: int) -> bool:
    """True for odd numbers."""
    return n % 2 == 1


@pytest.mark.parametrize("of", [decide, repeat, calculate, part], ids=lambda of: of.name)
def test_a_loop_is_the_function_that_python_runs(of):
    (native,) = compile_loops(of)
    rng = np.random.default_rng(1)
    for _ in range(200):
        n = int(rng.integers(0, 7 if of is decide else 6))  # there the last one lies outside of arrays
        given = rng.normal(size=6), rng.integers(0, 4, 6), n, float(rng.uniform()), np.zeros(6)
        here, there = ([x.copy() if isinstance(x, np.ndarray) else x for x in given] for _ in range(2))
        of(*here)
        native(*(x.ctypes.data if isinstance(x, np.ndarray) else x for x in there))
        for a, b in zip(here, there, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-13, atol=1e-13)  # a product and a sum may be rounded together


@loop
def judge(x: Floats) -> int:
    """Numbers that are none: no comparison holds but that they differ."""
    return int(isfinite(x[0])) + 2 * int(x[0] < 1) + 4 * int(x[0] != x[0]) + 8 * int(not x[0] >= 1)


def test_comparisons_with_what_is_no_number():
    (native,) = compile_loops(judge)
    for x in (0.0, -0.0, 1.0, inf, -inf, nan, 5e-324):
        given = np.array([x])
        assert native(given.ctypes.data) == judge(given)


Table = Struct({"size": 0, "codes": 1}, frozenset(("size",)), None)
Body = Struct({"mass": 2, "q": 3}, frozenset(("mass",)), "table")


@loop
def weigh(table: Table, body: Body, count: int) -> float:  # type: ignore
    """Fields of structs, of which the table says where they are: numbers, arrays, and those of one of many."""
    total = 0.0
    for m in range(count):
        mine = body[m * table.size :]
        mine.mass += table.codes[m]
        mine.q[1] = 2.0 * mine.mass
        total += mine.mass * mine.q[0]
    return total


def test_fields_of_structs():
    table = np.array([4, 4, 2, 0, 7, 8])  # a body has four doubles: q (2,), the mass, and one more; codes are 7, 8
    bodies = np.arange(8.0).reshape(2, 4)
    (native,) = compile_loops(weigh)
    found = native(table.ctypes.data, bodies.ctypes.data, 2)
    assert found == (2 + 7) * 0 + (6 + 8) * 4
    np.testing.assert_array_equal(bodies, [[0, 18, 9, 3], [4, 28, 14, 7]])


# ---- what a loop does not know ----


@loop
def index_by_float(x: Floats, a: float):
    x[0] = x[a]


@loop
def change_kind(n: int):
    i = n
    i = 0.5  # noqa: F841


@loop
def put_float(w: Wholes, x: Floats):
    w[0] = x


@loop
def add_array(x: Floats, a: float) -> float:
    return a + x


@loop
def cube(a: float) -> float:
    return a**3


@loop
def divide_with_rest(a: float) -> float:
    return a // 2.0


@loop
def take_list(a: float) -> float:
    return max([a, 1.0])


@loop
def walk(x: Floats):
    for i in x:
        x[0] = i


@loop
def call_stranger(x: Floats):
    x[0] = np.exp(x[0])


@loop
def call_short(x: Floats):
    put(x, 1)  # type: ignore


@loop
def call_wrong(x: Floats):
    put(x, x, 1.0)


@loop
def read_unknown(x: Floats):
    x[0] = y  # type: ignore  # noqa: F821


@loop
def read_field(table: Table):  # type: ignore
    table.weight = 1


@loop
def ask_array(x: Floats):
    if x:
        x[0] = 1.0


@loop
def compare_arrays(x: Floats) -> int:
    return int(x < x)


@loop
def open_file(x: Floats):
    with x:
        x[0] = 1.0


@loop
def begin_behind(x: Floats, n: int):
    put(x[:n], n, 1.0)


@loop
def return_nothing(x: Floats) -> float:
    if x[0] > 0:
        return  # type: ignore
    return 1.0


STRANGE = {
    index_by_float: "x[a]", change_kind: "i begins as int, and becomes float", put_float: "w[0]", add_array: "a + x",
    cube: "a ** 3", divide_with_rest: "a // 2.0", take_list: "[a, 1.0]", walk: "x: `for` goes over a range",
    call_stranger: "np.exp(x[0])", call_short: "put(x, 1)", call_wrong: "put(x, x, 1.0)", read_unknown: "y: it has no",
    read_field: "table.weight", ask_array: "x: an array is no condition", compare_arrays: "x < x",
    open_file: "with x", begin_behind: "x[:n]", return_nothing: "return",
}  # fmt: skip


@pytest.mark.parametrize("of", STRANGE, ids=lambda of: of.name)
def test_what_a_loop_does_not_know_is_named(of):
    with pytest.raises(TypeError) as failed:
        compile_loops(of)
    assert str(failed.value).startswith(f"{of.name}: ") and STRANGE[of] in str(failed.value)


def test_objects_are_known_by_the_text_of_their_loops(tmp_path):
    """A loop outside of the package that is written anew is compiled anew, though it has the same name."""
    found = []
    for i in (1.0, 2.0):
        path = tmp_path / f"loops{i}.py"
        path.write_text(f"from lagjax._native import loop\n@loop\ndef same() -> float:\n    return {i}\n")
        module = types.ModuleType("loops")
        exec(compile(path.read_text(), str(path), "exec"), module.__dict__)
        found.append(compile_loops(module.same)[0]())
    assert found == [1.0, 2.0]
