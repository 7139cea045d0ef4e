"""`Findings`, the result of `check`: each finding with what to change, errors first."""

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from lagjax._interface import show_str

Level = Literal["error", "warning", "advice"]
_ORDER = {"error": 0, "warning": 1, "advice": 2}
_SHOWN, _WIDTH = 12, 110  # findings that fit on one screen, and its columns


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, suspicious or worth knowing about a scene at a state.

    - `kind`: a short, stable name for use in programs; the docstring of `lagjax.check` lists all of them.
    - `level`: "error" where the motion cannot start or would be wrong, "warning" where it is probably not the intended
      one, "advice" where it is right but could be cheaper or more accurate.
    - `where`: the coordinates, parameters or constraints it is about, by the names the user gave them.
    - `message`: what is wrong and what to change.
    """

    kind: str
    level: Level
    where: tuple[str, ...]
    message: str

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        text = f"{self.level:8s} {self.kind}: {self.message}"
        return textwrap.fill(text, _WIDTH, subsequent_indent=" " * 9, break_long_words=False, break_on_hyphens=False)


@dataclass(frozen=True)
class Findings:
    """The findings of `lagjax.check`, errors first: iterate over it, or print it.

    `ok` is True without an error; `kinds` are the kinds that were found; `omitted` says what was not looked at, in a
    large scene, and is empty elsewhere.
    """

    found: tuple[Finding, ...]
    omitted: str = ""

    @classmethod
    def sort(cls, found: list[Finding], omitted: str = "") -> "Findings":
        """Return the findings by level, those of one level in the order of `found`."""
        return cls(tuple(sorted(found, key=lambda finding: _ORDER[finding.level])), omitted)

    @property
    def ok(self) -> bool:
        """True if there is no error among them."""
        return not any(finding.level == "error" for finding in self.found)

    @property
    def kinds(self) -> frozenset[str]:
        """The kinds that were found."""
        return frozenset(finding.kind for finding in self.found)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.found)

    def __len__(self) -> int:
        return len(self.found)

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        more = len(self.found) - _SHOWN
        lines = [*map(str, self.found[:_SHOWN]), *([f"… and {more} more"] if more > 0 else [])] or ["Nothing found."]
        return "\n".join(lines + textwrap.wrap(self.omitted, _WIDTH))
