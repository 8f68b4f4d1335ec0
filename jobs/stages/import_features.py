"""Import of another program's features, and a check by arithmetic of figures stated for them."""

from collections import Counter

from pipeline.core.progress import console
from pipeline.evaluation.published import highest_ap, impossible_ap
from pipeline.features.import_mat import import_features
from pipeline.features.settings import ImportSettings
from pipeline.features.table import open_table


def import_and_print(settings: ImportSettings) -> None:
    """Write OUT/queries and OUT/gallery, and say how to evaluate them. Raises InputError."""
    written = import_features(settings)
    for table, rows in written.values():
        console.print(f"{table}: {rows:,} rows")
    queries, gallery = (written[name][0] for name in ("query", "gallery"))
    if settings.stated:
        console.print(judge_stated(settings.stated, queries, gallery))
    console.print(
        f"evaluate them: python jobs/evaluate.py --queries {queries} --gallery {gallery} --out DIR"
    )


def judge_stated(stated: tuple[float, float], queries: str, gallery: str) -> str:
    """One sentence: whether R@1 and AP in percent can both be true of a task between two tables."""
    r1, ap = stated
    matches = Counter(open_table(gallery).labels().locations.tolist())
    most = max(matches[location] for location in open_table(queries).labels().locations.tolist())
    figures = f"stated R@1 {r1:.2f} and AP {ap:.2f}"
    if most > 1:
        return f"{figures}: not judged, since queries have up to {most} true matches"
    verdict = "impossible" if impossible_ap(r1, ap) else "possible"
    return (
        f"{figures}: {verdict}; with one true match a query, AP lies from {r1:.2f} to "
        f"{highest_ap(r1):.2f}"
    )
