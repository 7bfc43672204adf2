"""Learning to query: recipes, episodes, validation, and runs that may be interrupted."""
