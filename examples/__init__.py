"""Short programs that train on the environments with libraries other than stable-baselines3."""
