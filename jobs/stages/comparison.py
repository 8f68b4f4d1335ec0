"""Comparison of finished evaluations: printed, and written where a folder was named."""

from collections.abc import Sequence

from pipeline.core import storage
from pipeline.core.progress import console, results
from pipeline.evaluation.compare import compare, latex, markdown
from pipeline.report.inputs import read_evaluation


def compare_runs(runs: Sequence[str], out: str | None, published: bool) -> None:
    """Compare evaluations of the same images; the first one is the baseline. Raises InputError."""
    rows = compare([read_evaluation(folder) for folder in runs])
    results.print(markdown(rows, published), soft_wrap=True)
    if out is not None:
        storage.write_bytes(storage.join(out, "comparison.md"), markdown(rows, published).encode())
        storage.write_bytes(storage.join(out, "comparison.tex"), latex(rows, published).encode())
        storage.write_json(storage.join(out, "comparison.json"), rows)
        console.print(f"{out}: comparison.md, comparison.tex, comparison.json")
