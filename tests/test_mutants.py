"""Every mutant of ``tests/mutants.py`` can be made, and every line of the proof has one."""

from .mutants import MUTANTS, ROOT, lines_of_the_proof


def test_every_mutant_can_be_made_and_no_two_are_the_same():
    for mutant in MUTANTS:
        text = (ROOT / mutant.file).read_text(encoding="utf-8")
        changed = mutant.applied(text)
        assert changed.count("\n") == text.count("\n"), mutant.name
        compile(changed, mutant.path, "exec")
        assert all((ROOT / "tests" / test).is_file() for test in mutant.tests.split()), mutant.name
    for key in ({m.name for m in MUTANTS}, {(m.path, m.old, m.new) for m in MUTANTS}):
        assert len(key) == len(MUTANTS)


def test_every_line_of_the_proof_has_a_mutant():
    assert {mutant.line for mutant in MUTANTS} == set(lines_of_the_proof())
