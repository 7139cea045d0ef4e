"""A robot from a file: a tree of links in URDF becomes L(q, q̇), and with it motions, batches and gradients.

Every joint carries one link on another. Velocities are built link by link in the axes of each link,

    ω = Rᵀ ω′ + a q̇,     v = Rᵀ (v′ + ω′ × r)         (revolute; a prismatic joint adds a q̇ to v)

with R, r the place of the link on the one that carries it. The energy is that of the links' bodies. Because one
velocity is made from another, lagjax finds the recursion: accelerations cost O(n), as by articulated bodies.

q has one number per moving joint, in the order of `Robot.moving`. Joints are fixed, revolute, continuous or prismatic;
damping is read, limits are not. `parameters(robot)` holds masses, centres and inertias by the name of the link: traced
and differentiable. Where `pinocchio` is installed (`pip install pin`) its mass matrix, bias and accelerations stand
beside ours; it is the better tool for one evaluation of a known robot.

python examples/robot.py [robot.urdf]
"""

import argparse
import importlib.util
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

ARM = Path(__file__).parent / "robot_arm.urdf"
G = 9.81
MOVING = ("revolute", "continuous", "prismatic")


class Joint(NamedTuple):
    """`child` stands at `offset` (3,) with axes `rotation` (3, 3) on `parent`, and moves along or about `axis` (3,)."""

    name: str
    kind: str
    parent: str
    child: str
    rotation: np.ndarray
    offset: np.ndarray
    axis: np.ndarray
    damping: float


class Body(NamedTuple):
    """Mass, its centre (3,), and the moments of inertia (3, 3) about that, in the axes of the link."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


class Robot(NamedTuple):
    """A tree: joints, each after those that carry it, and bodies by the name of the link."""

    name: str
    root: str
    joints: tuple[Joint, ...]
    bodies: dict[str, Body]

    @property
    def moving(self) -> list[Joint]:
        """The joints that have a coordinate, in the order of q."""
        return [joint for joint in self.joints if joint.kind in MOVING]


# ---- the file ----------------------------------------------------------------------------------------------------


def read(source: str | Path) -> Robot:
    """The robot in a file, or in a string that holds the XML itself. Raises `ValueError` for what it cannot be."""
    text = source if isinstance(source, str) and source.lstrip().startswith("<") else Path(source).read_text()
    if "<xacro:" in text:
        raise ValueError("These are macros, not yet URDF: `xacro robot.urdf.xacro > robot.urdf` writes them out.")
    try:
        tree = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"This is no XML: {error}.") from None
    if tree.tag != "robot":
        raise ValueError(f"A URDF file holds a <robot>; this one holds a <{tree.tag}>.")
    for tag in ("link", "joint"):
        names = [_name(element) for element in tree.findall(tag)]
        if len(set(names)) < len(names):
            raise ValueError(f"Two {tag}s have one name: {sorted({name for name in names if names.count(name) > 1})}.")
    links = [_name(link) for link in tree.findall("link")]
    if not links:
        raise ValueError("The <robot> has no <link>.")
    bodies = {_name(link): _body(link) for link in tree.findall("link") if link.find("inertial") is not None}
    joints = [_joint(joint, links) for joint in tree.findall("joint")]
    root, ordered = _in_order(links, joints)
    robot = Robot(tree.get("name", "robot"), root, ordered, bodies)
    _require_masses(robot)
    return robot


def _name(element) -> str:
    if not element.get("name"):
        raise ValueError(f"A <{element.tag}> has no name.")
    return element.get("name")


def _numbers(element, key: str, default: str | None, where: str, count: int = 3) -> np.ndarray:
    text = default if element is None else element.get(key, default)
    try:
        numbers = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ValueError(f"{where}: {key} must be {wanted}, and is {text!r}.")
    return numbers


def _place(element, where: str) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and the offset of an <origin>, if any: angles about the fixed axes x, then y, then z."""
    origin = element.find("origin")
    (sr, sp, sy), (cr, cp, cy) = (f(_numbers(origin, "rpy", "0 0 0", where)) for f in (np.sin, np.cos))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x, _numbers(origin, "xyz", "0 0 0", where)


def _body(link) -> Body:
    where, inertial = f"link {_name(link)!r}", link.find("inertial")
    rotation, centre = _place(inertial, where)
    (mass,) = _numbers(inertial.find("mass"), "value", None, f"{where}, <mass>", 1)
    if mass < 0:
        raise ValueError(f"{where}: the mass is negative, {mass:g}.")
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    xx, xy, xz, yy, yz, zz = (_numbers(inertial.find("inertia"), key, "0", where, 1)[0] for key in names)
    inertia = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    least = np.linalg.eigvalsh(inertia)
    # Principal moments of a body satisfy A ≤ B + C; six digits are what such files are written with.
    if least[0] < -1e-6 * least[2] or least[2] > (1 + 1e-6) * (least[0] + least[1]):
        moments = ", ".join(f"{moment:.3g}" for moment in least)
        raise ValueError(f"{where}: no body has the principal moments of inertia {moments}.")
    return Body(float(mass), centre, inertia)


def _joint(element, links: list[str]) -> Joint:
    name, kind = _name(element), element.get("type", "")
    where = f"joint {name!r}"
    if kind not in (*MOVING, "fixed"):
        raise ValueError(f"{where} is {kind!r}; joints here are fixed, {', '.join(MOVING[:-1])} or {MOVING[-1]}.")
    if element.find("mimic") is not None:
        raise ValueError(f"{where} mimics another joint: write that as a constraint of the System.")
    ends = [(element.find(tag) if element.find(tag) is not None else {}).get("link") for tag in ("parent", "child")]
    for tag, end in zip(("parent", "child"), ends, strict=True):
        if end not in links:
            raise ValueError(f"{where}: there is no link {end!r}, its {tag}.")
    rotation, offset = _place(element, where)
    axis = _numbers(element.find("axis"), "xyz", "1 0 0", where)
    if kind in MOVING and not axis.any():
        raise ValueError(f"{where}: its axis is zero.")
    dynamics = element.find("dynamics")
    (damping,), (friction,) = (_numbers(dynamics, key, "0", where, 1) for key in ("damping", "friction"))
    if friction:
        raise ValueError(f"{where} has dry friction, which is not read: give it as `forces=` to System, by `jnp.sign`.")
    return Joint(name, kind, *ends, rotation, offset, axis / (np.linalg.norm(axis) or 1.0), float(damping))


def _in_order(links: list[str], joints: list[Joint]) -> tuple[str, tuple[Joint, ...]]:
    """The link that nothing carries, and the joints from there outward. Raises where that is no tree."""
    children = [joint.child for joint in joints]
    for child in children:
        if children.count(child) > 1:
            both = [joint.name for joint in joints if joint.child == child]
            raise ValueError(f"link {child!r} hangs on several joints, {both}: a loop is a constraint of the System.")
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        if not roots:
            raise ValueError("Every link is carried by another one: the joints form a loop, and nothing stands still.")
        raise ValueError(f"There are {len(roots)} links that no joint carries, {roots}; one of them stands still.")
    ordered, reached = [], [roots[0]]
    for link in reached:  # which grows
        here = [joint for joint in joints if joint.parent == link]
        ordered += here
        reached += [joint.child for joint in here]
    if lost := [link for link in links if link not in reached]:
        raise ValueError(f"The links {lost} carry each other in a loop, apart from {roots[0]!r}.")
    return roots[0], tuple(ordered)


def _require_masses(robot: Robot):
    if not robot.moving:
        raise ValueError(f"Nothing of {robot.name!r} moves: it has no joint of a kind in {MOVING}.")
    carried = {name: body.mass for name, body in robot.bodies.items()}
    for joint in reversed(robot.joints):
        mass = carried.get(joint.child, 0.0)
        if joint.kind in MOVING and not mass:
            raise ValueError(
                f"link {joint.child!r} moves by the joint {joint.name!r}, but neither it nor what it carries has mass: "
                "give it an <inertial>, or make the joint fixed."
            )
        carried[joint.parent] = carried.get(joint.parent, 0.0) + mass


# ---- the scene ---------------------------------------------------------------------------------------------------


def parameters(robot: Robot) -> dict[str, Body]:
    """The bodies by the name of their links, as arrays: what `params` of the scene is."""
    moved = {joint.child for joint in robot.joints}
    return {name: jax.tree.map(jnp.asarray, body) for name, body in robot.bodies.items() if name in moved}


def system(robot: Robot) -> lagjax.System:
    """The scene; q (n,) in the order of `robot.moving`, gravity along −z, `params` as `parameters(robot)`."""
    damping = np.array([joint.damping for joint in robot.moving])
    dissipation = (lambda q, qdot: 0.5 * damping @ qdot**2) if damping.any() else None
    return lagjax.System(_lagrangian(robot), dissipation=dissipation)


def _lagrangian(robot: Robot) -> Callable:
    def L(q, qdot, params):
        still = jnp.zeros(3)
        # Of every link, in its own axes: angular velocity, velocity of its origin, the vertical; and its height.
        state, total, k = {robot.root: (still, still, jnp.array([0.0, 0.0, 1.0]), 0.0)}, 0.0, 0
        for joint in robot.joints:
            omega, v, up, height = state[joint.parent]
            R, r = _moved(joint, q[k] if joint.kind in MOVING else None)
            height, up = height + up @ r, R.T @ up
            v, omega = R.T @ (v + jnp.cross(omega, r)), R.T @ omega
            if joint.kind == "prismatic":
                v = v + joint.axis * qdot[k]
            elif joint.kind in MOVING:
                omega = omega + joint.axis * qdot[k]
            k += joint.kind in MOVING
            state[joint.child] = omega, v, up, height
            if joint.child in params:
                mass, centre, inertia = params[joint.child]
                w = v + jnp.cross(omega, centre)
                total += 0.5 * mass * (w @ w) + 0.5 * omega @ (inertia @ omega) - mass * G * (height + up @ centre)
        return total

    return L


def _moved(joint: Joint, x) -> tuple:
    """Rotation and offset of the child on its parent, with the joint at x."""
    if joint.kind == "fixed":
        return joint.rotation, joint.offset
    if joint.kind == "prismatic":
        return joint.rotation, joint.offset + joint.rotation @ joint.axis * x
    a = joint.axis
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return joint.rotation @ (
        np.outer(a, a) + jnp.cos(x) * (np.eye(3) - np.outer(a, a)) + jnp.sin(x) * cross
    ), joint.offset


def place(robot: Robot, q, link: str) -> tuple[jax.Array, jax.Array]:
    """Where a link is in space: its axes (3, 3), as columns, and its origin (3,)."""
    places, k = {robot.root: (jnp.eye(3), jnp.zeros(3))}, 0
    for joint in robot.joints:
        axes, origin = places[joint.parent]
        R, r = _moved(joint, q[k] if joint.kind in MOVING else None)
        k += joint.kind in MOVING
        places[joint.child] = axes @ R, origin + axes @ r
    return places[link]


def bias(robot: Robot, q, qdot, params):
    """What holds q̈ at zero, without damping: centrifugal, Coriolis and gravity forces, (n,)."""
    L = _lagrangian(robot)
    momentum_rate = jax.jvp(lambda q: jax.grad(L, 1)(q, qdot, params), (q,), (qdot,))[1]
    return momentum_rate - jax.grad(L)(q, qdot, params)


# ---- pinocchio beside it -----------------------------------------------------------------------------------------


class Pinocchio:
    """The same robot in pinocchio, which has joints in another order and cos, sin of a continuous joint for its q."""

    def __init__(self, source: str | Path, robot: Robot):
        import pinocchio

        text = source if str(source).lstrip().startswith("<") else Path(source).read_text()
        self.pin, self.model = pinocchio, pinocchio.buildModelFromXML(text)
        self.model.gravity.linear = np.array([0.0, 0.0, -G])
        self.data = self.model.createData()
        joints = [self.model.joints[self.model.getJointId(joint.name)] for joint in robot.moving]
        self.at_q, self.circular = [joint.idx_q for joint in joints], np.array([joint.nq == 2 for joint in joints])
        self.order = np.array([joint.idx_v for joint in joints])
        self.damping = np.array([joint.damping for joint in robot.moving])

    def _state(self, q, *vectors):
        theirs = np.zeros(self.model.nq)
        for x, i, circular in zip(np.asarray(q), self.at_q, self.circular, strict=True):
            theirs[i : i + 1 + circular] = (np.cos(x), np.sin(x)) if circular else x
        placed = np.zeros((len(vectors), len(self.order)))
        for ours, row in zip(vectors, placed, strict=True):
            row[self.order] = ours
        return theirs, *placed

    def mass_matrix(self, q):
        """M (n, n), in our order."""
        M = self.pin.crba(self.model, self.data, *self._state(q))
        return (np.triu(M) + np.triu(M, 1).T)[np.ix_(self.order, self.order)]

    def bias(self, q, qdot):
        """Its `nle`, in our order."""
        return self.pin.nle(self.model, self.data, *self._state(q, qdot))[self.order]

    def forces(self, q, qdot, qddot):
        """τ by its recursive Newton–Euler algorithm, with what the damping of the file takes."""
        return self.pin.rnea(self.model, self.data, *self._state(q, qdot, qddot))[self.order] + self.damping * qdot

    def acceleration(self, q, qdot):
        """q̈ by its articulated-body algorithm, with the damping of the file."""
        return self.pin.aba(self.model, self.data, *self._state(q, qdot, -self.damping * qdot))[self.order]


def differences(robot: Robot, theirs: Pinocchio, draws: int = 20) -> dict[str, float]:
    """The largest differences from pinocchio over random states, relative to the largest entry of each state."""
    scene, params, rng = system(robot), parameters(robot), np.random.default_rng(0)
    force = jax.jit(lambda q, qdot: bias(robot, q, qdot, params))
    worst = {"mass matrix": 0.0, "bias": 0.0, "acceleration": 0.0}
    for q, qdot in rng.uniform(-1.5, 1.5, (draws, 2, len(robot.moving))):
        pairs = {
            "mass matrix": (scene.mass_matrix(q, qdot, params=params), theirs.mass_matrix(q)),
            "bias": (force(q, qdot), theirs.bias(q, qdot)),
            "acceleration": (scene.acceleration(q, qdot, params=params), theirs.acceleration(q, qdot)),
        }
        for name, (ours, other) in pairs.items():
            worst[name] = max(worst[name], float(np.abs(np.asarray(ours) - other).max() / np.abs(other).max()))
    return worst


def beside_pinocchio(robot: Robot, theirs: Pinocchio, trajectories, starts, duration: float, spent: float):
    """Prints what a motion costs by pinocchio and SciPy on one core, beside one of the batch; both at rtol = 1e-9."""
    from scipy.integrate import solve_ivp

    n, few = len(robot.moving), range(4)

    def field(t, y):
        return np.concatenate([y[n:], theirs.acceleration(y[:n], y[n:])])

    began = time.perf_counter()
    runs = [
        solve_ivp(field, (0.0, duration), np.append(starts[i], np.zeros(n)), "DOP853", rtol=1e-9, atol=1e-12)
        for i in few
    ]
    each = (time.perf_counter() - began) / len(runs)
    state, one = theirs._state(starts[0], np.zeros(n), np.zeros(n)), theirs.pin.aba
    began = time.perf_counter()
    for _ in range(2000):
        one(theirs.model, theirs.data, *state)
    aba = (time.perf_counter() - began) / 2000
    calls = np.mean([run.nfev for run in runs])
    apart = max(np.abs(run.y[:n, -1] - trajectories.q[i, -1]).max() for i, run in zip(few, runs, strict=True))
    print(
        f"pinocchio in SciPy's DOP853, one core: {each * 1e3:.1f} ms, {each / spent:.0f} times ours, {apart:.0e} apart"
    )
    print(f"  its {calls:.0f} accelerations alone, {aba * 1e6:.1f} µs each: {calls * aba / spent:.1f} times our motion")


# ---- the main thing ----------------------------------------------------------------------------------------------


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "file", type=Path, nargs="?", default=ARM, help="a URDF file (default: the arm beside this one)"
    )
    parser.add_argument("--members", type=int, default=4096, help="motions in the batch (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=0.5, help="in seconds (default: %(default)s)")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    robot = read(options.file)
    scene, params, n = system(robot), parameters(robot), len(robot.moving)
    print(f"{robot.name}: {', '.join(f'{joint.name} ({joint.kind})' for joint in robot.moving)}")
    print(scene.explain(jnp.full(n, 0.3), jnp.ones(n), params=params))
    theirs = Pinocchio(options.file, robot) if importlib.util.find_spec("pinocchio") else None
    if theirs:
        for name, difference in differences(robot, theirs).items():
            print(f"{name:<13} differs from pinocchio by {difference:.0e}")

    ts = jnp.linspace(0.0, options.duration, 51)
    starts = np.random.default_rng(1).uniform(-1.0, 1.0, (options.members, n))

    def fall():
        return lagjax.simulate_batch(scene, starts, np.zeros_like(starts), ts, params)

    batch = fall()
    began = time.perf_counter()
    jax.block_until_ready(fall().q)
    spent = (time.perf_counter() - began) / options.members
    print(batch)
    print(f"{spent * 1e6:.0f} µs each, by all cores together")
    if theirs:
        beside_pinocchio(robot, theirs, batch, starts, options.duration, spent)

    tip = robot.joints[-1].child

    def end(params):
        motion = lagjax.simulate(scene, starts[0], jnp.zeros(n), ts, params)
        return place(robot, motion.q[-1], tip)[1]

    slopes = jax.jacobian(end)(params)
    print(f"after {options.duration:g} s {tip!r} is at {np.round(end(params), 4)} m; a kilogram more moves it by")
    for name, slope in slopes.items():
        print(f"  {name:<12}{np.round(slope.mass * 1e3, 3)} mm")
    return robot, batch, slopes


if __name__ == "__main__":
    main()
