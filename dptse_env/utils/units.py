"""Units: lengths are in km, speeds in km/h, flows in veh/h, and times in seconds."""

HOUR = 3600.0
"""An hour [s]."""

KMH = 3.6
"""A metre a second [km/h]."""
