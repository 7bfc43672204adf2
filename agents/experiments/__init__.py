"""What studies and searches share: seeds, designs, engines, ledgers, provenance, tables, plots."""
