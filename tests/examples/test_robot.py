"""The example that reads a robot: against closed forms, against pinocchio, and what it says of files that are none."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

ROD = '<inertial><origin xyz="{c} 0 0"/><mass value="{m}"/><inertia ixx="0" iyy="{I}" izz="{I}"/></inertial>'
TWO = f"""<robot name="two"><link name="wall"/>
<link name="a">{ROD.format(c=0.4, m=2.0, I=0.1)}</link><link name="b">{ROD.format(c=0.3, m=1.5, I=0.05)}</link>
<joint name="shoulder" type="revolute"><parent link="wall"/><child link="a"/><axis xyz="0 -2 0"/></joint>
<joint name="elbow" type="revolute"><parent link="a"/><child link="b"/>
<origin xyz="0.9 0 0"/><axis xyz="0 -1 0"/></joint></robot>"""


@pytest.fixture
def robot(monkeypatch, request):
    monkeypatch.syspath_prepend(str(request.config.rootpath / "examples"))
    return importlib.import_module("robot")


def test_two_links_in_the_plane(robot):
    """M, the bias and where the elbow is, as every textbook has them (angles up from the horizontal)."""
    arm = robot.read(TWO)
    scene, params = robot.system(arm), robot.parameters(arm)
    (a, b), (da, db) = q, qdot = np.array([0.4, -0.9]), np.array([1.1, 0.6])
    m, M, l, r, s, I, J, g = 2.0, 1.5, 0.9, 0.4, 0.3, 0.1, 0.05, robot.G
    far, cross = J + M * s**2, M * l * s * np.cos(b)
    mass = np.array([[I + m * r**2 + far + M * l**2 + 2 * cross, far + cross], [far + cross, far]])
    h, tip = M * l * s * np.sin(b), M * s * g * np.cos(a + b)
    bias = np.array([-h * (2 * da * db + db**2) + (m * r + M * l) * g * np.cos(a) + tip, h * da**2 + tip])
    np.testing.assert_allclose(scene.mass_matrix(q, qdot, params=params), mass, rtol=1e-14)
    np.testing.assert_allclose(robot.bias(arm, q, qdot, params), bias, rtol=1e-13)
    exact = np.linalg.solve(mass, -bias)
    np.testing.assert_allclose(scene.acceleration(q, qdot, params=params), exact, rtol=1e-13)
    np.testing.assert_allclose(robot.place(arm, q, "b")[1], [l * np.cos(a), 0, l * np.sin(a)], atol=1e-15)


def malformed(**changes):
    text = TWO
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new, 1)
    return text


LOOP = '<joint name="again" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
ISLAND = """<link name="c"/><link name="d"/><joint name="e" type="fixed"><parent link="c"/><child link="d"/></joint>
<joint name="f" type="fixed"><parent link="d"/><child link="c"/></joint></robot>"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (ROD.format(c=0.3, m=1.5, I=0.05), "", "link 'b' moves by the joint 'elbow', but neither it nor what it carr"),
        ('type="revolute"', 'type="floating"', "joint 'shoulder' is 'floating'; joints here are fixed, revolute,"),
        ('<link name="wall"/>', '<link name="wall"/><link name="moon"/>', "2 links that no joint carries, ['wall', 'm"),
        ("</robot>", LOOP, "link 'a' hangs on several joints, ['shoulder', 'again']"),
        ("</robot>", ISLAND, "The links ['c', 'd'] carry each other in a loop, apart from 'wall'"),
        ('<child link="b"/>', '<child link="hand"/>', "joint 'elbow': there is no link 'hand', its child"),
        ('<child link="b"/>', "", "joint 'elbow': there is no link None, its child"),
        ('xyz="0.9 0 0"', 'xyz="0.9 0"', "joint 'elbow': xyz must be 3 finite numbers, and is '0.9 0'"),
        ('<mass value="2.0"/>', "", "link 'a', <mass>: value must be a finite number, and is None"),
        ('<mass value="2.0"/>', '<mass value="-2"/>', "link 'a': the mass is negative, -2"),
        ('ixx="0" iyy="0.1"', 'ixx="9" iyy="0.1"', "no body has the principal moments of inertia 0.1, 0.1, 9"),
        ('xyz="0 -2 0"', 'xyz="0 0 0"', "joint 'shoulder': its axis is zero"),
        ("</robot>", "", "This is no XML: "),
        ("<robot", "<sdf", "This is no XML: mismatched tag"),
        (
            '<link name="wall"/>',
            "<xacro:arm/>",
            "These are macros, not yet URDF: `xacro robot.urdf.xacro > robot.urdf`",
        ),
        (TWO[TWO.index("<link") :], "</robot>", "The <robot> has no <link>."),
        ('name="elbow"', 'name="shoulder"', "Two joints have one name: ['shoulder']"),
        ('<axis xyz="0 -2 0"/>', '<dynamics friction="1"/>', "joint 'shoulder' has dry friction, which is not read"),
        ('<axis xyz="0 -2 0"/>', '<mimic joint="elbow"/>', "joint 'shoulder' mimics another joint: write that as"),
    ],
)
def test_what_is_no_robot_is_said_in_a_sentence(robot, old, new, said):
    with pytest.raises(ValueError) as error:
        robot.read(malformed(change=(old, new)))
    assert said in str(error.value) and str(error.value).endswith(".")


def random_robot(robot, links: int, seed: int) -> str:
    """A tree of bodies of positive density, with joints of every kind in general position."""
    rng, xml = np.random.default_rng(seed), ['<robot name="random"><link name="l0"/>']

    def text(numbers):
        return " ".join(f"{x:.17g}" for x in np.atleast_1d(numbers))

    for k in range(1, links + 1):
        spread = rng.normal(size=(3, 4)) / 10
        second = spread @ spread.T
        (xx, xy, xz), (_, yy, yz), (*_, zz) = np.trace(second) * np.eye(3) - second
        moments = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (xx, xy, xz, yy, yz, zz), strict=True)
        kind = (
            rng.choice(["revolute", "continuous", "prismatic", "fixed"], p=[0.4, 0.3, 0.2, 0.1])
            if k > 1
            else "revolute"
        )
        origin = f'<origin xyz="{text(rng.uniform(-0.5, 0.5, 3))}" rpy="{text(rng.uniform(-3, 3, 3))}"/>'
        xml.append(
            f'<link name="l{k}"><inertial><origin xyz="{text(rng.uniform(-0.2, 0.2, 3))}" '
            f'rpy="{text(rng.uniform(-3, 3, 3))}"/><mass value="{text(rng.uniform(0.5, 2))}"/>'
            f'<inertia {" ".join(f"""{name}="{text(value)}" """ for name, value in moments)}/></inertial></link>'
            f'<joint name="j{rng.integers(10**9)}" type="{kind}"><parent link="l{rng.integers(k)}"/>'
            f'<child link="l{k}"/>{origin}<axis xyz="{text(rng.normal(size=3))}"/>'
            f'<limit lower="-3" upper="3" effort="1" velocity="1"/>'
            f'<dynamics damping="{text(rng.uniform(0, 0.2))}"/></joint>'
        )
    return "".join([*xml, "</robot>"])


@pytest.mark.slow
@pytest.mark.parametrize("links", [2, 3, 5, 8, 12])
def test_random_trees_are_those_of_pinocchio(robot, links):
    pytest.importorskip("pinocchio")
    source = random_robot(robot, links, seed=links)
    tree = robot.read(source)
    differences = robot.differences(tree, robot.Pinocchio(source, tree), draws=5)
    # Accelerations by both carry the rounding of M times its condition, which was below 1e3 for these.
    assert differences["mass matrix"] < 1e-13 and differences["bias"] < 1e-13 and differences["acceleration"] < 1e-12


@pytest.mark.slow
def test_the_example_conserves_energy_and_differentiates(robot):
    arm = robot.read(robot.ARM)
    lossless = arm._replace(joints=tuple(joint._replace(damping=0.0) for joint in arm.joints))
    scene, params = robot.system(lossless), robot.parameters(arm)
    starts, ts = np.random.default_rng(0).uniform(-1, 1, (3, 7)), np.linspace(0.0, 0.5, 6)
    batch = lagjax.simulate_batch(scene, starts, np.ones_like(starts), ts, params)
    assert bool(batch.ok.all())
    # Local errors of 1e-9 of the state over some 25 steps, of an energy of some 100 J with masses of up to 20 kg.
    assert float(jnp.ptp(batch.energy(), axis=1).max()) < 1e-5

    def height(mass):
        heavier = params | {"tool": params["tool"]._replace(mass=mass)}
        motion = lagjax.simulate(scene, starts[0], jnp.ones(7), ts, heavier, rtol=1e-12)
        return robot.place(lossless, motion.q[-1], "tool")[1][2]

    step = 1e-4
    difference = (height(0.6 + step) - height(0.6 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(height)(0.6), difference, rtol=1e-6)


@pytest.mark.slow
def test_the_example_runs(robot, capsys):
    tree, batch, slopes = robot.main(["--members", "8", "--duration", "0.1"])
    assert [joint.name for joint in tree.moving][:2] == ["lift", "yaw"] and bool(batch.ok.all())
    assert set(slopes) == set(tree.bodies) and np.isfinite(slopes["tool"].mass).all()
    printed = capsys.readouterr().out
    assert "8 of 8 reached the end" in printed and "a kilogram more moves it by" in printed
