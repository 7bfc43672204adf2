"""Training of query policies: recipes, episodes, validation, and resumable runs."""
