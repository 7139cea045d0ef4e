"""Populations in float32, JAX's default: `--float32`.

The switch for float64 stays off, and every number of a scene is rounded to float32 before anything is done with it:
the reference is that of the rounded scene, in float64 or better. What lagjax returns is rounded once, and a start
within `SINGLE_NOISE` of a surface counts as one on it.
"""

import argparse

import jax
import numpy as np

from lagjax._native import SINGLE_NOISE

EPS = float(np.finfo(np.float32).eps)
__all__ = ["EPS", "SINGLE_NOISE", "add_option", "precision_of", "rounded"]


def add_option(parser: argparse.ArgumentParser) -> None:
    """The option of a command."""
    parser.add_argument("--float32", action="store_true", help="numbers of float32, without the switch for float64")


def precision_of(options: argparse.Namespace) -> np.dtype:
    """The dtype of all numbers that go into a scene, after the switch is set for it."""
    jax.config.update("jax_enable_x64", not options.float32)
    return np.dtype(np.float32 if options.float32 else np.float64)


def rounded(x, precision: np.dtype) -> np.ndarray:
    """Numbers as they are in a precision, in float64."""
    return np.asarray(x, precision).astype(float)
