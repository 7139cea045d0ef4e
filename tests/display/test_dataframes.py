"""A trajectory as a table and as labelled arrays: the numbers of the motion, under the names of its pytree."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import FREE, RAMP

import lagjax

pytest.importorskip("pandas")
pytest.importorskip("xarray")

TS = np.linspace(0.0, 1.0, 5)
SCENE = lagjax.System(lambda q, v: 0.5 * v["x"] ** 2 + 0.5 * v["y"] @ v["y"] - 0.5 * q["x"] ** 2)
START = {"x": 1.0, "y": np.array([1.0, 2.0])}, {"x": 0.0, "y": np.array([0.0, 1.0])}
UNITS = {"x": "rad", "y": None}


@pytest.fixture(scope="module")
def run():
    return lagjax.simulate(SCENE, *START, TS)


@pytest.fixture(scope="module")
def batch():
    many = jax.tree.map(lambda x: jnp.stack([x, 2 * x, 3 * x]), START)
    return lagjax.simulate_batch(SCENE, *many, TS)


def test_columns_are_named_as_messages_name_them(run):
    table = run.to_pandas()
    assert list(table.columns) == ["q['x']", "q['y'][0]", "q['y'][1]", "qdot['x']", "qdot['y'][0]", "qdot['y'][1]"]
    np.testing.assert_array_equal(table.index, TS)
    np.testing.assert_array_equal(table["q['x']"], run.q["x"])
    np.testing.assert_array_equal(table["qdot['y'][1]"], run.qdot["y"][:, 1])
    assert table.attrs == {} and table.index.name == "t"
    one = lagjax.simulate(FREE, 0.0, 1.0, TS).to_pandas()
    assert list(one.columns) == ["q", "qdot"]


def test_a_batch_has_its_members_first(batch):
    table = batch.to_pandas()
    assert table.index.names == ["member", "t"] and len(table) == 15
    np.testing.assert_array_equal(table.loc[2]["qdot['y'][1]"], batch.qdot["y"][2, :, 1])
    np.testing.assert_array_equal(table.xs(0.5, level="t")["q['x']"], batch.q["x"][:, 2])


def test_units(run):
    table, arrays = run.to_pandas(UNITS, "s"), run.to_xarray(UNITS, "s")
    assert table.attrs["units"] == {"q['x']": "rad", "qdot['x']": "rad/s", "t": "s"}
    assert arrays["q.x"].attrs == {"units": "rad"} and arrays["qdot.x"].attrs == {"units": "rad/s"}
    assert arrays["q.y"].attrs == {} and arrays["time"].attrs == {"units": "s"}
    np.testing.assert_array_equal(arrays["q.y"], run.q["y"])
    assert set(run.to_pandas("m").attrs["units"].values()) == {"m"}  # for all; of velocities it is not known
    with pytest.raises(ValueError, match=r"does not fit the structure of q.*q\['x'\], q\['y'\]"):
        run.to_pandas({"theta": "rad"})
    with pytest.raises(TypeError, match="A unit must be text"):
        run.to_xarray({"x": 1, "y": None})
    with pytest.raises(TypeError, match="time_unit must be text"):
        run.to_pandas(time_unit=1)


def test_batches_of_batches_and_times_of_their_own():
    free = FREE
    run = jax.vmap(lambda size: lagjax.simulate_batch(free, jnp.zeros(3), jnp.ones(3), TS * size))(np.arange(1.0, 3.0))
    table, arrays = run.to_pandas(), run.to_xarray()
    assert table.index.names == ["member_0", "member_1", "t"] and len(table) == 30
    np.testing.assert_allclose(table["q"], table.index.get_level_values("t"))
    assert arrays.sizes == {"member_0": 2, "member_1": 3, "time": 5}
    np.testing.assert_allclose(arrays["q"], arrays["t"])


@pytest.mark.slow
def test_hybrid_motions_have_their_modes_by_name():
    bounce = lagjax.Transition("fall", "rest", guard=lambda q, v: q, direction=-1, reset=lambda q, v: (q, 0 * v))
    modes = {"fall": RAMP, "rest": FREE}
    run = lagjax.simulate(lagjax.Hybrid(modes, [bounce], "fall"), 0.25, 0.0, TS)
    assert list(run.to_pandas()["mode"]) == ["fall"] * 3 + ["rest"] * 2


@pytest.mark.parametrize("package", ["pandas", "xarray"])
def test_without_the_package_it_says_what_to_install(run, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"to_{package}\(\) needs the package {package}: pip install {package}"):
        getattr(run, f"to_{package}")()


# A plate that strikes the floor at t = 1 with e = ½, again at 2, and then flies on; one wall, which it never meets.
STRUCK = lagjax.System(
    lambda q, v: 0.5 * v @ v - 2 * q[1],
    contacts=lambda q: {"floor": q[1], "walls": jnp.stack([9 - q[0]])},
    restitution=0.5,
)
BLOCK = lagjax.System(
    lambda q, v, params: 0.5 * v @ v - q[1] - params * q[0], contacts=lambda q: q[1], slip=lambda q, v: v[0],
    friction=0.5,
)  # fmt: skip


@pytest.fixture(scope="module")
def struck():
    start = jnp.array([[0.0, 1.0], [0.0, 0.25]]), jnp.zeros((2, 2))
    alone = lagjax.simulate(STRUCK, start[0][0], start[1][0], jnp.linspace(0.0, 4.0, 5))
    return alone, lagjax.simulate_batch(STRUCK, *start, jnp.linspace(0.0, 2.2, 3))


def test_contacts_have_columns_and_tables_of_their_own(struck):
    run, batch = struck
    table, arrays, impacts = run.to_pandas(), run.to_xarray(), run.impacts.to_pandas()
    assert list(table.columns)[4:] == ["contact_forces['floor']", "contact_forces['walls'][0]"]
    np.testing.assert_allclose(table["contact_forces['floor']"], [0, 0, 0, 2, 2], atol=1e-12)  # rests from 3 on
    np.testing.assert_array_equal(arrays["contact_forces.floor"], run.contact_forces["floor"])
    assert list(impacts.columns) == ["impulse['floor']", "impulse['walls'][0]", "energy_lost"]
    assert len(impacts) == run.impacts.count and impacts.index.name == "t"
    np.testing.assert_allclose(impacts["impulse['floor']"].iloc[:2], [3.0, 1.5], rtol=1e-12)
    np.testing.assert_allclose(impacts.index[:2], [1.0, 2.0], rtol=1e-12)
    changes = run.contact_changes.to_pandas()
    assert list(changes["change"])[:2] == ["bounces"] * 2 and changes["change"].iloc[-1] == "closes"
    assert set(changes["contact"]) == {"contacts['floor']"}
    np.testing.assert_allclose(changes[["qdot[1]", "qdot_next[1]"]].iloc[0], [-2.0, 1.0], rtol=1e-12)
    of_batch = batch.impacts.to_pandas()
    assert of_batch.index.names == ["member", "t"]
    np.testing.assert_allclose(of_batch.loc[1].index[:3], [0.5, 1.0, 1.25], rtol=1e-12)
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda impacts: impacts.to_pandas())(run.impacts)


def test_changes_and_impacts_print_in_words(struck):
    run, batch = struck
    lines = repr(run.contact_changes).splitlines()
    assert lines[0] == f"{run.contact_changes.count} changes of contacts:" and len(lines) == 12
    text = "t = 1          contacts['floor'] bounces: its gap is 0; impulse 3 at contacts['floor']"
    assert lines[1].strip() == text and lines[-1].endswith("more)")
    assert repr(run.impacts).startswith(f"{run.impacts.count} impacts, at t = 1, 2, 2.5,")
    assert repr(batch.contact_changes).endswith(" changes of contacts of 2 motions")
    assert "which took an energy of 2 away" in str(run.health())


def test_changes_say_what_vanished_and_which_guess_was_taken_back():
    """A block slides up a slope, stops and stays; where that is steeper than friction holds it slides at once."""
    for slope, speed, last in (
        (0.2, 0.7, "t = 1          contacts sticks: its slip is 0"),
        (0.7, 0.0, "t = 0          contacts slides: its friction left would fall below 0 at once"),
    ):
        run = lagjax.simulate(BLOCK, np.zeros(2), np.array([speed, 0.0]), np.array([0.0, 2.0]), slope)
        assert [line.strip() for line in repr(run.contact_changes).splitlines()[1:]] == [
            "t = 0          contacts closes: its gap is 0", last
        ]  # fmt: skip


def test_a_picture_marks_impacts(struck):
    plot = pytest.importorskip("matplotlib") and lagjax.plot
    for run in struck:
        ax = plot.trajectory(run)
        closed = ["contacts['floor']"] * (run.ok.size == 1)  # the times at which it is, of one motion
        texts = [text.get_text() for text in ax.get_legend().get_texts()]
        assert texts == ["q[0]", "q[1]", *closed, "impact['floor']"]
        assert len(ax.lines[-1].get_xdata()) == np.sum(run.impacts.count)
    assert len(plot.trajectory(struck[0], lambda q: (q[0], q[1])).lines) == 1
