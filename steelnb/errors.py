"""The errors that a user can cause and mend; the command line prints each as one line and exits with 2."""


class SteelnbError(Exception):
    """Base of them all. The message names the value and what was expected."""


class InputError(SteelnbError):
    """Something given that cannot be used: a setting, a file, a recording, a cloud, a covariance."""


class OutputError(SteelnbError):
    """A file or folder that exists already or cannot be written."""


class CollisionError(SteelnbError):
    """The simulated drone touched the structure or the ground."""
