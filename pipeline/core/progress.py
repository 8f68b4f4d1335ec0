"""Progress of long work: a bar on a terminal, a JSON line every few seconds elsewhere; rate and
time left in both."""

import json
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

SECONDS_BETWEEN_LINES = 5.0

CONTROL_CHARACTERS = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Characters that a terminal obeys instead of showing, line ends and tabs aside; those that reverse
the direction of writing; and lone surrogates, which stand for the bytes of names that are not
UTF-8."""


def escape_controls(text: str) -> str:
    """Text that is safe for a terminal: a file name may hold anything, even a command to clear the
    screen."""
    return CONTROL_CHARACTERS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class _PlainConsole(Console):
    """A console that shows text as it is: no markup, no emoji, no control characters in names."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **kwargs)

    def render_str(self, text: str, **kwargs: Any) -> Text:
        return super().render_str(escape_controls(text), **kwargs)


console = _PlainConsole(stderr=True, soft_wrap=True)
"For progress and remarks. Lines are not wrapped, so that a path can be copied in one piece."
results = _PlainConsole()
"For results: standard output."


class Meter(Protocol):
    """Where long work reports its progress."""

    def advance(self, count: float = 1, **facts: float | str) -> None:
        """Report `count` more units as done; `facts` are shown until others replace them."""

    def note(self, text: str) -> None:
        """Print a remark that stays on the screen."""


@contextmanager
def progress(total: float | None, label: str, unit: str = "images") -> Iterator[Meter]:
    """Show the progress of `total` units of work (None: unknown)."""
    if not console.is_terminal:
        meter = _JsonLines(total, label, unit)
        yield meter
        meter.line(last=True)
        return
    columns = (
        _PlainColumn("{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        _PlainColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        _PlainColumn("{task.fields[facts]}"),
    )
    with Progress(*columns, console=console) as bar:
        yield _TerminalBar(bar, total, label, unit)


class _PlainColumn(TextColumn):
    """A column of text without markup."""

    def __init__(self, form: str) -> None:
        super().__init__(form, markup=False)

    def render(self, task: Task) -> Text:
        return Text(escape_controls(super().render(task).plain), style="none")


class _TerminalBar:
    def __init__(self, bar: Progress, total: float | None, label: str, unit: str) -> None:
        self._bar, self._unit, self._start, self._done = bar, unit, time.monotonic(), 0.0
        self._task = bar.add_task(label, total=total, rate="", facts="")

    def advance(self, count: float = 1, **facts: float | str) -> None:
        self._done += count
        rate = f"{self._done / max(1e-9, time.monotonic() - self._start):.1f} {self._unit}/s"
        self._bar.update(self._task, advance=count, rate=rate)
        if facts:
            shown = "  ".join(f"{name} {_format_value(value)}" for name, value in facts.items())
            self._bar.update(self._task, facts=shown)

    def note(self, text: str) -> None:
        self._bar.console.print(text)


class _JsonLines:
    def __init__(self, total: float | None, label: str, unit: str) -> None:
        self._total, self._label, self._unit = total, label, unit
        self._start = self._last_line = time.monotonic()
        self._done = 0.0
        self._facts: dict[str, float | str] = {}

    def advance(self, count: float = 1, **facts: float | str) -> None:
        self._done += count
        self._facts.update(facts)
        if time.monotonic() - self._last_line >= SECONDS_BETWEEN_LINES:
            self.line()

    def line(self, last: bool = False) -> None:
        self._last_line = time.monotonic()
        seconds = max(1e-9, self._last_line - self._start)
        rate = self._done / seconds
        row: dict[str, object] = {
            "step": self._label,
            "done": self._done,
            "total": self._total,
            "unit": self._unit,
            "per_second": round(rate, 2),
            "seconds": round(seconds, 1),
        }
        if self._total is not None and rate > 0 and not last:
            row["seconds_left"] = round((self._total - self._done) / rate, 1)
        print(json.dumps(row | self._facts), file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        row = {"step": self._label, "note": text}
        print(json.dumps(row), file=sys.stderr, flush=True)


def _format_value(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"
