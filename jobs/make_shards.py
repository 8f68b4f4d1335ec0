"""Imagery -> shards: `make_shards.py --source university1652 --root DIR --out DIR`."""

from jobs.cli import Failure, run
from pipeline.shards import PackingSettings, TooManyRejected, pack


def main(settings: PackingSettings) -> None:
    """Pack imagery into webdataset shards."""
    try:
        pack(settings)
    except TooManyRejected as error:
        raise Failure(str(error)) from None


if __name__ == "__main__":
    run(main)
