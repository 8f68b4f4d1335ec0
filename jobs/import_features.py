"""Import another program's features (.mat) as feature tables that jobs/evaluate.py evaluates

Takes the file that University-1652's test.py and its descendants save (pytorch_result.mat).
"""

from jobs.command_line.cli import run
from pipeline.core.progress import console
from pipeline.features.settings import ImportSettings


def main(settings: ImportSettings) -> None:
    """Import gallery_f, gallery_label, query_f and query_label (and the paths, if there) into
    OUT/queries and OUT/gallery.
    """
    from pipeline.features.import_mat import import_features

    written = import_features(settings)
    for table, rows in written.values():
        console.print(f"{table}: {rows:,} rows")
    queries, gallery = (written[name][0] for name in ("query", "gallery"))
    console.print(
        f"evaluate them: python jobs/evaluate.py --queries {queries} --gallery {gallery} --out DIR"
    )


if __name__ == "__main__":
    run(main)
