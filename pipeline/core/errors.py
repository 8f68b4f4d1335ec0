"""The two errors that end a job with a sentence instead of a traceback, and the check of a flag.

`InputError` ends a job with exit code 2, `Incomplete` with 1. Their messages say what was found,
what was expected and what to do about it.
"""


class InputError(Exception):
    """Input that cannot be used. The message is one sentence for a person: what was found, what was
    expected, what to do. Jobs print it alone and exit with 2."""


class Incomplete(Exception):
    """Work that ended before all of it was done; the finished part stays, and a rerun resumes. The
    message is one sentence for a person. Jobs print it alone and exit with 1."""


def require(condition: bool, flag: str, value: object, expected: str) -> None:
    """Validate a flag of the command line.

    `flag` is the name of the settings' field (`max_bad_fraction`) or the flag itself; `expected`
    says which values are valid and, after a semicolon, what to do where that is not obvious.

    Raises InputError, "--max-bad-fraction is 2.0, expected a fraction from 0 to 1", if the
    condition is false.
    """
    if not condition:
        name = flag.lstrip("-").replace("_", "-")
        found = repr(value) if isinstance(value, str) else value
        if isinstance(value, tuple):  # as it was typed
            found = " ".join(map(str, value)) or "nothing"
        raise InputError(f"--{name} is {found}, expected {expected}")
