"""Measures of how densely Python code is written, and how its docstrings name things.

``PYTHONPATH=tests python -m readability FOLDER ...`` prints them, a row for each folder.
"""

import argparse
import ast
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from gsmap.utils.words import markdown_table

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
DOCUMENTED = (ast.Module, ast.ClassDef, *FUNCTIONS)
MANY_PARAMETERS = 3

# "Return what the head reads", "those of two groups", "says whether"
CLAUSE = re.compile(
    r"\bwhat\b|\b(that|those) of\b|\b(say|says|tell|tells) (whether|which|how|whose)\b",
    re.IGNORECASE,
)
IRREGULAR_PARTICIPLES = re.compile(
    "brought|built|chosen|cut|drawn|found|given|held|kept|known|laid|left|made|met|put|said|seen|"
    "sent|shown|spread|taken|thrown|told|won|worn|written"
)
NOUNS_IN_ED = {"feed", "need", "seed", "speed"}


@dataclass
class Counts:
    """Counts of a part of the source.

    Attributes:
        lines: Lines of code, without blank lines, comments and docstrings.
        pairs: Assignments of several values to several names, ``a, b = x, y``.
        splats: Calls with an unpacked positional argument, ``f(*values)``.
        comprehensions: Comprehensions and generator expressions.
        arguments: Arguments of all calls.
        named_arguments: Arguments that calls give by name.
        wide_functions: Public functions with at least three parameters.
        described_functions: Functions among them whose docstring has ``Args:``.
        docstrings: Docstrings of functions and classes.
        clauses: Docstrings among them whose first paragraph names a thing by a clause.
        functions: Functions and methods.
        participles: Functions among them named by a bare participle.
    """

    lines: int = 0
    pairs: int = 0
    splats: int = 0
    comprehensions: int = 0
    arguments: int = 0
    named_arguments: int = 0
    wide_functions: int = 0
    described_functions: int = 0
    docstrings: int = 0
    clauses: int = 0
    functions: int = 0
    participles: int = 0


class Reader(ast.NodeVisitor):
    """Visitor that counts one module.

    Args:
        source: Text of the module.
        counts: Counts to add to.
    """

    def __init__(self, source: str, counts: Counts) -> None:
        self.counts = counts
        self.is_public = True
        tree = ast.parse(source)
        docstring_lines = set()
        for node in ast.walk(tree):
            if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
                docstring = node.body[0]
                docstring_lines |= set(range(docstring.lineno, docstring.end_lineno + 1))
        for number, line in enumerate(source.splitlines(), start=1):
            text = line.strip()
            if text and not text.startswith("#") and number not in docstring_lines:
                counts.lines += 1
        self.visit(tree)

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, COMPREHENSIONS):
            self.counts.comprehensions += 1
        super().visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        has_several_targets = any(isinstance(target, ast.Tuple) for target in node.targets)
        if isinstance(node.value, ast.Tuple) and has_several_targets:
            self.counts.pairs += 1
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        self.counts.arguments += len(node.args) + len(node.keywords)
        self.counts.named_arguments += sum(keyword.arg is not None for keyword in node.keywords)
        if any(isinstance(argument, ast.Starred) for argument in node.args):
            self.counts.splats += 1
        self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._visit_body(node, is_public=not node.name.startswith("_"))

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self.counts.functions += 1
        if is_participle(node.name):
            self.counts.participles += 1
        is_public = self.is_public and not node.name.startswith("_")
        if is_public and len(parameters(node)) >= MANY_PARAMETERS:
            self.counts.wide_functions += 1
            if "Args:" in (ast.get_docstring(node) or ""):
                self.counts.described_functions += 1
        self._visit_body(node, is_public=False)  # functions inside of a function are private

    visit_AsyncFunctionDef = visit_FunctionDef

    def _visit_body(self, node: ast.AST, is_public: bool) -> None:
        docstring = ast.get_docstring(node)
        if docstring:
            self.counts.docstrings += 1
            if CLAUSE.search(docstring.split("\n\n")[0]):
                self.counts.clauses += 1
        outside = self.is_public
        self.is_public = outside and is_public
        self.generic_visit(node)
        self.is_public = outside


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Names of the parameters, without ``self`` and ``cls``."""
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return [argument.arg for argument in arguments if argument.arg not in ("self", "cls")]


def is_participle(name: str) -> bool:
    """Whether a name is one word and a past participle, such as ``moved``."""
    if IRREGULAR_PARTICIPLES.fullmatch(name):
        return True
    return re.fullmatch(r"[a-z]+ed", name) is not None and name not in NOUNS_IN_ED


@cache
def count_file(path: Path) -> Counts:
    """Count a module, once per process."""
    counts = Counts()
    Reader(path.read_text(encoding="utf-8"), counts)
    return counts


def count(*paths: Path) -> Counts:
    """Count files, and all modules of folders."""
    total = Counts()
    for path in paths:
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        for file in files:
            for name, number in vars(count_file(file)).items():
                setattr(total, name, getattr(total, name) + number)
    return total


def percentage(part: int, whole: int) -> int:
    """Share of a part, rounded."""
    return round(100 * part / max(whole, 1))


def row(path: Path) -> list[str]:
    """Measures of a folder, per 1,000 lines or in percent."""
    counts = count(path)
    cells = [str(path), f"{counts.lines:,}"]
    for number in (counts.pairs, counts.splats, counts.comprehensions):
        cells.append(f"{1000 * number / max(counts.lines, 1):.1f}")
    for part, whole in (
        (counts.named_arguments, counts.arguments),
        (counts.described_functions, counts.wide_functions),
        (counts.clauses, counts.docstrings),
        (counts.participles, counts.functions),
    ):
        cells.append(f"{percentage(part, whole)} %")
    return cells


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    return parser.parse_args()


def main() -> None:
    args = parse_args()
    head = ["folder", "lines", "pairs", "splats", "comprehensions"]
    head += ["by name", "`Args:`", "clauses", "participles"]
    print(markdown_table(head, [row(folder) for folder in args.folders]))


if __name__ == "__main__":
    main()
