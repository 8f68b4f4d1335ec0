"""How every job starts and ends: a command line derived from its settings, one sentence and exit
code 2 on bad input.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn

import tyro

from jobs import STOPPED
from jobs.command_line.signals import interruptible
from model.errors import CheckpointError
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.progress import console

SECONDS_TO_END = 15.0
"From Ctrl-C until a job is gone, whatever its libraries still wait for."


def run(
    job: Callable[..., Any],
    preprocess_argv: Callable[[list[str]], list[str]] = lambda arguments: arguments,
) -> None:
    """Parse the command line for `job` (its parameters, or its one settings dataclass) and run it.

    `reword` may say the arguments in the parser's words, or refuse them with a better sentence than the parser has. Exits
    0 when the output is complete, 2 on a wrong call or unusable input, 1 on failure.
    """
    config = (
        tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes,
        tyro.conf.CascadeSubcommandArgs,  # flags may stand before or after a recipe's name
        tyro.conf.EnumChoicesFromValues,  # `--view drone`
    )  # fmt: skip
    with interruptible() as received:
        try:
            tyro.cli(job, args=preprocess_argv(sys.argv[1:]), config=config)
        except (InputError, CheckpointError) as error:
            _print_error(str(error))
            sys.exit(2)
        except OSError as error:  # the system's word: no right to, no room for, a folder for a file
            where = f"{error.filename}: " if error.filename else ""
            asked = "check the path, its rights and the room on its disk, and run the same command again to go on"
            _print_error(f"{where}{error.strerror or error}; {asked}")
            sys.exit(1)
        except Incomplete as error:
            _print_error(str(error))
            sys.exit(1)
        except (Exception, KeyboardInterrupt) as error:
            if received or isinstance(
                error, KeyboardInterrupt
            ):  # libraries make other errors of it
                _stop(128 + (received or [signal.SIGINT])[0])  # as shells count
            if not _is_loss(error):
                raise
            _print_error(
                f"lost Ray's cluster or a worker ({type(error).__name__}); run the same command again to go on"
            )
            sys.exit(1)


def _stop(code: int) -> NoReturn:
    console.print(STOPPED)
    # Ray, interrupted while it starts workers, may wait for them for ever; its processes end with
    # this one.
    threading.Thread(target=_exit_later, args=(code,), daemon=True).start()
    sys.exit(code)


def _is_loss(error: BaseException) -> bool:
    """Whether Ray has lost what worked, and not what worked has failed. Of jobs without Ray nothing
    is imported for it.
    """
    if "ray" not in sys.modules:
        return False
    from ray.exceptions import RayError, RayTaskError

    return isinstance(error, RayError) and not isinstance(error, RayTaskError)


def _exit_later(code: int) -> None:
    time.sleep(SECONDS_TO_END)
    os._exit(code)


def _print_error(sentence: str) -> None:
    console.print("error:", style="bold red", end=" ")
    console.print(
        sentence.replace("\n", "\\n")
    )  # one sentence is one line, whatever a file in it is called
