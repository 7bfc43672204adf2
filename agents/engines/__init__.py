"""Engines run the tasks of long jobs: in processes of this machine, or on a Ray cluster."""
