"""What a user may choose of a report: the settings of an evaluation name these. Imports nothing."""

from typing import Literal

FigureFormat = Literal["png", "pdf"]
"Of the figures for a paper."
DEFAULT_PANELS = 4
"Hits, and as many misses, that the report shows of each task."
