"""The evaluation stage: feature tables judged in one folder that others can read.

In: feature tables, and for pictures and groups the shards they were embedded from. Out: a folder
with metrics.json, metrics.parquet, queries.parquet, report.html and the optional extras.

Begin with `evaluate.evaluate`, which ranks every task, writes the folder and resumes or reuses an
earlier one. `settings` has its flags. `extras` writes what goes beyond metrics and report, with
`breakdowns` (metrics by group) and `exports` (files for other programs). `compare` reads finished
folders and tests their differences, beside the figures that papers published.
"""
