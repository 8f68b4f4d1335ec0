"""The jobs: one entry script each, and the only package where model and pipeline meet.

In: a command line. Out: an artefact on disk (shards, a run, a table, an index, answers), and an
exit code. `jobs/NAME.py` has a job's settings and imports its stage only after parsing: from
`pipeline`, from `training/` (the training loop), `encoding/` (checkpoint and images to embeddings)
or `stages/` (the other stages that need the network). `command_line/` is what all of them share.
Begin with `train.py` or `locate.py` and follow its one import.
"""

import sys
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any

STOPPED = "stopped; run the same command again to resume"
"A job's last line when Ctrl-C or SIGTERM ends it."
Hook = Callable[[type[BaseException], BaseException, TracebackType | None], Any]


def _quietly(
    otherwise: Hook, kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print(STOPPED, file=sys.stderr)
    else:
        otherwise(kind, error, trace)


# For Ctrl-C before and after jobs/command_line/cli.py handles it: while modules are imported, and
# at the interpreter's end.
sys.excepthook = partial(_quietly, sys.excepthook)
