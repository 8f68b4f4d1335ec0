"""Finished evaluations side by side: figures, differences to the first one, and how sure they are.

Prints Markdown tables; with --out it also writes comparison.md, comparison.tex and comparison.json.
"""

from typing import Annotated

import tyro

from jobs.command_line.cli import run
from pipeline.core import storage
from pipeline.core.progress import console, results
from pipeline.evaluation.compare import compare, latex, markdown
from pipeline.report.inputs import read_evaluation


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
    rows = compare([read_evaluation(folder) for folder in runs])
    results.print(markdown(rows, published), soft_wrap=True)
    if out is not None:
        storage.write_bytes(storage.join(out, "comparison.md"), markdown(rows, published).encode())
        storage.write_bytes(storage.join(out, "comparison.tex"), latex(rows, published).encode())
        storage.write_json(storage.join(out, "comparison.json"), rows)
        console.print(f"{out}: comparison.md, comparison.tex, comparison.json")


if __name__ == "__main__":
    run(main)
