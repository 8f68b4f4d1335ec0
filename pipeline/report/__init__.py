"""The report of an evaluation: one self-contained HTML page, and figures for a paper.

In: an `EvaluationResults` (`inputs` reads one from a finished folder), a `ReportContext`, and
loaders of images and embeddings by key. Out: the page as text; PNG and PDF files.

Begin with `page.render_report`. `tasks` prepares each task: its charts, and the queries shown with
pictures (`panels`). Charts are described once, in data units: `charts`, `training_charts`,
`tables`, `error_map` (on a `map_sheet`). `svg` lays them out for the page's templates,
`figure_charts` and `figures` draw them by matplotlib. `options` holds what command lines offer.
"""
