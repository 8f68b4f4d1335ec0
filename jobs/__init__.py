"""The command lines, the only place where model and pipeline meet."""

import sys
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any

STOPPED = "stopped; run the same command again to go on"
"What a job says last when Ctrl-C or SIGTERM ends it."
Hook = Callable[[type[BaseException], BaseException, TracebackType | None], Any]


def _quietly(
    otherwise: Hook, kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print(STOPPED, file=sys.stderr)
    else:
        otherwise(kind, error, trace)


# Before jobs/command_line/cli.py has begun: seconds go by while torch and Ray are imported, and
# Ctrl-C is pressed in these too.
sys.excepthook = partial(_quietly, sys.excepthook)
