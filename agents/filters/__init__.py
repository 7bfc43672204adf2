"""Training of the recurrent network on simulated traffic."""
