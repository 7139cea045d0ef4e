"""`MachineCode`: the engine that is chosen by default where a scene has it, as a value that insists on it."""

import equinox as eqx


class MachineCode(eqx.Module):
    r"""Taylor series in machine code made for the scene: `simulate(..., solver=lagjax.MachineCode())`.

    Left to its default, `solver=None`, a run goes to machine code where it can and to diffrax where it cannot.
    `MachineCode()` insists: a run that cannot go there is a `ValueError` that says why, instead of a slower run.
    `simulate`, `simulate_batch` and `work_precision` take it, the last one to compare it with solvers of diffrax.

    Each coordinate becomes a power series about the present time, of an order p that suits the tolerance,

        q(t + h) = Σ qₖ hᵏ, 0 ≤ k ≤ p,    (k+1)(k+2) qₖ₊₂ = (q̈)ₖ

    with the coefficients (q̈)ₖ by recurrences through the scalar operations of the acceleration. Four or eight members
    of a batch stand side by side in the vector registers of every core.

    It is for float64 on CPUs, scenes whose acceleration is a scalar program of at most some thousands of smooth or
    piecewise smooth operations, adaptive steps, no `event` and derivatives by its own adjoint. `System.explain` says
    whether a scene is one of these. Derivatives of scenes of more than 2000 operations are those of diffrax even so.

    **Raises** nothing itself; the run raises `ValueError`, before anything is integrated, where it has no machine code.

    Source: Jorba & Zou, *A software package for the numerical integration of ODEs by means of high-order Taylor
    methods*, Exp. Math. 14 (2005) 99–117, §2.1, §3.2.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    trajectory = lagjax.simulate(scene, 1.0, 0.0, jnp.linspace(0, 10, 101), solver=lagjax.MachineCode())
    ```
    """
