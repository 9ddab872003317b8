"""The one exception for mistakes that a user can correct."""


class InputError(Exception):
    """Wrong input of a user. The message is one line that names the file (line, frame) and says what to do.

    The command line tools print only the message and exit with status 1. Every other exception is a fault of
    the program and keeps its traceback.
    """
