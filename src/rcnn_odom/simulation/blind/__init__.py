"""Places where a matcher has little to hold on to: road tunnels, bare corridors, open ground."""
