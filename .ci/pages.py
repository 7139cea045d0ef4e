"""Makes the pages of the reference at build time: the hook that `mkdocs.yml` names.

The README is the front page, and the files of `docs/` come after it. Every public name has a page, in the groups of the
package's own docstring; every example has one, whose Markdown cells are text, whose code is code, and whose picture
stands on top where `examples/gallery` holds it. Names in code are links to their pages. Nothing of this is a file in
the repository.
"""

import ast
import inspect
import os
import re
import sys
from pathlib import Path

from latex2mathml.converter import convert as latex_to_mathml
from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor
from mkdocs.structure.files import File

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
PICTURES = EXAMPLES / "gallery"
sys.path.insert(0, str(ROOT))

import lagjax  # noqa: E402

PUBLIC = (*lagjax.__all__, *lagjax.results.__all__)

# ---- what there is -----------------------------------------------------------------------------------------------


def groups() -> dict[str, list[str]]:
    """The public names by the headings of the package's docstring; those that it forgets come last, under "Others"."""
    _, *parts = re.split(r"^\*\*(.+)\*\*$", inspect.getdoc(lagjax), flags=re.MULTILINE)
    public, result = set(PUBLIC), {}
    for title, text in zip(parts[::2], parts[1::2], strict=True):
        names = [name for name in re.findall(r"`(\w+)`", text) if name in public]
        result[title] = list(dict.fromkeys(names))
        public -= set(names)
    return result | ({"Others": sorted(public)} if public else {})


def makers(name: str) -> list[str]:
    """The public functions, and methods of public classes, that return the class `name`, by their annotations."""
    owners = {"": lagjax} | {f"{n}.": getattr(lagjax, n) for n in PUBLIC if inspect.isclass(getattr(lagjax, n))}
    found = []
    for prefix, owner in owners.items():
        for member in PUBLIC if owner is lagjax else vars(owner):
            thing = inspect.getattr_static(owner, member)
            returned = getattr(thing, "__annotations__", {}).get("return", "")
            text = returned if isinstance(returned, str) else getattr(returned, "__name__", "") + str(returned)
            if (
                member != "from_fields"
                and member[0] != "_"
                and not inspect.isclass(thing)
                and re.search(rf"\b{name}\b", text)
            ):
                found.append(prefix + member)
    return found


def examples() -> list[Path]:
    """The examples that have a page: all."""
    return sorted(EXAMPLES.glob("*.py"))


# ---- their pages -------------------------------------------------------------------------------------------------


def page_of_name(name: str) -> str:
    """What mkdocstrings makes of the docstring of a public name and of its members."""
    thing = getattr(lagjax, name)
    if inspect.ismodule(thing):
        return f"# lagjax.{name}\n\n::: lagjax.{name}\n    options: {{show_root_heading: false, heading_level: 2}}\n"
    if not inspect.isclass(thing) and not inspect.isfunction(thing):  # an instance, which its class explains
        return f"# lagjax.{name}\n\n{inspect.getdoc(thing)}\n"
    return f"::: lagjax.{name}\n"


def page_of_example(path: Path) -> str:
    """A script as a page. Cells begin with `# %%`; without any, the docstring is the text and the rest the code."""
    source = path.read_text()
    if "\n# %%" not in source:
        lines, docstring = source.splitlines(), ast.get_docstring(ast.parse(source)) or path.stem
        title, _, text = docstring.partition("\n")
        after = ast.parse(source).body[0].end_lineno
        source = "\n".join(["# %% [markdown]", f"# # {title.rstrip('.')}", *_commented(text), "# %%", *lines[after:]])
    pictures = [f"![]({picture.relative_to(EXAMPLES)})" for picture in sorted(PICTURES.glob(f"{path.stem}.*"))]
    texts = [_in_markdown(marker, cell) for marker, cell in _cells(source) if cell]
    heading, _, first = texts[0].partition("\n")
    return "\n\n".join([heading, *pictures, first, *texts[1:], f"[`examples/{path.name}`]({path.name})"]) + "\n"


def _commented(text: str) -> list[str]:
    return [f"# {line}" for line in text.splitlines()]


def _in_markdown(marker: str, cell: str) -> str:
    if "[markdown]" not in marker:
        return f"```python\n{cell}\n```"
    quoted = cell.startswith(('"""', 'r"""'))
    return _with_formulas(inspect.cleandoc(ast.literal_eval(cell) if quoted else re.sub(r"(?m)^# ?", "", cell)))


def _with_formulas(text: str) -> str:
    """Formulas between $ or $$ in MathML, which browsers draw themselves."""
    text = re.sub(
        r"\$\$(.+?)\$\$", lambda found: latex_to_mathml(found[1].strip(), display="block"), text, flags=re.DOTALL
    )
    return re.sub(r"\$([^$`\n][^$`]*?)\$", lambda found: latex_to_mathml(found[1].strip()), text)


def _cells(body: str) -> list[tuple[str, str]]:
    """(what stands behind `# %%`, the cell) in order."""
    first, *rest = re.split(r"^# %%(.*)$", body, flags=re.MULTILINE)
    cells = [("", first), *zip(rest[::2], rest[1::2], strict=True)]
    return [(marker, cell.strip()) for marker, cell in cells]


# ---- what mkdocs calls -------------------------------------------------------------------------------------------


def on_config(config):
    """The navigation, and the extension for docstrings that show one line after `>>>`."""
    config.markdown_extensions.append(Prompts())
    config.nav = [
        {"lagjax": "index.md"},
        {"Guide": [{page.stem: _on_the_site(page).as_posix()} for page in guide()]},
        {"Method and figures": [f"{name}.md" for name in ("method", "benchmarks", "problems")]},
        {"Reference": [{"By purpose": "reference.md"}, *_reference()]},
        {"Examples": [{path.stem.replace("_", " "): f"{path.stem}.md"} for path in examples()]},
        {
            "Project": [
                "development.md",
                {"Contributing": "CONTRIBUTING.md"},
                {"Changes": "CHANGELOG.md"},
                "security.md",
                "release.md",
            ]
        },
    ]
    return config


def _reference() -> list[dict]:
    return [{title: [{name: f"reference/{name}.md"} for name in names]} for title, names in groups().items()]


def on_files(files, config):
    """Adds all pages, and the files that they show or link to."""
    texts = {"reference.md": f"# By purpose\n\n{inspect.getdoc(lagjax)}\n"}
    texts |= {f"reference/{name}.md": page_of_name(name) for name in PUBLIC}
    texts |= {f"{path.stem}.md": page_of_example(path) for path in examples()}
    linked = set()
    for written in (Path("README.md"), Path("CONTRIBUTING.md"), Path("CHANGELOG.md"), *_pages()):
        texts[_on_the_site(written).as_posix()] = _moved(written, linked)
    for name, text in texts.items():
        files.append(File.generated(config, name, content=text))
    for path in linked:
        name = _on_the_site(path).as_posix()
        if (ROOT / path).is_file() and name not in texts and path.parts[0] != "examples":
            files.append(File.generated(config, name, abs_src_path=str(ROOT / path)))
    return files


def _pages() -> list[Path]:
    """The files of `docs/`, from the root of the repository."""
    return sorted(path.relative_to(ROOT) for path in (ROOT / "docs").rglob("*.md"))


def guide() -> list[Path]:
    """The pages of the guide, in the order in which the README names them."""
    return [Path(name) for name in dict.fromkeys(re.findall(r"docs/guide/\w+\.md", (ROOT / "README.md").read_text()))]


def _on_the_site(path: Path) -> Path:
    """The place of a file of the repository on the site, whose top has what `docs/` and `examples/` hold."""
    if path == Path("README.md"):
        return Path("index.md")
    return Path(*path.parts[1:]) if path.parts[0] in ("docs", "examples") else path


def _moved(written: Path, linked: set[Path]) -> str:
    """The text of a file of the repository with its links as they are on the site; they are added to `linked`."""
    here = _on_the_site(written).parent

    def link(match):
        address, *heading = match["address"].split("#")
        if not address or ":" in address:
            return match[0]
        path = Path(os.path.normpath(written.parent / address))
        linked.add(path)
        return match["before"] + "#".join([os.path.relpath(_on_the_site(path), here), *heading]) + match["after"]

    text = (ROOT / written).read_text()
    return re.sub(r'(?P<before>\]\(|src=")(?P<address>[^)"\s]+)(?P<after>\)|")', link, text)


def on_page_content(html, page, config, files):
    """Turns names in code, as `simulate` or `lagjax.simulate`, into links to their pages."""
    here, names = Path(page.file.dest_uri), "|".join(PUBLIC)

    def link(match):
        name = match["name"]
        if here.stem == name or match["before"].startswith(("<a", "<h", "<pre")):
            return match[0]
        up = "../" * (len(here.parts) - 1)
        return f'{match["before"]}<a href="{up}reference/{name}.html">{match["code"]}</a>'

    makers_here = makers(here.stem) if inspect.isclass(getattr(lagjax, here.stem, None)) else ()
    if makers_here:
        returned_by = ", ".join(f"<code>{maker}</code>" for maker in makers_here)
        html = html.replace("</h1>", f"</h1>\n<p>Returned by {returned_by}.</p>", 1)
    before = r"(?P<before>(?:<(?:a|h\d|pre)\b[^>]*>(?:<span></span>)?)?)"  # code in these is left alone
    pattern = rf"{before}(?P<code><code>(?:lagjax\.)?(?P<name>{names})\b[^<]*</code>)"
    return re.sub(pattern, link, html)


class Prompts(Extension):
    """A line after `>>>` is code, and not a quotation of a quotation of a quotation."""

    def extendMarkdown(self, md: Markdown):  # noqa: D102
        md.preprocessors.register(_Prompts(md), "prompts", 100)


class _Prompts(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        text = re.sub(r"(?m)^>>> (.*)$", r"```python\n\1\n```", "\n".join(lines))
        return text.split("\n")
