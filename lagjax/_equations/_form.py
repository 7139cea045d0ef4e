"""`Form`: the form in which the equations of a scene are evaluated, and every number that decides between forms, but
for those of the matrices of sparse scenes (`_sparse`).

    form                  by whom                                decided by
    scalar, line          machine code, operation by operation   `derived_form`
    scalar, table         machine code, from tables              `LARGEST_LINE` (`_native/code/_constants`)
    scalar, registers     a thread of a GPU                      `_native/motions/_gpu`
    scalar                XLA, a program                         `form_in_xla`
    arrays                XLA: M and G as matrices               `form_in_xla`
    sparse                XLA: products, solved by patterns      `derived_form`; `MachineCode.declines` it

`Derivation.form` is the form in which a scene is derived, and known at once. `Derivation.form_in_xla` is what XLA
compiles of a scene that machine code does not integrate, and known once it is lowered.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, NamedTuple

import jax

from lagjax._equations._blame import border_places
from lagjax._equations._coupled_forces import CoupledForces
from lagjax._equations._motion import Motion
from lagjax._equations._patterns import count_operations
from lagjax._equations._sparse import MatrixForm, MatrixFree
from lagjax._equations._structure import SparseStructure, mass_form, structure_of
from lagjax._program import Unlowerable, operations_that_fit

if TYPE_CHECKING:
    from lagjax._equations._derivation import Derivation

# ---- memory ----------------------------------------------------------------------------------------------------------

# While it is lowered, an operation takes about a kilobyte, and two where it is written anew.
OPERATION_BUDGET = operations_that_fit(2000)
# Operations of an acceleration: making its kernel takes some 4 KB for each, with the derivatives some 10 KB.
LARGEST_PROGRAM = operations_that_fit(10_000)
# Bytes that an entry of M takes while it is derived on scalars, zero or not: 2 GB of 10 000 coordinates.
BYTES_OF_ENTRY = 20

# ---- sparse arrays ---------------------------------------------------------------------------------------------------

# Coordinates from which patterns of zeros are looked for: a ring of 90 takes 0.5 s to a first result by machine code,
# 4 s by arrays.
LEAST_COORDINATES = 100
# Scalar operations of L from which such a scene runs on arrays: a ring of 1000 (11 000) takes 3.5 s to a first one by
# machine code, 2 s by arrays, whose time hardly grows; a batch of 256 rings of 300 is 30 times faster in machine code.
LEAST_OPERATIONS = 6000
# Coordinates from which it does with constraints: 100 rods (200 coordinates) take machine code 4 s, 500 rods more than
# 240 s, arrays 8 s either way.
LEAST_LINKED = 300
# Coordinates up to which a dense M is a matrix: elimination takes 1 ms there, and conjugate gradients seldom less.
LARGEST_DENSE = 512
# Operations of L up to which machine code takes a large scene that is asked of it, or has borders: a ring of 4000, with
# 44 000 of them, compiles for 18 s, one of 10 000 for 340 s.
LARGEST_LOWERED = 60_000
# Operations of L up to which the coordinates that it reads are looked for, at 1 to 3 µs and up to 1 kB each.
LARGEST_FOLLOWED = 1_500_000

# ---- what XLA compiles -----------------------------------------------------------------------------------------------

# Operations of a program beyond which XLA takes longer to compile it than it saves, and batched elimination on arrays
# overtakes written-out elimination: measured on chains of pendulums, where it lies at 12 links.
LARGEST_XLA_PROGRAM = 2_000
# Operations of a line on a GPU that XLA compiles; NumPy on the host evaluates a longer one. Twice as many would cost
# several seconds of compilation.
LARGEST_COMPILED = 100
# Operations of all quantities beyond which JAX differentiates arrays. Derivatives of programs take 100 µs for each;
# those of arrays 2 s for what is vectorised, as 60 bodies are (39 000: 4 s), and 13 s for an arm that is written joint
# by joint (7600: 1 s). Doubled, the first kind loses 3 s more; halved, arms of 12 joints compile for half a minute.
LARGEST_DIFFERENTIATED = 30_000
# Operations of all quantities, of these for each equation that JAX writes the scene in, and for each coordinate, beyond
# all of which JAX does so too. Arrays take 1 to 2 s however long they are: the gradient of an acceleration with a
# network 2 × 32 in L (4600 operations, 33 equations) takes 0.8 s, by programs 2.6; 24 coordinates joint by joint
# (15 100, 1846) 3.6 by programs. What has few operations for each coordinate has a mass matrix that arrays solve for:
# an acceleration of 20 bodies (4600, 29) takes 300 µs by arrays, and 2 by programs.
LEAST_AS_ARRAYS, MOST_OF_EQUATION, MOST_OF_COORDINATE = 3000, 100, 1000

# ---- analysis and checks ---------------------------------------------------------------------------------------------

# Coordinates up to which the analysis treats sparse matrices as dense ones: eigenvalues and roots take 5 s there, and
# ten times as long for twice as many.
LARGEST_ANALYSED_DENSE = 200
# Coordinates beyond which nothing is begun that takes n × n numbers, 8 MB a matrix, of which there may be a hundred,
# and n³ operations, which take a minute. Doubled, ten.
LARGEST_ANALYSED = 1000
# Coordinates up to which a failure is explained by `check`: it takes a second there, as for the second number of them
# where it compiles.
LARGEST_CHECKED, LARGEST_CHECKED_BY_XLA = 128, 16


class Form(NamedTuple):
    """The form in which the equations of a scene are evaluated.

    - `kind`: "scalar", as programs, operation by operation; "arrays", with M and G as matrices; "sparse", by their
      patterns.
    - `reason`: why they are no programs, as the end of a sentence; None where they are.
    - `structure`: that of sparse matrices. `operations`: the number in L, or in the program, where they are counted.
    """

    kind: Literal["scalar", "arrays", "sparse"]
    reason: str | None = None
    structure: SparseStructure | None = None
    operations: int = 0

    @property
    def is_sparse(self) -> bool:
        return self.kind == "sparse"

    @property
    def mass(self) -> MatrixForm | None:
        """The form of M if it is sparse, else None."""
        return self.structure and self.structure.mass


SCALAR = Form("scalar")


def derived_form(motion: Motion, shapes: tuple, path: str, is_sparse_in_scalars: Callable[[], bool]) -> Form:
    """The form in which a scene is derived, from the shapes of (q, q̇, t, params); sparse if large and suitable.

    On the `path` "array" size alone decides. M that is not sparse as arrays may be so on scalars, where zeros cancel.
    """
    n, insists = shapes[0].size, path == "array"
    if path == "scalar" or n < LEAST_COORDINATES or isinstance(motion.forces, CoupledForces):
        return SCALAR
    operations = count_operations(jax.make_jaxpr(motion.lagrangian)(*shapes).jaxpr)
    if not insists and not (operations >= LEAST_OPERATIONS or (motion.constrained and n >= LEAST_LINKED)):
        return SCALAR
    mass = mass_form(motion, shapes)
    if isinstance(mass, MatrixFree) and n <= (LARGEST_DENSE if insists else 2 * LARGEST_DENSE):
        return SCALAR
    if (structure := structure_of(motion, shapes, mass)) is None:
        return SCALAR
    if not insists and operations <= LARGEST_LOWERED:
        if isinstance(mass, MatrixFree):
            if not mass.known and is_sparse_in_scalars():
                return SCALAR
        elif border_places(motion.functions, *shapes):  # steps end at borders there alone
            return SCALAR
    reason = f"it has {n} coordinates, {structure}, and arrays suit that better"
    return Form("sparse", reason, structure, operations)


def suits_programs(derivation: "Derivation", operations: int) -> bool:
    """True if derivatives are quicker by programs, of this many operations, than by the functions as written."""
    if operations <= LEAST_AS_ARRAYS or operations > LARGEST_DIFFERENTIATED:
        return operations <= LEAST_AS_ARRAYS
    return operations <= max(MOST_OF_EQUATION * derivation.equations, MOST_OF_COORDINATE * derivation.layout.size)


def form_in_xla(derivation: "Derivation") -> Form:
    """The form of a scene that XLA compiles, by its path; `ValueError` if "scalar" is impossible."""
    arrays = derivation.form if derivation.form.is_sparse else Form("arrays")
    if derivation.path == "array":
        return arrays._replace(reason="asked for")
    try:
        program = derivation.accelerations.program.complete
    except Unlowerable as reason:
        if derivation.path == "scalar":
            raise ValueError(f"This scene has no scalar program: {reason}. Leave `path` at 'auto'.") from None
        return arrays._replace(reason=str(reason))
    reasons = {
        "it looks up entries of tables": program.looks_up,  # whose inputs would be these entries, one by one
        "its mass matrix may need pivoting": derivation.counts_on_params,  # which may be traced here
        # A program keeps the first two derivatives of these alone.
        "a function has rules of its own for its derivatives": derivation.has_rules,
        f"{program.operations} operations are more than the {LARGEST_XLA_PROGRAM} that XLA compiles quickly": (
            program.operations > LARGEST_XLA_PROGRAM
        ),
    }
    reason = next((reason for reason, applies in reasons.items() if applies), None)
    if derivation.path == "scalar" or reason is None:
        return Form("scalar", operations=program.operations)
    return arrays._replace(reason=reason)
