"""The errors of this package that callers tell apart. Imports nothing, so that a command line may
name them before torch is loaded."""


class CheckpointError(ValueError):
    """A file that is not a checkpoint of ours. The message says what was found, what was expected
    and what to do.
    """


class MissingLibrary(CheckpointError):
    """A backbone needs an optional library that is not installed. The message has the command."""
