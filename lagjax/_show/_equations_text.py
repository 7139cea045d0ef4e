"""The equations of a scene as formulas: M q̈ = F + Gᵀλ, with all numbers by the names that the user gave them."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import PyTree

from lagjax._equations import derivation_of
from lagjax._interface import Layout, number_names, show_str
from lagjax._program import Formulas, Unlowerable
from lagjax._scene import DrivenParams, constant_inputs, drive_scene
from lagjax._show._formula_text import LATEX, PYTHON, FormulaWriter, Name, input_names, shared_parts, short_names

if TYPE_CHECKING:
    from lagjax._scene import System


# Operations of M, F, G and γ that are read: a double pendulum has 40, three links in space 400. Four times as many fill
# ten pages, and take a second to put together.
MOST_READ = 500
_MOST_IN_MATRICES = 4  # coordinates up to which LaTeX shows matrices


@dataclass(frozen=True)
class Equations:
    """The equations of motion of a scene, M q̈ = F + Gᵀλ with G q̈ = γ, as formulas; `print` shows them all.

    Each formula is Python: with the names of coordinates, velocities (`theta_dot`), `t` and parameters as variables,
    and the functions of `math`, it evaluates to the number. In a notebook the equations are typeset.

    - `mass_matrix`: M, by the names of two coordinates; `force`: F, by that of one; what is not listed is zero.
    - `constraints`: what stays zero, by name; `jacobian`: G, by the names of a constraint and a coordinate; `gamma`: γ.
    - `variables`: the names of q, q̇, t and the numbers of params, in this order.
    - `parts`: what `x1`, `x2`, … in these formulas stand for, in the order in which they are computed.
    - `tables`: the first and the last entry of `table1`, `table2`, …: `table1(i)` is its entry i, and `locate1(x)` the
      number of its entries that are at most x, less one.
    - `note`: why there are no formulas, where the scene has too many operations for them, or no scalar program.
    - `latex`: all of it in LaTeX.
    """

    mass_matrix: dict[tuple[str, str], str] = field(default_factory=dict)
    force: dict[str, str] = field(default_factory=dict)
    constraints: dict[str, str] = field(default_factory=dict)
    jacobian: dict[tuple[str, str], str] = field(default_factory=dict)
    gamma: dict[str, str] = field(default_factory=dict)
    parts: dict[str, str] = field(default_factory=dict)
    tables: dict[str, str] = field(default_factory=dict)
    variables: tuple[str, ...] = ()
    note: str = ""
    latex: str = ""

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        if self.note:
            return self.note
        of = "M q'' = F + G^T lambda, G q'' = gamma" if self.constraints else "M q'' = F"
        lines = [f"{of}; M is symmetric, and what is not listed is 0.", ""]
        lines += [f"{name} = {formula}" for name, formula in (self.tables | self.parts).items()]
        tables = self.mass_matrix, self.force, self.constraints, self.jacobian, self.gamma
        for title, formulas in zip(("M", "F", "f", "G", "gamma"), tables, strict=True):
            named = ((key if isinstance(key, str) else ", ".join(key), formula) for key, formula in formulas.items())
            lines += [f"{title}[{key}] = {formula}" for key, formula in named]
        return "\n".join(lines)

    def _repr_latex_(self) -> str:
        return f"$$\n{self.latex}\n$$" if self.latex else self.note


def write_equations(system: "System", layout: Layout, params: PyTree, inputs: PyTree) -> Equations:
    """Return the result of `System.equations`."""
    names = system.constraint_names(layout, params) if system.constraints or system.velocity_constraints else []
    numbers = [*number_names(params, "params"), *number_names(inputs, "inputs")]
    if inputs is not None:
        system, params = drive_scene(system, constant_inputs), DrivenParams(params, inputs)
    quantities = ("mass_matrix", "force", "residual", "jacobian", "gamma")
    try:
        derivation = derivation_of(system, layout, params)
        line = None if derivation.form.is_sparse else derivation.program(*quantities).line
    except Unlowerable as reason:
        return Equations(note=f"This scene has no formulas to read: {reason}.")
    if line is None or line.operations > MOST_READ:
        count = derivation.form.operations if line is None else line.operations
        return Equations(
            note=f"The equations of this scene take {count} operations, more than the {MOST_READ} that are "
            "read with profit. system.to_c(q, qdot, params=params) writes all of them in C; system.explain tells what "
            "they contain."
        )
    found = Formulas(line, 2 * layout.size + 1)
    outputs = np.empty(len(found.outputs), object)
    outputs[:] = found.outputs
    sums = derivation.split_outputs(quantities, outputs)
    return _FormulaPage(found, sums, input_names(layout.names, numbers), names).equations()


class _FormulaPage:
    """The formulas of a scene, and their writers for Python and for LaTeX."""

    def __init__(self, formulas: Formulas, sums: dict[str, np.ndarray], names: list[Name], constraints: list[str]):
        self.sums, self.names, self.constraints = sums, names, short_names(constraints)
        self.n = len(sums["force"])
        taken = {name.text for name in names}
        letter = next(x for x in "xsuzw" if not any(name.startswith(x) and name[1:].isdigit() for name in taken))
        shared = shared_parts(formulas, [x for of in sums.values() for x in of.ravel()])
        self.shared = {atom: k + 1 for k, atom in enumerate(shared)}
        texts = {atom: f"{letter}{k}" for atom, k in self.shared.items()}
        self.text = FormulaWriter(formulas, names, PYTHON, texts)
        self.latex = FormulaWriter(formulas, names, LATEX, {a: f"{letter}_{{{k}}}" for a, k in self.shared.items()})

    def equations(self) -> Equations:
        of, rows = [name.text for name in self.names[: self.n]], self.constraints
        write = self.text.write
        matrix, jacobian = self.sums["mass_matrix"], self.sums["jacobian"]
        each: dict[str, Any] = {
            "mass_matrix": {(of[i], of[j]): write(matrix[i, j]) for i in range(self.n) for j in range(i, self.n)
                            if matrix[i, j]},
            "force": {of[i]: write(x) for i, x in enumerate(self.sums["force"]) if x},
            "constraints": {rows[i]: write(x) for i, x in enumerate(self.sums["residual"])},
            "jacobian": {(rows[i], of[j]): write(x) for (i, j), x in np.ndenumerate(jacobian) if x},
            "gamma": {rows[i]: write(x) for i, x in enumerate(self.sums["gamma"]) if x},
            "parts": {self.text.parts[atom]: self.text.write_part(atom) for atom in self.shared},
            "tables": self.text.write_tables(),
        }  # fmt: skip
        return Equations(**each, variables=tuple(name.text for name in self.names), latex=self._write_latex())

    def _write_latex(self) -> str:
        lines = [rf"{self.latex.parts[atom]} &= {self.latex.write_part(atom)}" for atom in self.shared]
        m, f, place, g, gamma = (rf"\boldsymbol{{{x}}}" for x in ("M", "F", "f", "G", r"\gamma"))
        shown = {m: "mass_matrix", f: "force", place: "residual", g: "jacobian", gamma: "gamma"}
        held = rf" + {g}^{{\mathsf{{T}}}} \boldsymbol{{\lambda}}, \quad {g} \ddot{{\boldsymbol{{q}}}} = {gamma}"
        law = rf"{m} \ddot{{\boldsymbol{{q}}}} &= {f}" + (held if self.constraints else "")
        for sign, name in shown.items():
            of = self.sums[name]
            if of.size and self.n <= _MOST_IN_MATRICES:
                rows = r" \\ ".join(" & ".join(map(self.latex.write, np.atleast_1d(row))) for row in of)
                lines.append(rf"{sign} &= \begin{{pmatrix}} {rows} \end{{pmatrix}}")
            elif of.size:
                entries = [(at, x) for at, x in np.ndenumerate(of) if x and at == tuple(sorted(at))]
                places = [" ".join(str(i + 1) for i in at) for at, _ in entries]
                written = zip(places, (self.latex.write(x) for _, x in entries), strict=True)
                lines += [rf"{sign}_{{{place}}} &= {formula}" for place, formula in written]
        return "\\begin{aligned}\n" + " \\\\\n".join([law, *lines]) + "\n\\end{aligned}"
