"""Parts of the reader of CARMEN logs: laser lines, PARAM lines, the front laser, and the truth."""
