"""Import another program's features (.mat) as feature tables that jobs/evaluate.py evaluates

Takes the file that University-1652's test.py and its descendants save (pytorch_result.mat). With
--stated R1 AP it says whether these two figures can both be true.
"""

from jobs.command_line.cli import run
from pipeline.features.settings import ImportSettings


def main(settings: ImportSettings) -> None:
    """Import gallery_f, gallery_label, query_f and query_label (and the paths, if there) into
    OUT/queries and OUT/gallery.
    """
    from jobs.stages.import_features import import_and_print

    import_and_print(settings)


if __name__ == "__main__":
    run(main)
