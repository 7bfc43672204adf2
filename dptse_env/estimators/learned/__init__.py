"""Learned estimators: a recurrent network as a filter, without torch at run time."""
