"""Check of stiffness: the eigenvalues of the motion linearised at the state."""

import numpy as np

from lagjax._equations import null_space
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._scene_at_start import CheckedScene

# The ratio of the time scales from which an explicit solver spends nearly all of its steps on the fastest.
_RATIO = 1e4


def findings(scene: CheckedScene) -> list[Finding]:
    n, m = scene.layout.size, scene.measured
    # Constraints leave the velocities in the kernel of G free.
    free = null_space(m.jacobian[0]).astype(float)
    jacobian = scene.jacobian()
    by_q, by_v = free.T @ jacobian[:, :n] @ free, free.T @ jacobian[:, n:] @ free
    if not (np.isfinite(by_q).all() and np.isfinite(by_v).all()) or not free.shape[1]:
        return []
    f, eps = len(by_q), float(np.finfo(scene.layout.dtype).eps)
    values = _trusted_eigenvalues(np.block([[np.zeros((f, f)), np.eye(f)], [by_q, by_v]]), eps)
    speeds = np.abs(values)
    if len(values) < 2 or speeds.max() < _RATIO * speeds.min():
        return []
    fastest, ratio = values[np.argmax(speeds)], speeds.max() / speeds.min()
    start = f"Time scales here lie from {1 / speeds.max():.1e} to {1 / speeds.min():.1e}, a ratio of {ratio:.0e}"
    if -fastest.real > abs(fastest.imag):
        message = (
            f"{start}, and the fastest dies out: the motion is stiff. Explicit solvers, the default among them, take "
            "steps of the shortest; an implicit one need not: simulate(..., solver=diffrax.Kvaerno5(), rtol=1e-6)."
        )
    else:
        message = (
            f"{start}: every period of the fastest costs steps. Replace a stiff spring by a constraint, average a "
            "fast motion out, or count on long runs."
        )
    return [Finding("stiff", "advice", (), message)]


def _trusted_eigenvalues(linear: np.ndarray, eps: float) -> np.ndarray:
    """Return the nonzero eigenvalues of ẏ = A y that noise of the size of rounding changes by less than 10 %."""
    # A defective zero, as of a free coordinate, is not one of them: rounding makes eigenvalues of √eps of it.
    speed = np.sqrt(np.abs(linear[len(linear) // 2 :]).max()) or 1.0
    scale = np.repeat([1.0, speed], len(linear) // 2)  # the time in units in which both halves are alike
    matrix = linear * scale / scale[:, None]
    noise = 64 * eps * np.abs(matrix).max() * np.random.default_rng(0).standard_normal(matrix.shape)
    values, perturbed = np.linalg.eigvals(matrix), np.linalg.eigvals(matrix + noise)
    nearest = np.abs(values[:, None] - perturbed).min(axis=1)
    return values[(np.abs(values) > 0) & (nearest < 0.1 * np.abs(values))]
