"""The one exception that is not a bug: a mistake of the user, told in one line."""


class UserError(Exception):
    """What is wrong, where, and what to do about it, in one line.  The command line prints it and exits with 2."""
