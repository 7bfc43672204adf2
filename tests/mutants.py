"""Mutants: small changes of the code, each of which must fail a fast test.

They are recorded in ``tests/mutants.jsonl``: those with a name break a line of the proof, the
others were drawn. ``python -m tests.mutants`` makes all one by one in a copy of the repository,
runs the tests of their module there, and prints which test has caught each; with words only the
mutants whose name, file or line of the proof has one of them. It ends with status 1 where a mutant
lives, which is a missing test, where one is no sound Python or cannot be made any more, or where
tests fail without one.
It takes an hour: run it after a change to what ``docs/privacy/proof.md`` names, and draw
mutants anew of lines that have changed.

``python -m tests.mutants --draw FILE NUMBER TEST...`` prints the first mutants of a seeded order of
a file for that record. One that changes nothing that anyone may rely on does not belong there.
"""

from __future__ import annotations

import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from dptse_env.utils.kernels import default_folder

ROOT = Path(__file__).parents[1]
SPARED = (".*", "__pycache__", "build", "dist")
"""Names that no copy needs, at any depth."""

MOST_SECONDS = 600.0
"""Time for the tests of a mutant, which may compile a kernel."""

UNSOUND = re.compile(
    r"numba\.|(Attribute|Index|Key|Name|Type|UnboundLocal)Error|ValueError: .*broadcast"
)
"""Errors of tests where a mutant is no sound Python, which shows nothing."""


class Mutant(NamedTuple):
    """A small change of the code.

    Attributes:
        path: File below the root.
        old: Text that stands there exactly once.
        new: What takes its place.
        tests: Files below ``tests``, a fast test of which must fail.
        name: What is wrong with it, empty where it was drawn.
        line: Line of the proof in ``docs/privacy/proof.md`` that it breaks, 0 for none.
    """

    path: str
    old: str
    new: str
    tests: str
    name: str = ""
    line: int = 0

    def __str__(self) -> str:
        return self.name or f"`{self.new.strip()}`"

    def applied(self) -> str:
        """Return the text of the file with the change.

        Raises:
            ValueError: The old text is not found, or more than once.
        """
        text = (ROOT / self.path).read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(
                f"{self.path} has {text.count(self.old)} times what mutant {self} changes: "
                f"{self.old!r}"
            )
        return text.replace(self.old, self.new)


def recorded() -> list[Mutant]:
    """Return all mutants."""
    lines = (ROOT / "tests" / "mutants.jsonl").read_text(encoding="utf-8").splitlines()
    return [Mutant(**json.loads(line)) for line in lines]


# --- drawing --------------------------------------------------------------------------------------

EXCHANGED = {
    "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "in": "not in",
    "not in": "in", "is": "is not", "is not": "is", "+": "-", "-": "+", "*": "/", "/": "*",
    "//": "*", "%": "//", "**": "*", "&": "|", "|": "&", "and": "or", "or": "and",
    "min": "max", "max": "min", "minimum": "maximum",
    "maximum": "minimum", "any": "all", "all": "any", "floor": "ceil", "ceil": "floor",
    "argmin": "argmax", "argmax": "argmin", "zeros": "ones", "ones": "zeros", "sorted": "list",
}  # fmt: skip
OPERATOR = re.compile(r"not in|is not|\b(?:in|is|and|or)\b|\*\*|//|[<>=!]=|[-+*/%<>&|]")


def drawn(path: str) -> Iterator[tuple[str, str]]:
    """Yield text that stands in a file once and what takes its place, in a seeded order.

    Operators, numbers and functions are exchanged, conditions turned round, and statements left
    out, at most one in a line.
    """
    text = (ROOT / path).read_text(encoding="utf-8")
    lines, done = text.splitlines(), set[int]()
    found = sorted({each for node in ast.parse(text).body for each in changes(node, lines)})
    random.Random(path).shuffle(found)
    for row, start, end, new in found:
        changed, first = lines[row][:start] + new + lines[row][end:], row
        while text.count("\n".join(lines[first : row + 1])) > 1:
            first -= 1
        if row not in done and "# fmt" not in changed:
            done.add(row)
            yield "\n".join(lines[first : row + 1]), "\n".join([*lines[first:row], changed])


def changes(node: ast.AST, lines: list[str]) -> Iterator[tuple[int, int, int, str]]:
    """Yield changes of a syntax tree: row, first column, column after the last, new text."""
    inside = [*ast.iter_child_nodes(node)]
    match node:
        case ast.FunctionDef(args=args, body=body):
            inside = [*args.defaults, *filter(None, args.kw_defaults), *body]
        case ast.ClassDef(body=inside):
            pass
        case ast.AnnAssign(value=value):
            inside = [value] if value else []
        case ast.Expr(value=ast.Constant()) | ast.JoinedStr() | ast.Import() | ast.ImportFrom():
            return
        case ast.Raise():
            inside = []
    for each in inside:
        if hasattr(each, "lineno"):
            yield from changes(each, lines)
    test = getattr(node, "test", None)
    for part, new in ((node, exchanged), (test, "not ({})".format)):
        if part and part.lineno == part.end_lineno and lines[part.lineno - 1].isascii():
            row, start, end = part.lineno - 1, part.col_offset, part.end_col_offset
            told = new(part if part is node else lines[row][start:end])
            if isinstance(part, ast.Compare | ast.BinOp | ast.BoolOp) and part is node:
                left, right = operands(node)
                sign = OPERATOR.search(lines[row], left.end_col_offset, right.col_offset)
                start, end, told = (*sign.span(), EXCHANGED[sign[0]]) if sign else (0, 0, None)
            elif isinstance(part, ast.Attribute) and part is node:
                start = end - len(part.attr)
            if told is not None:
                yield row, start, end, told


def operands(node: ast.Compare | ast.BinOp | ast.BoolOp) -> tuple[ast.AST, ast.AST]:
    """Return what stands on the two sides of the first operator."""
    match node:
        case ast.Compare(left=left, comparators=[right, *_]) | ast.BinOp(left=left, right=right):
            return left, right
    return node.values[0], node.values[1]


def exchanged(node: ast.AST) -> str | None:
    """Return what takes the place of a constant, a name or a statement, if anything does."""
    match node:
        case ast.Expr() | ast.AugAssign() | ast.Raise():
            return "pass"
        case ast.Constant(value=bool()):
            return str(not node.value)
        case ast.Constant(value=int() | float()):
            return repr(node.value + 1)
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return EXCHANGED.get(name)
    return None


# --- running --------------------------------------------------------------------------------------


def lines_of_the_proof() -> dict[int, str]:
    """Return the titles of the lines of the proof by their numbers."""
    page = (ROOT / "docs" / "privacy" / "proof.md").read_text(encoding="utf-8")
    return {int(n): title for n, title in re.findall(r"^### (\d+)\. (.+)$", page, re.MULTILINE)}


def unsound(mutants: list[Mutant]) -> Iterator[str]:
    """Yield what is wrong with mutants: one that cannot be made, two of a kind, a line without."""
    for mutant in mutants:
        try:
            ast.parse(mutant.applied())
        except (OSError, SyntaxError, ValueError) as problem:
            yield str(problem)
        yield from (
            f"{mutant}: there is no {test}"
            for test in mutant.tests.split()
            if not (ROOT / "tests" / test).is_file()
        )
    if len({mutant[:3] for mutant in mutants}) < len(mutants):
        yield "two mutants are the same"
    for line in {*lines_of_the_proof()} ^ {mutant.line for mutant in mutants if mutant.line}:
        yield f"line {line} of the proof has no mutant, or a mutant no line of the proof"


def chosen(words: list[str]) -> list[Mutant]:
    """Return the mutants whose name, file or line of the proof has one of some words."""
    return [
        mutant
        for mutant in recorded()
        if not words or {str(mutant.line)} & {*words}
        or any(word in f"{mutant} {mutant.path}" for word in words if not word.isdigit())
    ]  # fmt: skip


def failed(copy: Path, tests: list[str], **environment: str) -> str:
    """Run the fast tests of files of a copy; return the first that fails, empty if all pass.

    Raises:
        RuntimeError: They could not be run, or one failed since the code is no sound Python.
    """
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-m", "not slow", "-x", "-q", "-p", "no:cacheprovider",
         *(f"tests/{test}" for test in tests)],
        cwd=copy, capture_output=True, text=True, timeout=MOST_SECONDS, check=False,
        # Without CI pytest would cut lines short.
        env={**os.environ, "PYTHONPATH": str(copy), "CI": "true", **environment},
    )  # fmt: skip
    if ended.returncode == 0:
        return ""
    found = re.search(r"^(?:FAILED|ERROR) tests/(.+?) - (.*)$", ended.stdout, re.MULTILINE)
    if ended.returncode != 1 or found is None or UNSOUND.match(found[2]):
        raise RuntimeError(f"pytest ended with {ended.returncode}:\n{ended.stdout}{ended.stderr}")
    return found[1]


def main(words: list[str]) -> int:
    """Make some mutants, print how each fared, and return the exit status."""
    if words[:1] == ["--draw"]:
        _, path, number, *tests = words
        for old, new in islice(drawn(path), int(number)):
            print(json.dumps({"path": path, "old": old, "new": new, "tests": " ".join(tests)}))
        return 0
    if problems := [*unsound(recorded())]:
        print(*problems, sep="\n")
        return 1
    mutants = chosen(words)
    if not mutants:
        print(f"no mutant has any of {words} in its name, file or line of the proof")
        return 1
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy, kernels = Path(folder, "repository"), Path(folder, "kernels")
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*SPARED))
        # Kernels are found by their code: those of the user serve, and a mutant's are not kept.
        if default_folder().is_dir():
            shutil.copytree(default_folder(), kernels)
        environment = {"NUMBA_CACHE_DIR": str(kernels)}
        if found := failed(
            copy, sorted({t for m in mutants for t in m.tests.split()}), **environment
        ):
            print(f"without a mutant, {found} fails")
            return 1
        # Bytecode of a mutant could be taken for that of the file, which has the same size.
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        n_lived = 0
        print("| mutant | line of the proof | killed by | seconds |\n| :-- | :-- | :-- | --: |")
        for mutant in mutants:
            file, start = copy / mutant.path, time.monotonic()
            kept = shutil.copy2(file, Path(folder, "kept"))
            file.write_text(mutant.applied(), encoding="utf-8")
            try:
                killer = failed(copy, mutant.tests.split(), **environment)
                told = killer or "**lives**"
            except RuntimeError as problem:
                killer, told = "", "**nothing that tells**"
                print(problem, file=sys.stderr)
            shutil.copy2(kept, file)
            n_lived += not killer
            seconds = time.monotonic() - start
            print(
                f"| {mutant} | {mutant.line} | {told} | {seconds:.0f} |",
                flush=True,
            )
    print(f"\n{len(mutants) - n_lived} of {len(mutants)} mutants die")
    return int(n_lived > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
