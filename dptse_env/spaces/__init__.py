"""Action encodings, observation blocks and rewards."""
