"""The fault campaign in full: every stage of the road meets at least so many faults, and a table
says what came of them.

    benchmarks/chaos.py [--faults 100] [--stages pack embed ...] [--seed 0] [--out runs/chaos]

Prints a line per trial, and in the end the table of docs/reliability.md. Hours on two cores where
all stages are asked for; exit code 1 where anything was lost, doubled, hung, or said with a
traceback instead of a sentence.
"""

import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import median

import tyro

sys.path.append(str(Path(__file__).parents[1]))

from tests.chaos.campaign import Verdict, cases, trial
from tests.chaos.grounds import ground
from tests.chaos.stages import STAGES


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is broken."""

    faults: int = 100
    "Per stage, at least."
    stages: tuple[str, ...] = tuple(stage.name for stage in STAGES)
    "By name."
    seed: int = 0
    "Of the first round of trials; the next round has the next one."
    out: Path = Path("runs/chaos")
    "Folder in which things are broken."


def main(settings: Settings) -> None:
    """Break every stage on purpose."""
    verdicts = list[Verdict]()
    with ground(settings.out) as here:
        for stage in STAGES:  # in the order of the road: each prepares what the next one reads
            here.undisturbed(stage)
            if stage.name not in settings.stages:
                continue
            faults = 0
            for seed in count(settings.seed):
                for case in cases(stage, seed):
                    verdicts.append(trial(here, case))
                    faults += verdicts[-1].faults
                    print(line(verdicts[-1]), flush=True)
                if faults >= settings.faults:
                    break
    print(table(verdicts))
    sys.exit(any(verdict.bad for verdict in verdicts))


def line(verdict: Verdict) -> str:
    """One trial in a line."""
    case = verdict.case
    wrong = [
        *(verdict.lost or verdict.doubled)[:2],
        *verdict.unclear[:1],
        *["hung"] * verdict.hangs,
    ]
    return (
        f"{case.stage.name:9} seed {case.seed:2} {case.name:28} faults {verdict.faults} runs {verdict.runs} "
        f"restart {verdict.restart_seconds:.1f} s {verdict.found} "
        + ("BAD " + "; ".join(map(str, wrong)) if verdict.bad else "")
    )


def table(verdicts: Iterable[Verdict]) -> str:
    """By stage and kind of fault: how many, and what came of them, as Markdown."""
    groups: dict[tuple[str, str], list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        groups[verdict.case.stage.name, verdict.case.name].append(verdict)
        groups[verdict.case.stage.name, "all"].append(verdict)
    lines = [
        "| stage | fault | injected | runs | losses | doubles | hangs | tracebacks | found / by --verify | restart, s |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for (stage, name), group in groups.items():
        found = [sum(one.found == how for one in group) for how in ("by default", "by --verify")]
        figures = [
            sum(one.faults for one in group),
            sum(one.runs for one in group),
            sum(bool(one.lost) for one in group),
            sum(bool(one.doubled) for one in group),
            sum(one.hangs for one in group),
            sum(bool(one.unclear) for one in group),
            f"{found[0]} / {found[1]}",
            f"{median(one.restart_seconds for one in group):.1f}",
        ]
        lines.append(f"| {stage} | {name} | " + " | ".join(map(str, figures)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Settings, config=(tyro.conf.OmitArgPrefixes,)))
