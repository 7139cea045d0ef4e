"""`Arcs`: integrates many motions over different times, with their derivatives, in NumPy arrays of R rows.

Shooting needs: from starts (R, 2n), each with a first and a last time, the last states (R, 2n), and their derivatives
by the starts (R, 2n, 2n) and along directions of the parameters (R, 2n, F). Machine code integrates all directions over
the steps of the motion, without a program of XLA, so that another number of rows compiles nothing, and no kernel of
LAPACK runs inside of one.
"""

import copy
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._analysis._scene_state import require_matrices
from lagjax._analysis.orbits._jumping_motions import JumpingMotions
from lagjax._engine import Problem
from lagjax._engine.taylor import MachineCode, Motions, flow_of, jvp, tolerances_of
from lagjax._equations import Sample, Scales, has_constraints
from lagjax._interface import SUCCESSFUL, Layout, as_arrays, halves, require_concrete, require_finite, require_number
from lagjax._primitives import sentence
from lagjax._run.hybrid import Scene, first_law, list_laws, may_jump, require_scene
from lagjax._scene import drop_contacts, require_system


class Arc(NamedTuple):
    """R arcs: `end` (R, 2n), its time derivative `rate`, `by_start` (R, 2n, 2n), `by_params` (R, 2n, F), and results.

    `steps` (R,) counts steps; `result` (R,) and `t_end` (R,) are those of a `Solution`. Rows that failed are NaN.
    `returns` (R,): True if the arc ended in the mode in which it began.
    """

    end: np.ndarray
    rate: np.ndarray
    by_start: np.ndarray
    by_params: np.ndarray
    result: np.ndarray
    t_end: np.ndarray
    steps: np.ndarray
    returns: np.ndarray | bool = True

    @property
    def ok(self) -> np.ndarray:
        """True for each row that reached its last time, with finite derivatives, (R,)."""
        return (self.result == SUCCESSFUL) & np.isfinite(self.by_start).all(axis=(1, 2))


class Units(NamedTuple):
    """Units of states (R, 2n) and of times (R,), which make q and q̇ comparable.

    The unit of qᵢ is l/√Mᵢᵢ, l being `length` (R,), that of q̇ᵢ this per unit of time.
    """

    state: np.ndarray
    time: np.ndarray
    length: np.ndarray

    def repeat(self, count: int) -> "Units":
        return Units(*(np.repeat(x, count, axis=0) for x in self))

    def scale_growth(self, growth: np.ndarray) -> np.ndarray:
        """Convert derivatives of states by states, (R, …, 2n, 2n), to these units."""
        state = self.state.reshape(len(self.state), *[1] * (growth.ndim - 3), -1)
        return growth * state[..., None, :] / state[..., :, None]


def _positive_or_one(x: np.ndarray) -> np.ndarray:
    return np.where((x > 0) & np.isfinite(x), x, 1.0)


class Arcs:
    """Integrates motions of one scene with one set of parameters, `numbers` (P,)."""

    def __init__(self, problem: Problem, numbers: np.ndarray, jumping: JumpingMotions | None = None):
        self.problem, self.numbers, self.jumping = problem, numbers, jumping
        self.flow, self.tolerances = flow_of(problem), tolerances_of(problem)
        self.derivation, self.layout, self.size = problem.derivation.lowered, problem.layout, problem.layout.size
        named = {i for name in ("lagrangian", "mass_matrix", "force") for i in self.derivation.reads(name)}
        self.driven = 2 * self.size in named if jumping is None else jumping.driven  # by an explicit time
        self.conserves = not self.derivation.works and jumping is None

    @classmethod
    def from_system(
        cls, scene: Scene, layout: Layout, params: PyTree, rtol: float, what: str, jumps: bool = False
    ) -> "Arcs":
        """Return the arcs of a scene; `what` is for messages; contacts and modes are refused unless it `jumps`."""
        scene = require_scene(scene) if jumps else require_system(scene)
        jumping = JumpingMotions(scene, layout, params, rtol) if may_jump(scene) else None
        require_untraced((list_laws(scene), params), "A parameter")
        system = drop_contacts(first_law(scene))  # whose free motion is for units and charts
        if any(map(has_constraints, list_laws(scene))):
            raise ValueError(
                f"{what} cannot be found with constraints yet: give the scene coordinates that need none, angles of "
                "links instead of positions of their ends."
            )
        require_matrices(
            layout.size,
            what,
            "simulate follows such motions, and two runs of it that begin 1e-8 apart tell how fast motions part; give "
            "fewer coordinates for more.",
        )
        problem = Problem.from_system(system, layout, params, rtol=rtol, max_steps=_BUDGET)
        if refusal := MachineCode().refuses(problem):
            raise ValueError(f"{what} are found with machine code, and there is none for this scene: {refusal}.")
        return cls(problem, np.asarray(problem.vector), jumping)

    def with_numbers(self, numbers: np.ndarray) -> "Arcs":
        other = copy.copy(self)
        other.numbers = numbers
        return other

    def integrate(self, times: np.ndarray, y0: np.ndarray):
        """Integrate without derivatives, `times` (R, T) or (1, T) and `y0` (R, 2n): a `Solution` or `JumpRun`."""
        if self.jumping is not None:
            return self.jumping.run(times, y0)
        return self.flow.run(times, y0, self.numbers[None], self.tolerances)

    def divide_evenly(self, span: np.ndarray, y0: np.ndarray, count: int) -> np.ndarray:
        """Fractions (R, count + 1) that divide each span (R,) into parts with about equally many steps.

        A part begins where the state is small and changes slowly, if there is such a time nearby.
        """
        shares = np.tile(np.arange(count + 1) / count, (len(y0), 1))
        times = np.stack([np.zeros_like(span), span], axis=1)
        room = min(_BUDGET * len(y0), _MOST_WRITTEN // (y0.shape[1] + 4))
        run, found = self.flow.run_and_record(times, y0, self.numbers[None], self.tolerances, room)
        for row, table in (member for steps in found for member in steps.split_members()):
            if run.result[row] == SUCCESSFUL and len(table) >= 4 * count:
                begins, lengths = table[:, :2].T / span[row]
                near = np.array_split(np.arange(len(table)), 2 * count)[1:-1]  # halves of shares about their borders
                around = [np.append(a, b) for a, b in zip(near[::2], near[1::2], strict=True)]
                shares[row, 1:-1] = [begins[some[np.argmax(lengths[some])]] for some in around]
        return shares

    def differentiate(self, times: np.ndarray, y0: np.ndarray, directions: np.ndarray | None = None, modes=None) -> Arc:
        """Integrate from `y0` (R, 2n), in `modes` (R,), over `times` (R, 2), with derivatives: an `Arc`."""
        rows, states = y0.shape
        if self.jumping is not None:
            run = self.jumping.run(times, y0, modes, varies=True)
            back = run.modes[:, -1] == run.modes[:, 0]
            nothing = np.zeros((rows, states, 0))
            return Arc(run.y_end, run.rate, run.by_start, nothing, run.result, run.t_end, run.accepted, back)
        directions, params = np.zeros((0, len(self.numbers))) if directions is None else directions, self.numbers[None]
        run = self.flow.run(times, y0, params, self.tolerances)
        dy0 = np.zeros((rows, states + len(directions), states))
        dy0[:, :states] = np.eye(states)
        dparams = np.zeros((rows, states + len(directions), len(self.numbers)))
        dparams[:, states:] = directions
        well = run.result == SUCCESSFUL
        moved = np.full(dy0.shape, np.nan)
        if well.any():
            motions = Motions.from_solution(times, y0, params, run).select_members(np.flatnonzero(well))
            moved[well] = jvp(self.flow, motions, dy0[well], dparams[well], self.tolerances)[1]
        end = np.where(well[:, None], run.y_end, np.nan)
        by_start, by_params = np.split(np.swapaxes(moved, 1, 2), [states], axis=2)
        return Arc(end, self.rate(times[:, 1], end), by_start, by_params, run.result, run.t_end, run.accepted)

    def units(self, y0: np.ndarray, time: np.ndarray | None = None) -> "Units":
        """Return the units of states (R, 2n), from the largest coordinate and velocity in the metric of M.

        `time` (R,) is the unit of time; by default it is the ratio of states to their rates.
        """
        n = self.size
        mass = np.abs(self.sample(0.0, y0).quantities("mass_matrix")["mass_matrix"][:, np.arange(n), np.arange(n)])
        root = _positive_or_one(np.sqrt(np.where(mass > 0, mass, mass.max(axis=1, initial=0.0)[:, None])))
        far, fast, bend = (np.abs(x * root).max(axis=1) for x in (*halves(y0), halves(self.rate(0.0, y0))[1]))
        with np.errstate(all="ignore"):
            if time is None:
                length = np.where(far > 0, far, fast**2 / bend)
                rate = np.maximum(fast / length, np.sqrt(bend / length))
                for row in np.flatnonzero(~((length > 0) & (rate > 0) & np.isfinite(length * rate))):
                    scales = Scales.from_quantities(self._evaluate, *halves(y0[row]))  # which takes a hundred forces
                    length[row], rate[row] = np.abs(scales.q * root[row]).max(), 1 / scales.t
                rate = _positive_or_one(rate)
            else:
                rate = 2 * np.pi / time
                length = np.maximum(far, fast / rate)
        length = _positive_or_one(length)
        of_q = length[:, None] / root
        return Units(np.concatenate([of_q, rate[:, None] * of_q], axis=1), 1 / rate, length)

    def _evaluate(self, name: str, q: np.ndarray, qdot: np.ndarray) -> np.ndarray:
        return self.sample(0.0, np.concatenate([q, qdot], axis=1)).quantities(name)[name]

    def sample(self, t, y: np.ndarray) -> Sample:
        """Return a `Sample` of the scene at states (R, 2n) and times () or (R,)."""
        return Sample.from_states(self.derivation, y, np.broadcast_to(np.asarray(t, float), (len(y),)), self.numbers)

    def rate(self, t, y: np.ndarray) -> np.ndarray:
        """Return ẏ = (q̇, q̈), (R, 2n), at states (R, 2n) and times () or (R,)."""
        values = self.flow.general_program.evaluate_many([*y.T, t, *self.numbers])
        return np.concatenate([y[:, self.size :], values[: self.size].T], axis=1)

    def energy(self, t, y: np.ndarray) -> np.ndarray:
        """Return h = p·q̇ − L, (R,)."""
        of = self.sample(t, y).quantities("lagrangian", "momentum")
        return np.sum(of["momentum"] * halves(y)[1], axis=1) - of["lagrangian"].reshape(len(y))

    def energy_slope(self, y: np.ndarray) -> np.ndarray:
        """Return ∂h/∂y (R, 2n) of a scene that does not read the time."""
        of = self.sample(0.0, y).quantities("energy_by_q", "mass_matrix")
        return np.concatenate([of["energy_by_q"], np.einsum("rij,rj->ri", of["mass_matrix"], halves(y)[1])], axis=1)

    def canonical_charts(self, t, y: np.ndarray, units: Units) -> np.ndarray:
        """Return ∂(q, p)/∂(q, q̇), (R, 2n, 2n), with q and q̇ in `units`, in which the symplectic form is standard.

        The unit of pᵢ is such that its product with that of qᵢ is the same for all i.
        """
        n, sample = self.size, self.sample(t, y)
        chart = np.zeros((len(y), 2 * n, 2 * n))
        chart[:, :n, :n], chart[:, n:, :n] = np.eye(n), sample.momenta_by_q(tuple(range(n)))
        chart[:, n:, n:] = sample.quantities("mass_matrix")["mass_matrix"]
        of_q = units.state[:, :n]
        of_p = (units.length**2 / units.time)[:, None] / of_q
        return chart * units.state[:, None, :] / np.concatenate([of_q, of_p], axis=1)[:, :, None]

    def explain_failure(self, row: int, arc: Arc, y0: np.ndarray, t_last: float) -> str:
        if not np.broadcast_to(arc.returns, arc.result.shape)[row]:
            return "It ends in another mode: give a period in which it comes back to the one it began in."
        if arc.result[row] == SUCCESSFUL:
            return "Its derivatives are not finite."
        return sentence(arc.result[row], arc.t_end[row], t_last, y0[row], self.layout.names) or ""


_BUDGET = 2**16  # steps of an arc: a thousand times what it should take
_MOST_WRITTEN = 2**26  # numbers of steps of all motions whose shares are sought, half a GiB


# ---- starts as the user gives them, as rows --------------------------------------------------------------------------


def check_starts(q0: PyTree, qdot0: PyTree, time, name: str) -> tuple[np.ndarray, Layout, np.ndarray]:
    """Check starts and `time`, called `name`, one for all or one per member: times () or (N,), layout, states (N, 2n).

    Raises `TypeError` or `ValueError` if they do not fit together, are traced, or not finite.
    """
    require_untraced((q0, qdot0, time), "The start")
    if isinstance(time, dict | eqx.Module):
        require_number(time, name)
    for label, value in ((name, time), ("q0", q0), ("qdot0", qdot0)):
        require_finite(value, label)
    times = np.asarray(time, float)
    if times.ndim > 1 or not times.size:
        raise ValueError(f"{name} must be one number, or an array (N,) of a batch; got shape {times.shape}.")
    if not (times > 0).all():
        raise ValueError(f"{name} must be positive; got {times.min()}.")
    shapes = sorted({np.shape(leaf) for leaf in jax.tree.leaves((q0, qdot0))})
    if times.ndim and any(shape[:1] != times.shape for shape in shapes):
        raise ValueError(
            f"{name} has shape {times.shape}, a batch: every leaf of q0 and qdot0 must have that many members as its "
            f"first axis; got shapes {shapes}."
        )
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], (q0, qdot0)) if times.ndim else (q0, qdot0)
    layout = Layout.from_state(*first)
    leaves = jax.tree.leaves(as_arrays((q0, qdot0), layout.dtype, "state"))
    return times, layout, np.concatenate([np.asarray(x, float).reshape(times.size, -1) for x in leaves], axis=1)


def require_untraced(tree: PyTree, what: str) -> None:
    require_concrete(
        tree,
        what,
        "Orbits are searched for with numbers, how often depends on what is met: search outside of jit, and give many "
        "starts as arrays with the members as first axis, instead of jax.vmap.",
    )
