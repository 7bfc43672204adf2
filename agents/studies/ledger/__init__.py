"""Capped contributions beside paced ledgers: errors at the same guarantee, and who runs out."""
