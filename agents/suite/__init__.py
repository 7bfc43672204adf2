"""Query suites: cells with fixed traffic and noise on which any query policy is scored."""
