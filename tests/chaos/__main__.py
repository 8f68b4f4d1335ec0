"""The long fault campaign: at least so many faults per stage, and a table of their outcomes.

    python -m tests.chaos [--faults 100] [--stages pack embed ...] [--seed 0] [--out runs/chaos]

Prints a line per trial, then the table of docs/reliability.md. All stages take hours on two cores.
Exit code 1 if content was lost or duplicated, a run hung or ended in a traceback.
"""

import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import median

import tyro

from tests.chaos.campaign import TrialResult, cases, run_trial
from tests.chaos.stages import STAGES
from tests.chaos.workspace import open_workspace


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the campaign."""

    faults: int = 100
    "Faults per stage, at least; a round tries every kind of fault once."
    stages: tuple[str, ...] = tuple(stage.name for stage in STAGES)
    "Names of the stages to disturb."
    seed: int = 0
    "Seed of the first round of trials; the next round has the next seed."
    out: Path = Path("runs/chaos")
    "Scratch folder; emptied first."


def main(settings: Settings) -> None:
    """Disturb every stage on purpose."""
    results = list[TrialResult]()
    with open_workspace(settings.out) as workspace:
        for stage in STAGES:  # in the order of the pipeline: later stages read earlier outputs
            workspace.baseline(stage)
            if stage.name not in settings.stages:
                continue
            faults = 0
            for seed in count(settings.seed):
                for case in cases(stage, seed):
                    results.append(run_trial(workspace, case))
                    faults += results[-1].faults
                    print(line(results[-1]), flush=True)
                if faults >= settings.faults:
                    break
    print(table(results))
    sys.exit(any(result.failed for result in results))


def line(result: TrialResult) -> str:
    """One trial on one line."""
    case = result.case
    problems = [
        *(result.lost or result.duplicated)[:2],
        *result.tracebacks[:1],
        *["hung"] * result.hangs,
    ]
    return (
        f"{case.stage.name:9} seed {case.seed:2} {case.name:28} faults {result.faults} "
        f"runs {result.runs} restart {result.restart_seconds:.1f} s {result.detected} "
        + ("FAILED " + "; ".join(map(str, problems)) if result.failed else "")
    )


def table(results: Iterable[TrialResult]) -> str:
    """The number of faults and their outcomes by stage and kind, as Markdown."""
    groups: dict[tuple[str, str], list[TrialResult]] = defaultdict(list)
    for result in results:
        groups[result.case.stage.name, result.case.name].append(result)
        groups[result.case.stage.name, "all"].append(result)
    lines = [
        "| stage | fault | injected | runs | losses | duplicates | hangs | tracebacks "
        "| detected by default / by --verify | restart, s |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for (stage, name), group in groups.items():
        detected = [
            sum(result.detected == how for result in group) for how in ("by default", "by --verify")
        ]
        figures = [
            sum(result.faults for result in group),
            sum(result.runs for result in group),
            sum(bool(result.lost) for result in group),
            sum(bool(result.duplicated) for result in group),
            sum(result.hangs for result in group),
            sum(bool(result.tracebacks) for result in group),
            f"{detected[0]} / {detected[1]}",
            f"{median(result.restart_seconds for result in group):.1f}",
        ]
        lines.append(f"| {stage} | {name} | " + " | ".join(map(str, figures)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Settings, config=(tyro.conf.OmitArgPrefixes,)))
