"""How every job starts and ends: flags from its settings, one sentence and exit code 2 on bad
input.

In: a job's function, whose parameters are its settings. Out: its call, and an exit code. Each
`jobs/NAME.py` imports its settings alone, and its function imports the work. So `--help` and a
refused flag need no torch and no Ray.
"""

import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn, get_type_hints

import tyro

from jobs import STOPPED
from jobs.command_line.config import Choice, flatten, read_config, to_yaml
from jobs.command_line.signals import interruptible
from model.errors import CheckpointError
from pipeline.core import storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.progress import console

SECONDS_TO_END = 15.0
"From Ctrl-C until a job's process is gone, whatever its libraries still wait for."
AGAIN = "run the same command again to resume"
MARKS = (
    tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.CascadeSubcommandArgs,  # flags may stand before or after a recipe's name
    tyro.conf.EnumChoicesFromValues,  # `--view drone`
)  # fmt: skip
KEYWORD_ONLY = inspect.Parameter.KEYWORD_ONLY


@dataclass(frozen=True, kw_only=True)
class ConfigFlags:
    """Settings as a file."""

    config: str | None = None
    "YAML file (or URI) with settings by flag; flags given beside it override it."
    print_config: bool = False
    "Print the settings of this call as such a file, and do nothing else."


@dataclass(frozen=True, kw_only=True)
class LikeFlag:
    """Another run's settings."""

    like: str | None = None
    "Folder of a run: repeat its settings; flags given beside it override them."


def run(
    job: Callable[..., Any], choice: Choice | None = None, like_file: str | None = None
) -> None:
    """Parse the command line for `job` (its parameters, or the fields of its settings) and run it.

    `choice` is the word that decides which flags exist; with `like_file`, a file name in a run's
    folder, there is `--like RUN`. Exits 0 when the output is complete, 2 on a wrong call or
    unusable input, 1 on failure.
    """
    with interruptible() as received:
        try:
            try:
                arguments = parse(job, sys.argv[1:], choice, like_file)
                if arguments is not None:
                    job(**arguments)
            finally:
                sys.stdout.flush()  # a closed pipe is an error here, and a traceback at exit
        except (InputError, CheckpointError) as error:
            _print_error(str(error))
            sys.exit(2)
        except BrokenPipeError:  # `NAME | head` has read enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(128 + signal.SIGPIPE)  # as shells count
        except OSError as error:  # the system's: no permission, a full disk, a folder for a file
            path = f"{error.filename}: " if error.filename else ""
            remedy = f"check the path, its permissions and the space on its disk, and {AGAIN}"
            _print_error(f"{path}{error.strerror or error}; {remedy}")
            sys.exit(1)
        except Incomplete as error:
            _print_error(str(error))
            sys.exit(1)
        except (Exception, KeyboardInterrupt) as error:
            # Libraries make other errors of a KeyboardInterrupt.
            if received or isinstance(error, KeyboardInterrupt):
                _stop(128 + (received or [signal.SIGINT])[0])
            if not _is_loss(error):
                raise
            _print_error(f"lost Ray's cluster or a worker ({type(error).__name__}); {AGAIN}")
            sys.exit(1)


def parse(
    job: Callable[..., Any],
    argv: Sequence[str],
    choice: Choice | None = None,
    like_file: str | None = None,
) -> dict[str, Any] | None:
    """The arguments of `job` from a command line; None where `--print-config` printed them.

    Raises InputError, and SystemExit as tyro does.
    """
    word, words = expand(job, list(argv), choice, like_file)
    hints = get_type_hints(job, include_extras=True)
    added = {"config_flags": ConfigFlags} | ({"like_flag": LikeFlag} if like_file else {})
    own = dict(inspect.signature(job).parameters)
    if choice is not None and choice.kind_of is not None:
        hints[choice.name] = Annotated[str | None, tyro.conf.arg(help=choice.help)]
        default = None
        if word is not None:
            hints[choice.name] = choice.kind_of(word)
            default = choice.kind_of(word)()
        own[choice.name] = own[choice.name].replace(default=default)
    elif word is not None:
        words = [word, *words]

    def collect(**arguments: Any) -> dict[str, Any]:
        return arguments

    # tyro reads a signature: the job's, with the flags that all jobs share.
    shared = [
        inspect.Parameter(name, KEYWORD_ONLY, default=flags(), annotation=flags)
        for name, flags in added.items()
    ]
    parameters = [parameter.replace(kind=KEYWORD_ONLY) for parameter in own.values()]
    collect.__signature__ = inspect.Signature(parameters + shared)  # type: ignore[attr-defined]
    collect.__annotations__ = hints | added
    collect.__doc__ = job.__doc__
    arguments = tyro.cli(collect, args=words, config=MARKS)
    flags = [arguments.pop(name) for name in added]
    if flags[0].print_config:
        print(to_yaml(flatten(arguments, hints, choice)), end="")
        return None
    return arguments


def expand(
    job: Callable[..., Any], words: list[str], choice: Choice | None, like_file: str | None
) -> tuple[str | None, list[str]]:
    """The choice's word, and the other words, those of `--config` or `--like` before the command
    line's own.

    Raises InputError.
    """
    path = take_flag(words, "--config")
    run_folder = take_flag(words, "--like") if like_file else None
    if path and run_folder:
        raise InputError("found --config and --like, expected one of them; leave one out")
    if run_folder and like_file:
        path = storage.join(run_folder, like_file)
    word, given = read_config(path, job, choice) if path else (None, [])
    if choice is None:
        return None, given + words
    chosen = None
    if choice.kind_of is not None:
        chosen = take_flag(words, f"--{choice.name}")
    elif words and not words[0].startswith("-"):
        chosen = words.pop(0)
    word = word if chosen is None else chosen
    if word is not None and word not in choice.names:
        known = ", ".join(choice.names)
        found = f"--{choice.name} is" if choice.kind_of else f"unknown {choice.name}"
        raise InputError(f"{found} {word!r}, expected one of: {known}; see --help")
    return word, given + words


def take_flag(words: list[str], flag: str) -> str | None:
    """Take `FLAG VALUE` or `FLAG=VALUE` out of the words; its value, "" where none follows."""
    for at, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name == flag:
            if not equals:
                value = "".join(words[at + 1 : at + 2])
            del words[at : at + (1 if equals else 2)]
            return value
    return None


def _stop(code: int) -> NoReturn:
    console.print(STOPPED)
    # Ray, interrupted while it starts workers, may wait for them for ever; its processes end with
    # this one.
    threading.Thread(target=_exit_later, args=(code,), daemon=True).start()
    sys.exit(code)


def _is_loss(error: BaseException) -> bool:
    """Whether Ray lost a node or worker, in contrast to an error of the work itself. Imports
    nothing for jobs without Ray.
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
    # One sentence is one line, whatever characters a file's name in it has.
    console.print(sentence.replace("\n", "\\n"))
