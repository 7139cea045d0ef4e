"""What the README, the pages of `docs/` and the docstrings show is executed as it stands."""

import inspect
import re
from pathlib import Path

import pytest
from sweeps import sweep

import lagjax

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
# The guide goes on from the README, page after page in the order in which that names them.
GUIDE = [ROOT / name for name in dict.fromkeys(re.findall(r"docs/guide/\w+\.md", README))]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(text: str, language: str = "python") -> list[str]:
    return [inspect.cleandoc(block) for block in re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)]


def shape_of(printed: str) -> str:
    """The words of an output, with `#` for every number: the last digits and the counts of steps are the machine's."""
    return " ".join(re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", printed).split())


@pytest.mark.parametrize(
    "pages",
    [[], pytest.param(GUIDE, marks=pytest.mark.slow)],  # ten pages, which take five times as long as the README
    ids=["README", "and the guide"],
)
def test_readme_code(pages, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # One session, as a reader would type it; what a block prints is what the page shows right after it.
    session, prints = {}, 0
    for page in (ROOT / "README.md", *pages):
        text = page.read_text()
        shown = re.findall(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", text, flags=re.DOTALL)
        assert len(shown) == len(blocks(text))
        for code, printed in shown:
            exec(compile(code, page.name, "exec"), session)
            assert shape_of(capsys.readouterr().out) == shape_of(printed)
            prints += bool(printed)
    assert prints > (5 if pages else 1)


def test_the_readme_is_a_front_page():
    assert len(README.splitlines()) <= 150
    assert {page for page in PAGES if page.parent.name == "guide"} == set(GUIDE)


def test_readme_commands_and_links():
    commands = "\n".join(blocks(README, "sh"))
    assert 'pip install -e ".[test]" && python -m pytest' in commands
    assert (ROOT / re.search(r"python (examples/\S+)", commands)[1]).exists()
    for page in PAGES:
        text = page.read_text()
        titles = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
        headings = {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
        for linked in re.findall(r"\]\(([^)]+)\)", text):
            if linked.startswith("#"):
                assert linked[1:] in headings, f"{page} links to the section {linked}"
                continue
            assert linked.startswith("https://") or (page.parent / linked).exists(), f"{page} links to {linked}"
        # Programs that a page names are there.
        for name in re.findall(r"`python ((?:examples|benchmarks)/\w+\.py)", text):
            assert (ROOT / name).exists(), f"{page} names {name}"
        for name in re.findall(r"`python -m (benchmarks\.\w+)", text):
            assert (ROOT / (name.replace(".", "/") + ".py")).exists(), f"{page} names {name}"


def methods(kind: type) -> dict[str, object]:
    """The public methods of a class whose docstrings have examples."""
    own = {name: value for name, value in vars(kind).items() if name[0] != "_" and callable(value)}
    return {name: value for name, value in own.items() if "```python" in (inspect.getdoc(value) or "")}


PUBLIC = {name: getattr(lagjax, name) for name in (*lagjax.__all__, *lagjax.results.__all__)}
PUBLIC |= {f"designs.{name}": getattr(lagjax.designs, name) for name in lagjax.designs.__all__}
PUBLIC = {name: thing for name, thing in PUBLIC.items() if callable(thing)}
METHODS = {f"{name}.{own}": of for name, it in PUBLIC.items() if inspect.isclass(it) for own, of in methods(it).items()}
# Those that take a third of a second or more: their subjects have tests of their own.
COSTLY = (
    "work_precision", "System.project", "Trajectory.animate", "Trajectory.to_pandas", "Trajectory.health", "FineOutput",
    "System", "branch_off", "conserved_quantities", "equilibrium", "linearize", "lyapunov_spectrum", "normal_modes",
    "samples", "steady_motion", "sweep",
)  # fmt: skip


@pytest.mark.parametrize("name", sweep(list(PUBLIC | METHODS), kept=lambda name: name not in COSTLY))
def test_docstrings(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some examples write a file
    thing = (PUBLIC | METHODS)[name]
    assert inspect.getdoc(thing), f"{name} has no docstring"
    for block in blocks(inspect.getdoc(thing)):
        exec(compile(block, f"{name}.__doc__", "exec"), {})
