"""Evaluation of query policies: episodes, statistics, saved policies, tables and figures."""
