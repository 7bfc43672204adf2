"""Audit of a privacy claim: two adjacent worlds, an adversary, and a statistical test."""
