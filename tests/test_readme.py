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


def test_readme_code(capsys):
    shown = blocks(README)
    assert shown
    for block in shown:
        exec(compile(block, "README.md", "exec"), {})
    assert "True" in capsys.readouterr().out


def test_readme_commands_and_map():
    commands = "\n".join(blocks(README, "sh"))
    assert 'pip install -e ".[test]" && python -m pytest' in commands
    assert (ROOT / re.search(r"python (examples/\S+)", commands)[1]).exists()
    package = Path(lagjax.__file__).parent
    for module in package.iterdir():
        if (module.suffix == ".py" and module.stem != "__init__") or (module / "__init__.py").exists():
            name = module.name + ("/" if module.is_dir() else "")
            assert f"`{name}`" in README, f"the map in the README lacks {name}"


PUBLIC = [getattr(lagjax, name) for name in lagjax.__all__ if callable(getattr(lagjax, name))]


@pytest.mark.parametrize(
    "thing", sweep(PUBLIC, kept=lambda thing: thing is not lagjax.work_precision), ids=lambda thing: thing.__name__
)
def test_docstrings(thing):
    assert inspect.getdoc(thing), f"{thing.__name__} has no docstring"
    for block in blocks(inspect.getdoc(thing)):
        exec(compile(block, f"{thing.__name__}.__doc__", "exec"), {})
