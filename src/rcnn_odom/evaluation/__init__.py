"""From steps to numbers and pictures."""
