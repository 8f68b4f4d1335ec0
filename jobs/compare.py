"""Compare finished evaluations: figures, differences to the first one, and intervals

Prints Markdown tables; with --out it also writes comparison.md, comparison.tex and comparison.json.
"""

from typing import Annotated

import tyro

from jobs.command_line.cli import run


def main(
    runs: Annotated[tuple[str, ...], tyro.conf.Positional],
    out: str | None = None,
    published: bool = False,
) -> None:
    """Compare evaluations of the same images.

    Args:
        runs: Folders that jobs/evaluate.py wrote; the first one is the baseline.
        out: Folder for comparison.md, comparison.tex and comparison.json; a path or a URI.
        published: Add the figures that papers published for University-1652's official test.
    """
    from jobs.stages.comparison import compare_runs

    compare_runs(runs, out, published)


if __name__ == "__main__":
    run(main)
