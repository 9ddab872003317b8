"""The one exception for mistakes that a user can correct."""


class InputError(Exception):
    """Bad input of a user: one line that names the file (line, frame) and what to do about it.

    The command line tools print the message alone and exit with status 1; everything else that is
    raised is a fault of the program and keeps its traceback.
    """
