"""What a policy sees and does: action encodings, observation blocks and rewards."""
