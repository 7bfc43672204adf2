"""Where a choice of queries pays: gains and saved bandwidth over roads, bandwidths and filters."""
