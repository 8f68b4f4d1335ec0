"""Command lines: the only place where model and pipeline meet."""
