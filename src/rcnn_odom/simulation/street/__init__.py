"""A city, its traffic, and a car that drives through it."""
