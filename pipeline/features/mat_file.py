"""Reads the arrays of a .mat file in a process of its own: scipy's reader crashes on some damaged
files, and a crash would end the calling process.

In: the file's bytes. Out: the arrays that features consist of, numbers as numbers and paths as
text, or an error that says why there are none.
"""

import io
import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

VECTORS = ("gallery_f", "query_f")
LABELS = ("gallery_label", "query_label")
REQUIRED = ("gallery_f", "gallery_label", "query_f", "query_label")
PATHS = ("gallery_path", "query_path")
NAMES = "names"
"Under this name the reader returns the names of all arrays in the file."
EXIT_UNREADABLE, EXIT_HDF5 = 3, 4
"""Exit codes of the reader: the file cannot be read, with the reason on the error stream; it is a
MATLAB 7.3 file."""


class Unreadable(ValueError):
    """Not a .mat file of MATLAB 5, or one without plain arrays. The message says why."""


class IsHdf5(ValueError):
    """A file of MATLAB 7.3."""


def read_mat(data: bytes) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    """The arrays of REQUIRED and PATHS that the file has, and the names of all its arrays.

    Raises Unreadable, IsHdf5.
    """
    done = subprocess.run([sys.executable, __file__], input=data, capture_output=True, check=False)
    if done.returncode == EXIT_HDF5:
        raise IsHdf5
    if done.returncode == EXIT_UNREADABLE:
        reasons = done.stderr.decode(errors="replace").strip().splitlines()
        raise Unreadable(reasons[-1][:300] if reasons else "the reader gave no reason")
    if done.returncode:
        raise Unreadable("the reader crashed over it")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
        read = {name: arrays[name] for name in arrays.files}
    return read, [str(name) for name in read.pop(NAMES)]


def main() -> int:
    """The reader: a file on standard input, the arrays in NumPy's own format on standard output."""
    import scipy.io  # only the reader needs it

    try:
        file = scipy.io.loadmat(io.BytesIO(sys.stdin.buffer.read()))
        plain = {name: _numbers(name, file[name]) for name in VECTORS if name in file}
        plain |= {name: _labels(name, file[name]) for name in LABELS if name in file}
        plain |= {name: _texts(file[name]) for name in PATHS if name in file}
        names = np.array([name for name in file if not name.startswith("__")], np.str_)
        np.savez(sys.stdout.buffer, **{NAMES: names}, **plain)  # type: ignore[arg-type]
    except NotImplementedError:  # what scipy raises for MATLAB 7.3
        return EXIT_HDF5
    except Exception as error:  # scipy raises any type over damage
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        return EXIT_UNREADABLE
    return 0


def _numbers(name: str, value: Any) -> npt.NDArray[Any]:
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "fiub":
        raise ValueError(f"{name} holds {numbers.dtype}, not numbers")
    return numbers


def _labels(name: str, value: Any) -> npt.NDArray[Any]:
    """Numbers as numbers; names, whether in a matrix or in cells, as text."""
    array = np.asarray(value)
    if array.dtype.kind not in "UO":
        return _numbers(name, value)
    cells = [
        cell.item() if isinstance(cell, np.ndarray) and cell.size == 1 else cell
        for cell in np.ravel(array)
    ]
    if not all(isinstance(cell, str) for cell in cells):
        kinds = sorted({type(cell).__name__ for cell in cells if not isinstance(cell, str)})
        raise ValueError(f"{name} has cells of {', '.join(kinds)}, not whole numbers or names")
    return _texts(array)


def _texts(value: Any) -> npt.NDArray[np.str_]:
    """Texts of a matrix of padded characters, or of cells: MATLAB has no lists of text."""
    cells = (
        cell.item() if isinstance(cell, np.ndarray) and cell.size == 1 else cell
        for cell in np.ravel(value)
    )
    return np.array([str(cell).strip() for cell in cells], np.str_)


if __name__ == "__main__":
    sys.exit(main())
