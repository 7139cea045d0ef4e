"""Formulas as text, in Python and in LaTeX, in the order of a textbook: m*g*l*sin(theta), positive terms first.

The factors of a product are ordered: numbers, parameters (masses first), coordinates, functions, velocities. Factors
with a negative power become the denominator of a fraction.
"""

import keyword
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from lagjax._program import LOOK_UPS, OPERATIONS, Formulas, Product, Sum, Table

LEAST_NAMED = 5  # operations of a part that has a name where it comes twice; sin(a - b) stays where it is
_SHORT = 6  # digits of a number that is printed as it is; another one is a fraction where that is simple
_LARGEST_DENOMINATOR, _ROUNDING = 12, 4e-16
_NOT_FINITE = {"inf": ("inf", r"\infty"), "nan": ("nan", r"\mathrm{nan}")}  # in Python and in LaTeX
_PARAMETER, _COORDINATE, _FUNCTION, _VELOCITY = range(4)


class Style(NamedTuple):
    """A notation, Python or LaTeX: functions that combine the texts of operands."""

    times: str
    power: Callable[[str, str], str]
    fraction: Callable[[str, str], str]
    group: Callable[[str], str]
    root: Callable[[str], str]
    call: Callable[[str, Sequence[str], str], str]  # operation, operands, a power or nothing


class Name(NamedTuple):
    """The name of an input in Python and in LaTeX, and its `place` in the order of factors."""

    text: str
    latex: str
    place: int


def _call_text(op: str, xs: Sequence[str], power: str) -> str:
    form = OPERATIONS[op].text if op in OPERATIONS else None
    called = form.format(*xs) if form else f"{op}({', '.join(xs)})"
    if power:
        called = f"({called})" if form and not form.startswith("where") else called
    return f"{called}**{power}" if power else called


_WORDS = {"log": "ln", "asin": "arcsin", "acos": "arccos", "atan": "arctan"}
_COMMANDS = frozenset(("sin", "cos", "tan", "exp", "ln", "sinh", "cosh", "tanh", "arcsin", "arccos", "arctan"))


def _call_latex(op: str, xs: Sequence[str], power: str) -> str:
    if op in OPERATIONS and (form := OPERATIONS[op].latex):
        called = form.format(*xs)
        return f"{_group_latex(called)}^{{{power}}}" if power else called
    word = _WORDS.get(op, op)
    command = f"\\{word}" if word in _COMMANDS else f"\\operatorname{{{word}}}"
    plain = len(xs) == 1 and re.fullmatch(r"\\?\w+(_\{\w+\})?", xs[0])
    inner = f" {xs[0]}" if plain else _group_latex(", ".join(xs))
    return f"{command}^{{{power}}}{inner}" if power else f"{command}{inner}"


def _group_latex(x: str) -> str:
    return rf"\left({x}\right)"


PYTHON = Style(
    "*", lambda x, p: f"{x}**{p}", lambda n, d: f"{n}/{d}", lambda x: f"({x})", lambda x: f"sqrt({x})", _call_text
)
LATEX = Style(
    r" \, ", lambda x, p: f"{x}^{{{p}}}", lambda n, d: rf"\frac{{{n}}}{{{d}}}", _group_latex,
    lambda x: rf"\sqrt{{{x}}}", _call_latex,
)  # fmt: skip


class FormulaWriter:
    """Writes sums of `formulas` as text in a style; `names` of inputs, `parts` are atoms with names of their own."""

    def __init__(self, formulas: Formulas, names: Sequence[Name], style: Style, parts: dict[int, str]):
        self.formulas, self.names, self.style, self.parts = formulas, names, style, parts

    def write(self, x: Sum) -> str:
        """Return the text of a sum, positive terms first."""
        ordered = sorted(x.items(), key=lambda term: (term[1] < 0, self._term_rank(term[0])))
        text = ""
        for product, c in ordered:
            sign = " - " if c < 0 else " + "
            term = self._product_text(product, abs(c))
            text += sign + term if text else ("-" if c < 0 else "") + term
        return text or "0"

    def write_part(self, atom: int) -> str:
        """Return the formula that the name of a part stands for."""
        of = self.formulas.atoms[atom]
        sums = [self.write(dict(x)) for x in of.operands]
        return sums[0] if of.kind == "sum" else self.style.call(self._function_call(of), sums, "")

    @staticmethod
    def _function_call(atom) -> str:
        if atom.kind not in LOOK_UPS:
            return atom.kind
        return f"{'table' if atom.kind == 'take' else 'locate'}{atom.position // 2 + 1}"

    def _product_text(self, product: Product, c: float) -> str:
        above, below = _number_text(c) if math.isfinite(c) else (_NOT_FINITE[str(c)][self.style is LATEX], "1")
        factors = sorted(product, key=lambda of: self._factor_rank(of[0]))
        upper = [above] * (above != "1") + [self._factor_text(atom, p) for atom, p in factors if p > 0]
        lower = [below] * (below != "1") + [self._factor_text(atom, -p) for atom, p in factors if p < 0]
        times = self.style.times
        if not lower:
            return times.join(upper) or "1"
        bottom = times.join(lower)
        if self.style is PYTHON and len(lower) > 1:
            bottom = f"({bottom})"
        return self.style.fraction(times.join(upper) or "1", bottom)

    def _factor_text(self, atom: int, power: float) -> str:
        of, style = self.formulas.atoms[atom], self.style
        exponent = "" if power == 1 else _exponent_text(power, style)
        if atom in self.parts:
            base = self.parts[atom]
        elif of.kind == "input":
            base = (self.names[of.position].text, self.names[of.position].latex)[style is LATEX]
        elif of.kind == "sum":
            inner = self.write(dict(of.operands[0]))
            if power == 0.5:
                return style.root(inner)
            base = style.group(inner)
        else:
            sums = [self.write(dict(x)) for x in of.operands]
            return (
                style.root(style.call(self._function_call(of), sums, ""))
                if power == 0.5
                else style.call(self._function_call(of), sums, exponent)
            )
        if power == 0.5:
            return style.root(base)
        return style.power(base, exponent) if exponent else base

    def write_tables(self) -> dict[str, str]:
        """Return the first and last entries of each table, by its name."""
        return {f"table{k}": " … ".join(self._ends(table)) for k, table in enumerate(self.formulas.tables, 1)}

    def _ends(self, table: Table) -> list[str]:
        if table.numbers is not None:
            return [f"{x:.6g}" for x in table.entries[[0, -1]]]
        return [self.names[i].text for i in (table.positions[0], table.positions[-1])]

    # ---- the order of a textbook ----

    def _factor_rank(self, atom: int) -> tuple:
        """Return the sort key of a factor within a product."""
        of = self.formulas.atoms[atom]
        if of.kind == "input":
            name = self.names[of.position]
            return name.place, 0 if _MASSES.fullmatch(name.text) else 1, name.text
        inner = [self._factor_rank(a) for x in of.operands for product, _ in x for a, _ in product]
        largest = max((place[0] for place in inner), default=_PARAMETER)
        if atom in self.parts:
            return largest, 3, self.parts[atom]
        if of.kind == "sum":
            first = min((place[1:3] for place in inner if place[0] == largest), default=(9, ""))
            return largest, first[0] if largest == _PARAMETER else 2, first[1]
        return max(largest, _FUNCTION), of.kind != "sin", of.kind, atom

    def _term_rank(self, product: Product) -> tuple:
        """Return the sort key of a term within a sum: terms with velocities after others, constants last."""
        places = sorted(self._factor_rank(atom) for atom, _ in product)
        return not product, bool(places) and places[-1][0] == _VELOCITY, [str(place) for place in places]


_MASSES = re.compile(r"(m|M|J|I|mass|inertia)[_\d]*")


def _number_text(c: float) -> tuple[str, str]:
    """Return numerator and denominator of a positive number as text: ("0.5", "1"), or ("1", "3")."""
    simple = Fraction(c).limit_denominator(_LARGEST_DENOMINATOR)
    with np.errstate(over="ignore", under="ignore"):
        single = np.float32(c)
    for digits in (_SHORT, 15):
        shorter = f"{c:.{digits}g}".replace("e+", "e").replace("e0", "e").replace("e-0", "e-")
        if abs(float(shorter) - c) <= _ROUNDING * c:
            return shorter, "1"
        if simple and abs(float(simple) - c) <= _ROUNDING * c:
            return str(simple.numerator), str(simple.denominator)
        if float(single) == c:  # of a scene in float32, which has 9.81 as 9.8100004196167
            return str(single), "1"
    return repr(c), "1"


def _exponent_text(power: float, style: Style) -> str:
    above, below = _number_text(power)
    text = above if below == "1" else f"{above}/{below}"
    halves = Fraction(power).limit_denominator(_LARGEST_DENOMINATOR)
    if halves.denominator > 1 and float(halves) == power:
        text = f"{halves.numerator}/{halves.denominator}"
    return f"({text})" if style is PYTHON and "/" in text else text


def shared_parts(formulas: Formulas, sums: Iterable[Sum]) -> list[int]:
    """Return the atoms that occur at least twice and cost `LEAST_NAMED` operations or more, inner ones first."""
    counts: Counter[int] = Counter()
    waiting = [dict(x) for x in sums]
    while waiting:
        for product in waiting.pop():
            for atom, _ in product:
                counts[atom] += 1
                if counts[atom] == 1:
                    waiting += [dict(x) for x in formulas.atoms[atom].operands]
    found = (atom for atom, count in counts.items() if count > 1 and formulas.cost(atom) >= LEAST_NAMED)
    return sorted(found)


# ---- names -----------------------------------------------------------------------------------------------------------


def input_names(coordinates: Sequence[str], numbers: Sequence[str]) -> list[Name]:
    """Return a `Name` for each of q, q̇, t and the parameters, from labels such as q['theta1'] and params['m']."""
    labels, n = [*coordinates, "t", *numbers], len(coordinates)
    texts = short_names(labels)
    of_rates = {f"{x}_dot" for x in texts[:n]}
    texts = ["_".join(re.findall(r"\w+", of)) if x in of_rates else x for x, of in zip(texts, labels, strict=True)]
    q = [Name(x, latex_name(x), _COORDINATE) for x in texts[:n]]
    rates = [Name(f"{x}_dot", latex_name(x, dot=True), _VELOCITY) for x in texts[:n]]
    return [*q, *rates, Name("t", "t", _COORDINATE), *(Name(x, latex_name(x), _PARAMETER) for x in texts[n + 1 :])]


def short_names(labels: Sequence[str]) -> list[str]:
    """Return identifiers for labels such as q['theta1']: the key alone (theta1) where it is unique."""
    short = [x + "_" * (keyword.iskeyword(x) or x in OPERATIONS or x in _NOT_FINITE) for x in map(_identifier, labels)]
    often = Counter(short)
    return [x if often[x] == 1 else "_".join(re.findall(r"\w+", of)) for x, of in zip(short, labels, strict=True)]


def _identifier(label: str) -> str:
    """Return theta1 for q['theta1'], q0 for q[0], arm2 for q['arm'][2], r for q.r."""
    root, *keys = re.findall(r"\w+", label)
    name = ""
    for key in keys:
        name = f"{name}_{key}" if name and not key.isdigit() and name[-1:] != "_" else name + key
    return name if name and not name[0].isdigit() else root + name


_LETTERS = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi "
    "omega Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega"
).split()


def latex_name(name: str, dot: bool = False) -> str:
    r"""Return \theta_{1} for theta1, m_{\mathrm{cart}} for m_cart; with `dot` its time derivative."""
    name = name.rstrip("_")
    base, below = re.fullmatch(r"(.+?)_?(\d*|(?<=_)\w+)", name).groups()  # type: ignore[union-attr]
    if "_" in name.strip("_"):
        base, below = name.strip("_").split("_", 1)
    if len(base) == 1 and not base.isascii():
        word = unicodedata.name(base, "").rpartition(" ")[2]
        base = word.lower() if "SMALL" in unicodedata.name(base, "") else word.capitalize()
    base = f"\\{base}" if base in _LETTERS else base if len(base) == 1 else rf"\mathrm{{{base}}}"
    base = rf"\dot{{{base}}}" if dot else base
    below = below.replace("_", r"\_")
    if not (below.isdigit() or len(below) < 2):
        below = rf"\mathrm{{{below}}}"
    return f"{base}_{{{below}}}" if below else base
