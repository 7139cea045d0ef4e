"""The street runs one way: a module imports only from modules above it, and importing changes nothing."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import lagjax

PACKAGE, TESTS = Path(lagjax.__file__).parent, Path(__file__).parents[1]

DEVELOPMENT = (Path(__file__).parents[2] / "docs" / "development.md").read_text()
# From the top of the street to its end, as the table there lists it. A new module must take a place in it.
TABLE = DEVELOPMENT.split("## The street")[1].split("\n## ")[0]
STREET = re.findall(r"^\| `(\w+)(?:\.py|/)` \|", TABLE, flags=re.MULTILINE)
LEAVES = {"scenes", "plot", "results"}  # for users, tests, benchmarks and examples; imported by nothing on the street


def place(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(tree_of(path)))


def imports(path: Path) -> set[str]:
    """The lagjax modules that a file imports, also inside functions."""
    found = set()
    for node in nodes_of(path):
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


def test_storeys_of_the_machine_code_stand_on_each_other():
    """What `_native/__init__` lists: a file imports from its own storey and from those above it in the list."""
    native = PACKAGE / "_native"
    storeys = re.findall(r"^    (\w+)/ ", ast.get_docstring(tree_of(native / "__init__.py")) or "", flags=re.MULTILINE)
    assert sorted(storeys) == sorted(path.parent.name for path in native.glob("*/__init__.py"))
    for path in native.glob("*/*.py"):
        here = path.parent.name
        for node in nodes_of(path):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lagjax._native"):
                there = node.module.split(".")[2]
                assert storeys.index(there) <= storeys.index(here), f"{path} imports {node.module} from above it"


def test_packages_have_doors():
    # What a room uses of another stands in the `__init__` of a package there, and an underscore name does not cross.
    for path in PACKAGE.rglob("*.py"):
        for node in nodes_of(path):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("lagjax."):
                continue
            there = node.module.split(".")[1]
            if there == place(path):
                continue
            private = [alias.name for alias in node.names if alias.name.startswith("_")]
            is_file = (PACKAGE.parent / (node.module.replace(".", "/") + ".py")).exists()
            assert not (is_file and there.startswith("_")), f"{path} imports {node.module} past its door"
            assert not private, f"{path} imports {private} from {node.module}"


def test_doors_offer_what_is_used():
    """Every name that a door imports is used in it, or imported from it by another file."""
    nodes = [node for folder in (PACKAGE, TESTS) for path in folder.rglob("*.py") for node in nodes_of(path)]
    taken = {(node.module, alias.name) for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names}
    called = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    for door in PACKAGE.glob("_*/**/__init__.py"):
        module = ".".join(door.parent.relative_to(PACKAGE.parent).parts)
        used = {node.id for node in nodes_of(door) if isinstance(node, ast.Name)}
        for node in tree_of(door).body:
            for alias in node.names if isinstance(node, ast.ImportFrom) else ():
                name = alias.asname or alias.name
                if node.module != "lagjax._tracing.lowering":  # whose rules are registered by the import
                    assert (module, name) in taken or name in used | called, f"{module} imports {name} for nobody"


def test_the_head_of_a_room_names_its_files():
    for door in PACKAGE.glob("_*/**/__init__.py"):
        head = ast.get_docstring(tree_of(door)) or ""
        files = {path.stem for path in door.parent.glob("_*.py")} - {"__init__"}
        files |= {path.parent.name + "/" for path in door.parent.glob("*/__init__.py")}
        missing = [name for name in sorted(files) if not re.search(rf"(?<!\w){name}(?!\w)", head)]
        assert not missing, f"the head of {door.relative_to(PACKAGE)} does not name {missing}"


JAX = {"jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax"}
ALONE = """
import importlib.abc, sys, types

class Refused(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        assert name.split(".")[0] not in JAX, name

JAX, package = @JAX@, "@PACKAGE@"
sys.meta_path.insert(0, Refused())
sys.modules["lagjax"] = types.ModuleType("lagjax")  # without what its own first lines import
sys.modules["lagjax"].__path__ = [package]

import numpy as np
from lagjax import _native
from lagjax._program._series import StraightLine

nodes = (("input", (), 0), ("input", (), 3), ("mul", (1, 0), None), ("neg", (2,), None), ("constant", (), False))
line = StraightLine(nodes, ("float", "float", "float", "float", "bool"), (3, 4))  # q" = -k q
program = type("Program", (), dict(line=line, size=4, dtypes=[np.dtype(float)] * 4, linear=None, budget=100))()
kernel, ts = _native.Kernel(program, 1), np.linspace(0.0, 3.0, 7)[None]
done = kernel(ts, [[1.0, 0.0]], [[1.0]], 1e-12, 1e-15, 100, 100)
np.testing.assert_allclose(done.path[0, :, 0], np.cos(ts[0]), atol=1e-11)
bars = np.zeros((1, 7, 2)), np.array([[1.0, 0.0]])
steps = _native.Steps(done.table, [0], done.steps, _native.choose_order(1e-12))
start, numbers, _ = kernel.vjp(ts, [[1.0]], steps, *bars)
np.testing.assert_allclose(start, [[np.cos(3.0), np.sin(3.0)]], atol=1e-11)
np.testing.assert_allclose(numbers, [[-1.5 * np.sin(3.0)]], atol=1e-11)  # of cos(sqrt(k) t)
"""


def test_machine_code_stands_alone():
    # Files that it is built on, and their own; the packages' first lines are for those who have JAX.
    queue, seen = [path for path in (PACKAGE / "_native").rglob("*.py")], set()
    while queue:
        path = queue.pop()
        if path in seen:
            continue
        seen.add(path)
        for node in nodes_of(path):
            names = [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not JAX & {name.split(".")[0] for name in names}, path
            ends = ".py", "/__init__.py"
            files = {PACKAGE.parent / (name.replace(".", "/") + end) for name in names for end in ends}
            queue += [file for file in files if file.exists() and PACKAGE in file.parents]
    assert PACKAGE / "_program" / "_operations.py" in seen
    # And it runs so, forward and back.
    code = ALONE.replace("@JAX@", repr(JAX)).replace("@PACKAGE@", str(PACKAGE))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_only_one_module_integrates():
    for path in PACKAGE.rglob("*.py"):
        called = {n.func.attr for n in nodes_of(path) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)}
        assert "diffeqsolve" not in called or path.stem == "_integrate"


def test_importing_changes_nothing_and_a_name_is_imported_when_it_is_used():
    code = (
        "import jax, logging, sys; before = (jax.config.values.copy(), logging.root.handlers[:]);"
        "import lagjax; assert 'lagjax._run._simulate' not in sys.modules, 'it has not been used';"
        "assert set(lagjax.__all__) <= set(dir(lagjax)) and not {'Orbit', 'sobol'} & set(dir(lagjax));"
        "early = {'scipy.optimize', 'scipy.special', 'lagjax._fit', 'lagjax._sweep'} & set(sys.modules);"
        "assert not early, f'import lagjax imports {early}: import them in the functions that need them';"
        "import jax.numpy as jnp; spring = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2);"
        "lagjax.simulate(spring, 1.0, 0.0, jnp.linspace(0.0, 1.0, 3));"  # what takes as long as half of JAX
        "assert not {'diffrax', 'optimistix', 'lineax', 'scipy.sparse', 'asdex', 'numba'} & set(sys.modules);"
        # What judges and shows a motion stands above it, and is imported by the method that calls it.
        "assert not {'lagjax._trust', 'lagjax._show'} & set(sys.modules), 'a trajectory carries a judgement';"
        "import lagjax.scenes; assert all(jax.config.values[k] == v for k, v in before[0].items());"
        "assert before[1] == logging.root.handlers;"
        "assert not {'matplotlib', 'xarray', 'scipy.integrate'} & set(sys.modules), 'optional packages are lazy';"
        "assert not hasattr(lagjax, 'System2') and lagjax.simulate is lagjax.simulate;"
        "from lagjax import *; assert sweep is lagjax.sweep and plot.__name__ == 'lagjax.plot';"
        "assert {*lagjax._places(), 'System'} == {*lagjax.__all__, *results.__all__}"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and not done.stdout, done.stderr


def test_results_have_one_module_and_keep_their_old_names():
    for name in lagjax.results.__all__:
        assert getattr(lagjax, name) is getattr(lagjax.results, name)
    assert not set(lagjax.__all__) & set(lagjax.results.__all__)


VAGUE = ("What ", "How ", "Whether ", "Where ", "Which ")


def test_docstrings_begin_with_their_subject():
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for path in PACKAGE.rglob("*.py"):
        for node in nodes_of(path):
            text = ast.get_docstring(node) if isinstance(node, kinds) else None
            name = getattr(node, "name", "its head")
            assert not (text or "").startswith(VAGUE), f"{path}: {name} says {text!r}: name the subject first"


def test_files_and_classes_have_names_of_their_own():
    """A name says where to look: a file, and a class at the top of one, is called as no other one is."""
    files = [path.name for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py")]
    classes = [
        node.name for path in PACKAGE.rglob("*.py") for node in tree_of(path).body if isinstance(node, ast.ClassDef)
    ]
    for names in (files, classes):
        assert sorted(names) == sorted(set(names)), [name for name in set(names) if names.count(name) > 1]


LIMITS = re.compile(r"_?(LARGEST|LEAST|LONGEST|SMALLEST|MOST|MANY|FEW|FEWEST|DEEPEST|WIDEST|NARROWEST)(_|$)")


def test_limits_have_names_of_their_own():
    """A limit is called as no other one is, in its own module neither: who reads its name finds one number."""
    assigned = [node for path in PACKAGE.rglob("*.py") for node in tree_of(path).body if isinstance(node, ast.Assign)]
    places = [place for node in assigned for target in node.targets for place in ast.walk(target)]
    limits = [node.id.strip("_") for node in places if isinstance(node, ast.Name) and LIMITS.match(node.id)]
    assert sorted(limits) == sorted(set(limits)), [name for name in set(limits) if limits.count(name) > 1]


PREPOSITIONS = (
    "of at along in on by for after before behind beside apart around beyond under over through until within without "
    "across told asked seen"
)


def test_functions_are_no_prepositions():
    """A name says what a function does, or what it returns; `from_`, `to_`, `as_` and `with_` are Python's idioms."""
    begins = re.compile(rf"_?({'|'.join(PREPOSITIONS.split())})(_|$)")
    for path in PACKAGE.rglob("*.py"):
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef) and node.name != "at":  # of a trajectory, the public name
                assert not begins.match(node.name), f"{path}: {node.name} is not verb + object, nor a noun"


def test_every_file_of_tests_has_a_line():
    listed = re.findall(r"^\| `(\w+)(?:\.py)?` \|", (TESTS / "README.md").read_text(), flags=re.MULTILINE)
    files = [path.stem.removeprefix("test_") for path in TESTS.rglob("*.py")]
    assert sorted(listed) == sorted(files)


def test_systems_in_tests_are_shared():
    """A test that any system serves takes one of `tests/scenes.py`; how many build one of their own may only fall."""
    built = 0
    for path in TESTS.glob("*/test_*.py"):
        for test in tree_of(path).body:
            if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
                calls = [node for node in ast.walk(test) if isinstance(node, ast.Call)]
                built += sum(ast.unparse(call.func).endswith("System") for call in calls)
    assert built <= 141


def test_tests_come_in_by_doors():
    """A test of a room takes what its door offers; how many files look past a door may only fall."""
    past = set()
    for path in TESTS.rglob("*.py"):
        for node in nodes_of(path):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lagjax._"):
                room = PACKAGE.parent.joinpath(*node.module.split("."))
                files = [room / f"{alias.name}.py" for alias in node.names if alias.name.startswith("_")]
                within = room.with_suffix(".py").exists() and node.module.count(".") > 1
                past |= {path} if within or any(file.exists() for file in files) else set()
    assert len(past) <= 24
