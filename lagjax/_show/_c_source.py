"""The equations of a scene as C99 source: accelerations, mass matrix, energy and a step of fixed length.

Each function is a straight line of the scene (`_native._c_lines`), with a comment on its arguments. The step is the
classical Runge-Kutta step: it takes four accelerations and no memory, whereas a step of a Taylor series, which is more
accurate, takes a recurrence of each order for each operation. With constraints every step ends with one Newton step
back to them.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import PyTree

from lagjax._equations import Derivation, derivation_of
from lagjax._interface import VERSION, Layout, number_names
from lagjax._native import CNumbers, write_function
from lagjax._program import Graph, StraightLine, Unlowerable, eliminate_dead_code
from lagjax._scene import DrivenParams, constant_inputs, drive_scene
from lagjax._tracing import Program, fold, lower_formula, stack

if TYPE_CHECKING:
    from lagjax._scene import System


_HEAD = """\
/* The equations of motion of a scene, by lagjax {version}, in C99 without libraries but math.h.

   Compile with -ffp-contract=off and without -ffast-math: then accelerations have the digits of lagjax.
   Numbers stand in arrays, in this order:
{order}
*/
#include <math.h>
"""

_STEP = """\
/* Fixed steps of length dt by the classical method of Runge and Kutta, of order 4, from t on; q and qdot change. */
void {name}_step(double *q, double *qdot, double t, {more}double dt, long steps)
{{
    double at[{n}], speed[4][{n}], rate[4][{n}];
    const double part[4] = {{0.0, 0.5, 0.5, 1.0}};
    for (long step = 0; step < steps; step++) {{
        const double start = t + step * dt;
        for (int k = 0; k < 4; k++) {{
            for (int i = 0; i < {n}; i++) {{
                at[i] = k ? q[i] + part[k] * dt * speed[k - 1][i] : q[i];
                speed[k][i] = k ? qdot[i] + part[k] * dt * rate[k - 1][i] : qdot[i];
            }}
            {name}_acceleration(at, speed[k], start + part[k] * dt, {given}rate[k]);
        }}
        for (int i = 0; i < {n}; i++) {{
            q[i] += dt / 6.0 * (speed[0][i] + 2.0 * speed[1][i] + 2.0 * speed[2][i] + speed[3][i]);
            qdot[i] += dt / 6.0 * (rate[0][i] + 2.0 * rate[1][i] + 2.0 * rate[2][i] + rate[3][i]);
        }}{project}
    }}
}}
"""

_PROJECT = """
        double state[2 * {n}];
        {name}_project(q, qdot, start + dt, {given}state);
        for (int i = 0; i < {n}; i++) {{ q[i] = state[i]; qdot[i] = state[{n} + i]; }}"""

_NO_STEP = """\
/* No {name}_step: the accelerations jump or have corners at borders, where a step of fixed length does not end. Dry
   friction, for one, would not come to rest. lagjax.simulate follows this motion. */
"""


def write_c(system: "System", layout: Layout, params: PyTree, inputs: PyTree, name: str, dtype: str) -> str:
    """The text of `System.to_c`."""
    if dtype not in ("float64", "float32"):
        raise ValueError(f"dtype must be 'float64' or 'float32'; got {dtype!r}.")
    if not (isinstance(name, str) and name.isidentifier() and name.isascii()):
        raise ValueError(f"name must be an identifier of C, as 'pendulum' is; got {name!r}.")
    if system.touches:
        raise TypeError(
            "The motion of a scene with contacts is no function of the state alone, which C could evaluate. For the "
            "motion while none is closed, build the System without contacts=... and one_way=...."
        )
    places = {"q": layout.names, "params": number_names(params, "params"), "inputs": number_names(inputs, "inputs")}
    if inputs is not None:
        system, params = drive_scene(system, constant_inputs), DrivenParams(params, inputs)
    try:
        derivation = derivation_of(system, layout, params).with_numbers().lowered
        return _SceneSource(derivation, name, CNumbers(dtype), places).text()
    except Unlowerable as reason:
        raise ValueError(f"This scene has no scalar program, and therefore no C: {reason}.") from None


class _SceneSource:
    """Writes the C source of a scene, with function names that begin with `name`."""

    def __init__(self, derivation: Derivation, name: str, numbers: CNumbers, places: dict[str, Sequence[str]]):
        self.derivation, self.name, self.numbers, self.places = derivation, name, numbers, places
        self.n = derivation.layout.size
        self.arrays = [array for array in ("params", "inputs") if places[array]]

    def text(self) -> str:
        functions = [self._write_quantity(what, line, says) for what, (line, says) in self._write_functions().items()]
        functions.append(self._write_step())
        helpers = self.numbers.helpers("".join(functions))
        orders = {"q, qdot, qddot": self.places["q"], **{array: self.places[array] for array in self.arrays}}
        rows = (f"   {arrays:16s} {', '.join(names)}" for arrays, names in orders.items())
        head = _HEAD.format(version=VERSION, order="\n".join(rows).replace("*/", "* /"))
        return "\n".join([head, *helpers, *functions])

    def _write_functions(self) -> dict[str, tuple[StraightLine, str]]:
        """Return {function name: (its straight line, a comment)}."""
        of, n = self.derivation, self.n
        lines = {
            "acceleration": (
                _mask_singular(of.accelerations.program.complete.line),
                f"qddot[{n}]; NaN where M is singular",
            ),
            "mass_matrix": (of.program("mass_matrix").line, f"M, {n} rows of {n}"),
            "energy": (_energy_program(of).line, "p qdot - L, one number"),
        }
        if of.accelerations.projected is not None:
            says = f"q and qdot, {2 * n} numbers, after one Newton step to the constraints"
            lines["project"] = of.accelerations.projected.line, says
        return lines

    def _write_quantity(self, what: str, line: StraightLine, says: str) -> str:
        kind = f"const {self.numbers.type}"
        arguments = {"q": f"{kind} *", "qdot": f"{kind} *", "t": kind} | {x: f"{kind} *" for x in self.arrays}
        return f"/* {says} */\n{write_function(f'{self.name}_{what}', line, arguments, self._read_input, self.numbers)}"

    def _read_input(self, i: int) -> str:
        """Return the C expression of input i of a straight line."""
        n, count = self.n, len(self.places["params"])
        if i < 2 * n + 1:
            return f"q[{i}]" if i < n else f"qdot[{i - n}]" if i < 2 * n else "t"
        i -= 2 * n + 1
        return f"params[{i}]" if i < count else f"inputs[{i - count}]"

    def _write_step(self) -> str:
        of = self.derivation
        if of.borders is not None and of.borders.switches:
            return _NO_STEP.format(name=self.name)
        more, given = "".join(f"const double *{x}, " for x in self.arrays), "".join(f"{x}, " for x in self.arrays)
        settings = {"name": self.name, "n": self.n, "more": more, "given": given}
        project = "" if of.accelerations.projected is None else _PROJECT.format(**settings)
        return self.numbers.form(_STEP.format(**settings, project=project).replace("double", self.numbers.type))


def _mask_singular(line: StraightLine) -> StraightLine:
    """Return accelerations that are NaN where the line's last output, the singularity indicator, is positive."""
    graph = Graph.from_line(line, 2 * len(line.nodes) + 10)
    *values, singular = line.outputs
    if graph.kinds[singular] != "bool":
        singular = graph.apply("gt", singular, graph.number(0.0))
    return eliminate_dead_code(graph, [graph.apply("select", singular, x, graph.number(np.nan)) for x in values])


def _energy_program(derivation: Derivation) -> Program:
    parts, n = derivation.program("momentum", "lagrangian"), derivation.layout.size

    def energy(*scalars):
        values = parts.vector(*scalars)
        return stack([fold("add", values[:n] * stack(scalars[n : 2 * n])) - values[n]])

    return lower_formula(energy, *derivation.scalar_shapes, budget=10**9)
