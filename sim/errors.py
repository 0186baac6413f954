"""The one exception for input that a user can mend."""


class InputError(Exception):
    """Wrong input, told in one line that names the file, key or line and the remedy.

    The command line prints it as it is and exits with code 2.
    """
