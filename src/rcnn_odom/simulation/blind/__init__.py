"""Places with little information for scan matching: road tunnels, bare corridors, open ground."""
