"""The street runs one way: a module imports only from modules above it, and importing changes nothing."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import lagjax

PACKAGE = Path(lagjax.__file__).parent

README = (Path(__file__).parent.parent / "README.md").read_text()
# From the top of the street to its end, as the README's table lists it. A new module must take a place there.
STREET = re.findall(r"^\| `(\w+)(?:\.py|/)` \|", README.split("## The street")[1].split("\n## ")[0], flags=re.MULTILINE)
LEAVES = {"scenes", "plot"}  # for users, tests, benchmarks and examples; imported by nothing on the street


def place(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> set[str]:
    """The lagjax modules that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "lagjax":
            parts = node.module.split(".")[1:]
            found |= {parts[0]} if parts else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("lagjax.")}
    return found


def test_every_module_has_a_place():
    modules = {place(path) for path in PACKAGE.rglob("*.py")} - {"__init__"}
    assert modules == set(STREET) and len(STREET) == len(modules)


def test_imports_point_up_the_street():
    for path in PACKAGE.rglob("*.py"):
        here = place(path)
        if here == "__init__":
            continue
        for there in imports(path) - {here}:
            if there not in STREET:  # a public name, imported from the package as a user would
                assert here in LEAVES and there in lagjax.__all__, f"{path} imports {there}"
                continue
            assert there not in LEAVES, f"{path} imports the leaf {there}"
            assert STREET.index(there) < STREET.index(here), f"{path} imports {there} from below"


def test_only_one_module_integrates():
    for path in PACKAGE.rglob("*.py"):
        called = {ast.unparse(n.func) for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)}
        assert "diffrax.diffeqsolve" not in called or place(path) == "_integrate"


def test_importing_changes_nothing():
    code = (
        "import jax, logging, sys; before = (jax.config.values.copy(), logging.root.handlers[:]);"
        "import lagjax, lagjax.scenes; assert all(jax.config.values[k] == v for k, v in before[0].items());"
        "assert before[1] == logging.root.handlers;"
        "assert not {'matplotlib', 'xarray', 'scipy.integrate'} & set(sys.modules), 'optional packages are lazy'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and not done.stdout, done.stderr
