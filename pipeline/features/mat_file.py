"""A .mat file of features -> plain arrays, read by a process of its own: scipy's reader crashes on
some damaged files, and a crash ends whoever reads.

In: the file's bytes. Out: the arrays that features consist of, numbers as numbers and paths as
text; or why there are none.
"""

import io
import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

NUMBERS = ("gallery_f", "gallery_label", "query_f", "query_label")
PATHS = ("gallery_path", "query_path")
NAMES = "names"
"Under this name the reader lists all that the file holds."
EXIT_UNREADABLE, EXIT_HDF5 = 3, 4
"Exit codes of the reader: it says why on its error stream; the file is a MATLAB 7.3 one."


class Unreadable(ValueError):
    """A file that is no .mat file of MATLAB 5, or holds no plain arrays. The message says why."""


class IsHdf5(ValueError):
    """A file of MATLAB 7.3."""


def read_mat(data: bytes) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    """The arrays of NUMBERS and PATHS that are there, and the names of all that is.

    Raises Unreadable, IsHdf5.
    """
    done = subprocess.run([sys.executable, __file__], input=data, capture_output=True, check=False)
    if done.returncode == EXIT_HDF5:
        raise IsHdf5
    if done.returncode:
        said = (
            done.stderr.decode(errors="replace").strip().splitlines()
            if done.returncode == EXIT_UNREADABLE
            else []
        )
        raise Unreadable(said[-1][:300] if said else "the reader crashed over it")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    return found, [str(name) for name in found.pop(NAMES)]


def main() -> int:
    """The reader: a file on standard input, the arrays in NumPy's own format on standard output."""
    import scipy.io  # here: whoever starts this has no use for it

    try:
        said = scipy.io.loadmat(io.BytesIO(sys.stdin.buffer.read()))
        plain = {name: _numbers(name, said[name]) for name in NUMBERS if name in said}
        plain |= {name: _texts(said[name]) for name in PATHS if name in said}
        names = np.array([name for name in said if not name.startswith("__")], np.str_)
        np.savez(sys.stdout.buffer, **{NAMES: names}, **plain)  # type: ignore[arg-type]
    except NotImplementedError:  # scipy's word for MATLAB 7.3
        return EXIT_HDF5
    except Exception as error:  # the reader raises whatever the damage leads it to
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        return EXIT_UNREADABLE
    return 0


def _numbers(name: str, value: Any) -> npt.NDArray[Any]:
    found = np.asarray(value)
    if found.dtype.kind not in "fiub":
        raise ValueError(f"{name} holds {found.dtype}, not numbers")
    return found


def _texts(value: Any) -> npt.NDArray[np.str_]:
    """MATLAB has no lists of text: a matrix of padded characters, or cells with one array each."""
    cells = (
        cell.item() if isinstance(cell, np.ndarray) and cell.size == 1 else cell
        for cell in np.ravel(value)
    )
    return np.array([str(cell).strip() for cell in cells], np.str_)


if __name__ == "__main__":
    sys.exit(main())
