"""Serve answers over HTTP: `serve.py --checkpoint FILE --index INDEX [--host H] [--port P]`"""

from jobs.command_line.cli import run
from jobs.stages.settings import ServeSettings


def main(settings: ServeSettings) -> None:
    """Answer over HTTP where photos were taken, until Ctrl-C or SIGTERM."""
    from jobs.stages.serve import serve

    serve(settings)


if __name__ == "__main__":
    run(main)
