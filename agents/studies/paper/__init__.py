"""Reproduction of the paper's five results, with a verdict on each of its claims."""
