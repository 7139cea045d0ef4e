"""`choose`: which engine integrates a problem, the only place that decides it; `explain` prints its answer.

The thresholds between forms of a scene are in `_equations/_form`; `MachineCode.declines` refuses what is sparse.

Without a choice by the user it is machine code where the scene has it, else diffrax with its default solver. A solver,
fixed steps, an adjoint or a progress meter ask for diffrax; `solver=lagjax.MachineCode()` insists on machine code.
"""

from typing import Any, NamedTuple

from lagjax._engine._problem import AbstractEngine, Problem
from lagjax._engine.taylor import MachineCode


class Choice(NamedTuple):
    """The engine that integrates, and the reason why it is not machine code (end of a sentence; None if it is)."""

    engine: AbstractEngine
    refusal: str | None


def requested_engine(
    solver=None, dt=None, adjoint=None, progress: Any = False, rtol=None, atol=None
) -> AbstractEngine | None:
    """The engine that these arguments of `simulate` require; None if they leave it open.

    Raises `TypeError` or `ValueError` if they are invalid, or contradict each other.
    """
    if dt is not None and not (rtol is None and atol is None):
        raise ValueError("dt asks for fixed steps and rtol/atol for adaptive ones: give one or the other.")
    asked = {"fixed steps were": dt is not None, "an adjoint was": adjoint is not None}
    asked["a progress meter was"] = progress is not False
    if isinstance(solver, MachineCode):
        if what := next((what for what, given in asked.items() if given), None):
            raise ValueError(_explain_refusal(f"{what} asked for"))
        return solver
    if solver is None and not any(asked.values()):
        return None
    return _import_diffrax().from_arguments(solver, dt, adjoint, progress)


_MACHINE_CODE = MachineCode()


def choose(problem: Problem, requested: AbstractEngine | None = None, members: int = 1) -> Choice:
    """The engine for one or `members` problems. Raises `ValueError` if the `requested` one, or all, refuse them."""
    if requested is None or isinstance(requested, MachineCode):
        refusal = _MACHINE_CODE.declines(problem) if requested is None else _MACHINE_CODE.lacks(problem)
        if refusal is None:
            return Choice(_MACHINE_CODE, None)
        if requested is not None:
            raise ValueError(_explain_refusal(refusal))
        requested = _import_diffrax()()
    else:
        refusal = "diffrax was asked for"
    engine: Any = requested
    if sentence := engine.refuses(problem) or engine.lacks_memory(problem, members):
        raise ValueError(f"{sentence}.")
    return Choice(engine, refusal)


def _import_diffrax() -> Any:
    """The engine class `Diffrax`, imported on first use: importing diffrax takes half as long as JAX."""
    from lagjax._engine.diffrax import Diffrax

    return Diffrax


def _explain_refusal(reason: str) -> str:
    return (
        f"solver=lagjax.MachineCode() cannot integrate this: {reason}. Leave solver at None, and diffrax integrates "
        "what machine code cannot."
    )
