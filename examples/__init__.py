"""Short programs: training with several libraries, a schedule and a study of one's own."""
