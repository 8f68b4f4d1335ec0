"""libtiff's own messages, kept off the terminal.

Pillow decodes TIFF by libtiff, which writes a line to stderr for each odd tag and damaged strip, by
the hundred for a folder of photos of one camera. Pillow offers no way to stop that; libtiff does:
an error and a warning handler for the whole process, of which none means no output. Nothing is lost
by it: damage is an error of Pillow's as well, and the image is refused by name. Redirecting the
stderr of the process instead would take the lines of other threads with it.
"""

import ctypes
import re
from functools import cache
from pathlib import Path

LOADED_LIBRARIES = Path("/proc/self/maps")
"The files that this process has mapped, on Linux."
BUNDLED = re.compile(r"/pillow\.libs/libtiff[^/]*$", re.IGNORECASE)
"""The library within Pillow's wheel. That of another package, or of the system, is left alone: GDAL
may report its errors through the same handlers."""


@cache
def silence_libtiff() -> int:
    """Take the handlers off the libtiff that Pillow's wheel brings; returns how many were found.

    0, and the lines are shown, on other systems than Linux and where Pillow uses the system's
    libtiff.
    """
    try:
        lines = LOADED_LIBRARIES.read_text(errors="replace").splitlines()
    except OSError:
        return 0
    files = {"/" + line.partition("/")[2] for line in lines}
    silenced = 0
    for path in filter(BUNDLED.search, files):
        try:
            library = ctypes.CDLL(path)  # the one that is loaded, as the path is the same
            for name in ("TIFFSetErrorHandler", "TIFFSetWarningHandler"):
                set_handler = getattr(library, name)
                set_handler.restype, set_handler.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
                set_handler(None)
        except (OSError, AttributeError):  # removed meanwhile, or without these functions
            continue
        silenced += 1
    return silenced
