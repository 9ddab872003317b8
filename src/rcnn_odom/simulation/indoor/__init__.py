"""A building, its furniture and people, and a robot that drives through."""
