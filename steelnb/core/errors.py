"""Errors that a user can correct. The command line prints each on one line and exits with code 2."""


class SteelnbError(Exception):
    """Base class. The message states the value and what was expected."""


class InputError(SteelnbError):
    """An input is invalid: a setting, a file, a recording, a cloud or a covariance."""


class OutputError(SteelnbError):
    """A file or folder exists already or cannot be written."""


class CollisionError(SteelnbError):
    """The simulated drone touched the structure or the ground."""
