"""Tables are printed with all their numbers whole, however narrow the terminal is."""

import pytest
from rich.console import Console

from agents import terminal
from agents.terminal import make_table, print_table

ROWS = (
    ("largest-density-variance", "14.38 ± 0.27", "-1234.56 ± 7.89"),
    ("paper", "9.10 ± 12.34", "-"),
)


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_a_narrow_terminal_wraps_between_numbers(width, capsys, monkeypatch):
    monkeypatch.setattr(
        terminal, "Console", lambda: Console(force_terminal=True, width=width, color_system=None)
    )
    table = make_table("a title", "policy", "density RMSE", "against\nlargest-density-variance")
    for row in ROWS:
        table.add_row(*row)
    print_table(table)
    printed = capsys.readouterr().out
    assert "…" not in printed
    words = printed.split()
    for row in ROWS:
        for cell in row:
            for word in cell.split():
                assert word in words
    if width == 200:
        assert all(cell in printed for row in ROWS for cell in row)


def test_a_pipe_takes_the_width_that_a_table_needs(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    table = make_table("", "policy", "density RMSE", "against\nlargest-density-variance")
    for row in ROWS:
        table.add_row(*row)
    print_table(table)
    printed = capsys.readouterr().out
    assert all(cell in printed for row in ROWS for cell in row)
    assert "largest-density-variance" in printed


def test_a_table_may_be_empty(capsys):
    print_table(make_table("title", "policy", "error"))
    assert "error" in capsys.readouterr().out
