"""Loads the Jinja templates of a room's pages.

In: the folder beside the module that renders a page. Out: an environment whose templates may also
include those of `pipeline/core/templates`, which the rooms share (the style sheet of all pages).
Values are escaped, and an undefined name is an error.
"""

from pathlib import Path

import jinja2

SHARED_FOLDER = Path(__file__).parent / "templates"


def template_environment(folder: Path) -> jinja2.Environment:
    """The environment whose templates lie in `folder`, or else in `SHARED_FOLDER`."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, SHARED_FOLDER]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
