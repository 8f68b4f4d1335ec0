"""`pvda NAME ...`: every job under one command; `pvda --help` lists them.

In: a job's name and its flags. Out: what `python -m jobs.NAME` does with them.
"""

import ast
import runpy
import sys
from pathlib import Path

from jobs import __file__ as JOBS_FILE


def jobs() -> dict[str, str]:
    """The jobs by name, each with its script's first sentence. Imports none of them."""
    found = {}
    for path in sorted(Path(JOBS_FILE).parent.glob("[a-z]*.py")):
        text = ast.get_docstring(ast.parse(path.read_text())) or ""
        found[path.stem] = " ".join(text.split("\n\n")[0].split()).partition(": `")[0]
    return found


def main() -> None:
    """Run one job; exits 2 where there is none of that name."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    known = jobs()
    if name in known:
        sys.argv = [f"pvda {name}", *sys.argv[2:]]
        runpy.run_module(f"jobs.{name}", run_name="__main__")
        return
    if name not in ("", "-h", "--help"):
        print(f"error: unknown job {name!r}, expected one of: {', '.join(known)}", file=sys.stderr)
        sys.exit(2)
    width = max(map(len, known))
    print("usage: pvda NAME ...; pvda NAME --help lists a job's flags\n")
    print("\n".join(f"  {job:<{width}}  {sentence}" for job, sentence in known.items()))
    sys.exit(0 if name else 2)
