"""Tables of how like the real recordings the simulated drives are."""
