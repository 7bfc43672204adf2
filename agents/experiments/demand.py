"""Demand that no policy and no network of the package was trained on."""

from __future__ import annotations

TWO_PEAKS = {
    "base": {
        "mainline": [[0.0, 5000.0], [120.0, 2000.0], [300.0, 5600.0], [420.0, 3000.0]],
        "on_ramps": [150.0, 600.0],
    }
}
"""Two peaks on the road of the paper, as the keyword ``demand``."""
