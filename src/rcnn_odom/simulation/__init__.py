"""Generated worlds, drives through them, and the lasers that look at them."""
