"""Feature table -> FAISS index: `build_index.py --table TABLE --out INDEX`."""

from jobs.cli import run
from pipeline.index import IndexSettings, build_index


def main(settings: IndexSettings) -> None:
    """Build a searchable index of a feature table."""
    build_index(settings)


if __name__ == "__main__":
    run(main)
