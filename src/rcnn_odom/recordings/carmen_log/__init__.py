"""What a CARMEN log says: its lines, its parameters, its laser, and the truth."""
