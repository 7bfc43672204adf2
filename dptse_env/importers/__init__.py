"""Import of roads and of recorded traffic."""
