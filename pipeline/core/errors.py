"""TODO pipeline.core.errors."""


class InputError(Exception):
    """Input that cannot be used. The message is one sentence for a person: what was found, what was
    expected, what to do. Jobs print it alone and exit with 2."""


class Incomplete(Exception):
    """Work that could not be done whole; what is done stays. The message is one sentence for a
    person. Jobs print it alone and exit with 1."""
