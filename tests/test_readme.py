"""What the README and the docstrings show is executed as it stands."""

import inspect
import re
from pathlib import Path

import pytest
from sweeps import sweep

import lagjax

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(text: str, language: str = "python") -> list[str]:
    return [inspect.cleandoc(block) for block in re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)]


def shape_of(printed: str) -> str:
    """The words of an output, with `#` for every number: the last digits and the counts of steps are the machine's."""
    return " ".join(re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", printed).split())


def test_readme_code(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # One session, as a reader would type it; what a block prints is what the README shows right after it.
    shown = re.findall(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", README, flags=re.DOTALL)
    assert len(shown) == len(blocks(README)) and sum(bool(printed) for _, printed in shown) > 5
    session = {}
    for code, printed in shown:
        exec(compile(code, "README.md", "exec"), session)
        assert shape_of(capsys.readouterr().out) == shape_of(printed)


def test_readme_commands_and_links():
    commands = "\n".join(blocks(README, "sh"))
    assert 'pip install -e ".[test]" && python -m pytest' in commands
    assert (ROOT / re.search(r"python (examples/\S+)", commands)[1]).exists()
    for linked in re.findall(r"\]\(([^)]+)\)", README):
        assert linked.startswith("https://") or (ROOT / linked).exists(), f"the README links to {linked}"


PUBLIC = [getattr(lagjax, name) for name in lagjax.__all__ if callable(getattr(lagjax, name))]
PUBLIC += [lagjax.System.explain, lagjax.System.project]
COSTLY = (lagjax.work_precision, lagjax.System.project)


@pytest.mark.parametrize(
    "thing", sweep(PUBLIC, kept=lambda thing: thing not in COSTLY), ids=lambda thing: thing.__name__
)
def test_docstrings(thing):
    assert inspect.getdoc(thing), f"{thing.__name__} has no docstring"
    for block in blocks(inspect.getdoc(thing)):
        exec(compile(block, f"{thing.__name__}.__doc__", "exec"), {})
