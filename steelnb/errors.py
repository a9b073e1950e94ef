"""One exception type per cause; the command line prints each as one line and exits 2."""

from collections.abc import Iterator
from contextlib import contextmanager


class SteelnbError(Exception):
    """Base of every error that a user can cause and mend. The message names the value and what was expected."""


class SettingsError(SteelnbError):
    """An unknown setting, a value of the wrong type, or one out of range.

    The message is cut at `CHARACTERS_MAX`, since a value may be a whole file.
    """

    CHARACTERS_MAX = 1000

    def __init__(self, message: str) -> None:
        super().__init__(message[: self.CHARACTERS_MAX])


class UnknownExperimentError(SteelnbError):
    """An experiment identifier that `experiments.toml` does not hold."""


class CollisionError(SteelnbError):
    """The simulated drone touched the structure or the ground."""


class EmptyCloudError(SteelnbError):
    """A cloud with no finite point."""


class DegenerateCloudError(SteelnbError):
    """A cloud that cannot hold a line: fewer than two distinct points."""


class FileMissingError(SteelnbError):
    """An input path that does not exist or cannot be opened."""


class UnsupportedFormatError(SteelnbError):
    """An input file whose ending is not one that can be read."""


class FileContentError(SteelnbError):
    """An input file that is truncated or does not hold what its ending promises."""


class OutputError(SteelnbError):
    """An output folder that cannot be written."""


class NotebookError(SteelnbError):
    """A notebook that raised while it was run."""


class VersionError(SteelnbError):
    """A file of a version that this one cannot read."""


class UnitsError(SteelnbError):
    """A file that does not say its units, or has others than metres."""


class NonFiniteError(SteelnbError):
    """A coordinate or a length that is infinite or not a number."""


class StructureError(SteelnbError):
    """A structure whose bars, joints and ties do not fit together."""


class EmptyStructureError(SteelnbError):
    """A structure without a bar, where there should be something to draw."""


class SingularError(SteelnbError):
    """A covariance that is not finite or not positive definite, since nothing holds some direction."""


class MissingExtraError(SteelnbError):
    """An optional library that is asked for and not installed."""


class SchedulerError(SteelnbError):
    """A Dask scheduler that does not answer, has no workers, or went away during a study."""


class RecordingError(SteelnbError):
    """A recording that holds no flight: no scans, no poses, or poses that do not cover the scans."""


class TopicError(SteelnbError):
    """A topic that a recording does not have, or several that fit where one was to be chosen."""


@contextmanager
def needs(extra: str) -> Iterator[None]:
    """Imports of the libraries of an extra: one that is missing raises `MissingExtraError` with the command to run."""
    try:
        yield
    except ModuleNotFoundError as fault:
        raise MissingExtraError(f"{fault.name} is not installed: pip install 'steelnb[{extra}]'") from None
