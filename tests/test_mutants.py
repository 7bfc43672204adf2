"""Every mutant of ``tests/mutants.py`` can be made, and every line of the proof has one."""

import ast
import builtins

from .mutants import MUTANTS, ROOT, lines_of_the_proof


def names_in(text):
    """Return the names that a file reads or binds."""
    found = set(dir(builtins))
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Name(id=name) | ast.arg(arg=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.alias(name=name, asname=other):
                found.add(other or name)
    return found


def test_every_mutant_can_be_made_and_no_two_are_the_same():
    for mutant in MUTANTS:
        text = (ROOT / mutant.file).read_text(encoding="utf-8")
        changed = mutant.applied(text)
        assert changed.count("\n") == text.count("\n"), mutant.name
        assert names_in(changed) <= names_in(text), mutant.name
        assert all((ROOT / "tests" / test).is_file() for test in mutant.tests.split()), mutant.name
    for key in ({m.name for m in MUTANTS}, {(m.path, m.old, m.new) for m in MUTANTS}):
        assert len(key) == len(MUTANTS)


def test_every_line_of_the_proof_has_a_mutant():
    assert {mutant.line for mutant in MUTANTS} == set(lines_of_the_proof())
