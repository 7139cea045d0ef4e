"""Every test runs in double precision unless it says otherwise."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """The number of workers for `-n auto`: one a core for folders of tests, none for a file or a test that is named."""
    named = [part for part in config.args if not Path(part).is_dir()]
    return 0 if named or config.getoption("keyword") else os.cpu_count()
