"""A building with furniture and people, and a robot that drives through it."""
