"""The messages that importing torchao writes, for the two libraries that import it.

In: nothing. Out: a context without them.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from model.inference.compile import ignore_deprecations


@contextmanager
def filter_torchao_logs() -> Iterator[None]:
    """Filter torchao 0.18's log messages about missing CUDA libraries and about its own
    deprecations; show all others.
    """

    def wanted(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        return "register_constant() on Enum" not in message and not (
            "Failed to load" in message and "/torchao/_C_" in message
        )

    loggers = [logging.getLogger(name) for name in ("torchao", "torch.utils._pytree")]
    for logger in loggers:
        logger.addFilter(wanted)
    try:
        with ignore_deprecations():
            yield
    finally:
        for logger in loggers:
            logger.removeFilter(wanted)
