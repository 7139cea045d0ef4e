"""A wheel holds what lagjax needs, and runs from outside of the checkout."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_wheel_runs_outside_of_the_checkout(tmp_path):
    # It is built as `python -m build` builds it, and unpacked beside the packages of this environment.
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, ROOT]
    built = subprocess.run(command, capture_output=True, text=True)
    if built.returncode != 0 and ("hatchling" in built.stderr or "No module named pip" in built.stderr):
        pytest.skip("the build needs pip and hatchling, which could not be had")
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    package = {str(path.relative_to(ROOT)) for path in (ROOT / "lagjax").rglob("*") if path.is_file()}
    missing = {name for name in package if "__pycache__" not in name} - names
    assert not missing and not any(name.startswith(("tests", "benchmarks", "examples")) for name in names)
    shown = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    code = "\n".join([f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r})", *shown, "print(lagjax.__file__)"])
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert "reached the end" in ran.stdout and str(tmp_path) in ran.stdout.splitlines()[-1]
