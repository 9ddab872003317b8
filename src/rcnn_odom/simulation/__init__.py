"""Generated worlds, drives through them, and simulated lasers."""
