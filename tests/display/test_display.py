"""`print(trajectory)`: three lines that say what it holds, how far it came and how it ended, wherever it is printed."""

import dataclasses
import pickle
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALL, FREE, PENDULUM

import lagjax


def falling(q, qdot):
    return 0.5 * qdot**2 + 1 / q  # into the centre at π/√8 from q = 1


FALL = lagjax.System(falling)
COUNTED = lagjax.System(lambda q, v, params: 0.5 * v**2 - sum(q**2 for _ in range(params["n"])))
POINT_AND_PLANE = lagjax.System(lambda q, v: 0.5 * v["x"] ** 2 + 0.5 * v["y"] @ v["y"] - 0.5 * q["x"] ** 2)
HELD_FALL = lagjax.System(falling, constraints=lambda q: q, path="array")
TS = np.linspace(0.0, 2.0, 5)


def lines(thing):
    assert repr(thing) == str(thing)
    return repr(thing).splitlines()


@pytest.fixture(scope="module")
def fallen():
    return lagjax.simulate_batch(FALL, np.array([[9.0, 1.0, np.nan]] * 2).reshape(-1), np.zeros(6), TS)


def test_one_motion():
    q0 = {"x": 1.0, "y": np.zeros(2)}
    run = lagjax.simulate(POINT_AND_PLANE, q0, jax.tree.map(jnp.zeros_like, q0), TS)
    steps = int(run.stats["num_steps"])
    assert lines(run) == [
        "Trajectory, float64: q['x'] (5,), q['y'] (5, 2), and qdot",
        f"t from 0 to 2 at 5 outputs, {steps} steps (0 rejected)",
        "reached the end",
    ]
    assert eqx.tree_pformat(run).startswith("Trajectory(\n  ts=f64[5]")


def test_a_motion_that_fails_says_where():
    run = lagjax.simulate(FALL, 1.0, 0.0, TS, throw=False)
    assert lines(run)[2] == "ended at t = 1.11072: dt_min_reached"


def test_a_batch(fallen):
    first, second, third = lines(fallen)
    assert first == "Trajectory of 6 members, float64: q (6, 5), and qdot"
    assert second.startswith("t from 0 to 2 at 5 outputs, ") and "steps in the median, at most " in second
    assert third.startswith("2 of 6 reached the end, 2 dt_min_reached, 2 nonfinite_state: the first that failed is")
    assert third.endswith("member 1, at t = 1.11072")


def test_a_hybrid_motion():
    bounce = lagjax.Transition("flight", "flight", guard=lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.5 * v))
    ball = BALL
    run = lagjax.simulate(lagjax.Hybrid({"flight": ball}, [bounce], "flight"), 1.0, 0.0, TS, throw=False)
    first, second, third = lines(run)
    assert first.endswith("; modes flight") and second.endswith("32 transitions") and third.endswith(": zeno")
    assert str(run.transitions).startswith("32 transitions between places in mode_names: 0 → 0 at t = 0.451524, 0 → 0")
    assert repr(bounce) == "Transition('flight' → 'flight' where <lambda> falls through zero, with the reset <lambda>)"
    assert repr(lagjax.Hybrid({"flight": ball}, [bounce], "flight")).startswith(
        "Hybrid of 'flight', begins in 'flight'"
    )


def test_what_has_no_numbers(fallen):
    """Tracers under jit and vmap, shapes without values, and pytrees of another kind in the form of a trajectory."""
    seen = []

    def run(q0):
        run = lagjax.simulate(FALL, q0, 0.0, TS, throw=False)
        seen.append(lines(run))
        return run

    traced = ["the steps are being traced", "the result is being traced"]
    assert lines(jax.eval_shape(run, 2.0))[2] == traced[1]
    jax.vmap(run)(np.full(2, 9.0))
    for first, second, third in seen:
        assert first == "Trajectory, float64: q (5,), and qdot"
        assert [second.split("; ")[1], third] == traced
    assert repr(jax.tree.map(lambda _: 0, fallen)).startswith("Trajectory(\n  ts=0")
    assert repr(eqx.filter(fallen, False)).startswith("Trajectory(\n  ts=None")


def test_batches_of_batches_and_times_of_their_own():
    run = jax.vmap(lambda size: lagjax.simulate_batch(FALL, jnp.full(3, 9.0), jnp.zeros(3), TS * size))(np.arange(1, 3))
    first, second, third = lines(run)
    assert first.startswith("Trajectory of 2 × 3 members") and second.startswith("t from 0 to 2 … 4 at 5 outputs")
    assert third == "6 of 6 reached the end"


def test_a_scene_is_one_line():
    assert repr(FALL) == "System(lagrangian=falling, path='auto')"
    assert repr(HELD_FALL) == "System(lagrangian=falling, constraints=<lambda>, path='array')"


def test_a_notebook_shows_the_lines_and_a_picture(fallen):
    for run in (fallen, lagjax.simulate(FALL, 9.0, 0.0, TS)):
        shown = run._repr_html_()
        assert repr(run).splitlines()[0] in shown and "data:image/png;base64," in shown
    assert "png" in jax.vmap(lambda z: lagjax.simulate(FALL, 9.0, 0.0, TS * z))(np.ones(2))._repr_html_()


NAMED_LIKE_HTML = lagjax.System(lambda q, v: 0.5 * v["<b>"] ** 2)


def test_names_that_are_html_are_shown_as_they_are():
    run = lagjax.simulate(NAMED_LIKE_HTML, {"<b>": 0.0}, {"<b>": 1.0}, TS)
    assert "<b>" not in run._repr_html_() and "&lt;b&gt;" in run._repr_html_()


def test_a_picture_of_a_large_batch_is_of_a_few_members(fallen, monkeypatch):
    from lagjax._show import _notebook

    places = []
    course = _notebook.courses_of(fallen, [0])
    monkeypatch.setattr(
        _notebook, "courses_of", lambda run, some: places.append(len(some)) or (course[0], course[1] * 30)
    )
    wide = eqx.tree_at(lambda t: t.result._value, fallen, np.zeros(100_000, int))
    wide = eqx.tree_at(lambda t: (t.q, t.end.t), wide, (np.zeros((100_000, 5)), np.zeros(100_000)))
    assert wide._repr_html_() is not None and places == [30]


def test_no_picture_where_there_is_nothing_to_draw(fallen, monkeypatch):
    seen = []

    def run(q0):
        run = lagjax.simulate(FALL, q0, 0.0, TS, throw=False)
        seen.append(run._repr_html_())
        return run

    assert jax.eval_shape(run, 2.0)._repr_html_() is None and seen == [None]
    assert jax.tree.map(lambda _: 0, fallen)._repr_html_() is None
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert fallen._repr_html_() is None


STIFF = lagjax.System(lambda q, v: 0.5 * v**2 - 2 * q**2)


def test_results_show_in_a_notebook_what_they_print():
    pretty = pytest.importorskip("IPython.lib.pretty").pretty

    crossed = lagjax.crossings(FREE, lambda q, v: q, -1.0, 1.0, TS)
    findings = lagjax.check(FALL, 1.0, 0.0)
    modes = lagjax.normal_modes(STIFF, 0.0)
    for result in (crossed, findings, modes, FALL.explain(1.0, 0.0)):
        assert pretty(result) == str(result)
    assert str(crossed) == "1 crossings from t = 1 to 1, all there"


def test_a_newcomer_sees_that_the_switch_for_doubles_is_off(fallen):
    with jax.enable_x64(False):
        run = eqx.tree_at(lambda t: t.ts, fallen, fallen.ts.astype(jnp.float32))
        assert lines(run)[0] == "Trajectory of 6 members, float32, as jax_enable_x64 is off: q (6, 5), and qdot"


def test_results_of_the_analysis_read_as_sentences():
    pendulum = PENDULUM
    same = lagjax.same_motion(pendulum, pendulum, 0.5, 0.1)
    assert str(same).startswith("The same motions: E_a = 1 E_b; ")
    other = lagjax.same_motion(pendulum, FREE, 0.5, 0.1)
    assert str(other).startswith("Other motions: with the best factor") and "the equation of q at q" in str(other)
    assert repr(list(lagjax.conserved_quantities(pendulum, 0.5, 0.1))) == "[Conserved('energy')]"
    assert str(lagjax.equilibrium(pendulum, 0.1)) == "Equilibrium at q = 0"
    found = lagjax.results.Equilibrium({"x": np.array([0.0, -1.0])}, {"rod": np.array(0.5)}, np.array(True))
    assert str(found) == "Equilibrium at q['x'][0] = 0, q['x'][1] = -1; multipliers['rod'] = 0.5"
    assert str(lagjax.linearize(pendulum, 0.0)) == "δq'' = -1 δq +1 u"


@pytest.mark.slow
def test_results_of_motions_read_as_sentences():
    pendulum = PENDULUM
    assert str(lagjax.lyapunov_exponent(pendulum, 0.5, 0.0, 5.0)).startswith("Lyapunov exponent -0.0")
    path = lagjax.find_path(pendulum, 0.0, 0.5, 0.0, 1.0)
    assert repr(path).startswith("Path: action 1.08090018, a minimum among nearby paths, 0 conjugate times")
    along = lagjax.family(pendulum, lagjax.periodic_orbit(pendulum, 0.5, 0.0, 6.3), count=3)
    assert repr(along).startswith("Family of 3 orbits, 3 of them stable\nfrom -0.88") and "array" not in repr(along)


OF_A_PLACE = lagjax.System(lambda q, v: 0.5 * v.x**2)


def test_an_integer_of_params_and_an_unknown_dataclass_are_explained():
    with pytest.raises(TypeError) as error:
        lagjax.simulate(COUNTED, 1.0, 0.0, np.array([0.0, 1.0]), {"n": 3})
    assert "let the function close over that integer" in str(error.value)

    @dataclasses.dataclass
    class Place:
        x: float

    with pytest.raises(TypeError, match=r"call jax.tree_util.register_dataclass\(Place\) once"):
        lagjax.simulate(OF_A_PLACE, Place(1.0), Place(0.0), np.array([0.0, 1.0]))


def test_results_are_printed_by_name(fallen):
    assert repr(fallen.result) == "lagjax.RESULTS<2 successful, 2 dt_min_reached, 2 nonfinite_state>"
    assert repr(lagjax.RESULTS.successful) == "lagjax.RESULTS<successful>"
    assert repr(lagjax.RESULTS.zeno).startswith("lagjax.RESULTS<") and pickle.loads(pickle.dumps(lagjax.RESULTS.zeno))


NAMED = lagjax.System(lambda q, v: 0.5 * v["x"] ** 2)


def test_a_canonical_motion():
    motion = lagjax.hamiltonian(NAMED).simulate({"x": 0.0}, {"x": 1.0}, TS)
    assert lines(motion) == [
        "CanonicalTrajectory, float64: q['x'] (5,), and p", "t from 0 to 2 at 5 outputs", "reached the end",
    ]  # fmt: skip
    assert repr(jax.tree.map(lambda _: 0, motion)) == "CanonicalTrajectory(0, {'x': 0}, {'x': 0}, 0)"
