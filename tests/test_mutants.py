"""Every mutant of ``tests/mutants.py`` can be made."""

import ast

from .mutants import MUTANTS, ROOT


def test_every_mutant_can_be_made_and_no_two_are_the_same():
    for mutant in MUTANTS:
        text = (ROOT / mutant.file).read_text(encoding="utf-8")
        changed = mutant.applied(text)
        assert changed.count("\n") == text.count("\n"), mutant.name
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text)), mutant.name
        assert all((ROOT / "tests" / test).is_file() for test in mutant.tests.split()), mutant.name
    for key in ({m.name for m in MUTANTS}, {(m.path, m.old, m.new) for m in MUTANTS}):
        assert len(key) == len(MUTANTS)
