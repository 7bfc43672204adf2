"""Shared parts of studies and searches: seeds, designs, engines, ledgers, tables, plots."""
