"""Build a FAISS index of a feature table: `build_index.py --table TABLE --out INDEX`

A finished index is changed by `--extend --table TABLE --out INDEX`, which adds the table's new
parts, and by `--remove LOCATION ... --out INDEX`; `--verify --out INDEX` checks every byte of it.
`--verify` with a table checks the table while building. `--dry-run` builds nothing: it tries the
plans on a sample and prints which one would be built, and why the others not.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import BuildIndexSettings


def main(settings: BuildIndexSettings) -> None:
    """Build a searchable index of a feature table, within a memory budget; or extend, reduce or
    verify a finished one.
    """
    if settings.extend or settings.remove or not settings.table:
        from pipeline.index.update import extend_index, remove_locations, verify_index

        if settings.extend:
            extend_index(settings.table, settings.out, settings.workers)
        elif settings.remove:
            remove_locations(settings.out, settings.remove)
        else:
            verify_index(settings.out)
        return
    from pipeline.index.build import build_index, plan_only

    if settings.dry_run:
        plan_only(settings)
    else:
        build_index(settings)


if __name__ == "__main__":
    run(main)
