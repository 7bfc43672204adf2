"""The study of penetration: errors by the share of connected vehicles, and what fusion gains."""
