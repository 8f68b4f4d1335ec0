"""How every job starts and ends: a command line derived from its settings, one sentence and exit code 2 on bad input."""

import sys
from collections.abc import Callable
from typing import Any

import tyro
from ray.exceptions import RayError, RayTaskError

from model.checkpoint import CheckpointError
from pipeline.progress import console
from pipeline.records import InputError, Unfinished


def run(job: Callable[..., Any], reword: Callable[[list[str]], list[str]] = lambda arguments: arguments) -> None:
    """Parse the command line for `job` (its parameters, or its one settings dataclass) and run it.

    `reword` may say the arguments in the parser's words, or refuse them with a better sentence than the parser has. Exits
    0 when the output is complete, 2 on a wrong call or unusable input, 1 on failure.
    """
    config = (
        tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes,
        tyro.conf.CascadeSubcommandArgs,  # flags may stand before or after a recipe's name
        tyro.conf.EnumChoicesFromValues,  # `--view drone`
    )  # fmt: skip
    try:
        tyro.cli(job, args=reword(sys.argv[1:]), config=config)
    except (InputError, CheckpointError) as error:
        _say(str(error))
        sys.exit(2)
    except OSError as error:  # the system's word: no right to, no room for, a folder for a file
        where = f"{error.filename}: " if error.filename else ""
        _say(
            f"{where}{error.strerror or error}; check the path, its rights and the room on its disk, and run the same command again to go on"
        )
        sys.exit(1)
    except Unfinished as error:
        _say(str(error))
        sys.exit(1)
    except RayError as error:
        if isinstance(error, RayTaskError):
            raise
        _say(f"lost Ray's cluster or a worker ({type(error).__name__}); run the same command again to go on")
        sys.exit(1)
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to go on")
        sys.exit(130)


def _say(sentence: str) -> None:
    console.print("error:", style="bold red", end=" ")
    console.print(sentence.replace("\n", "\\n"))  # one sentence is one line, whatever a file in it is called
