"""A CSV, Parquet or GeoJSON file -> numbered rows under our column names, values as the file has
them.

In: a file on any storage. Out: (row number from 1, {column: value}) in the file's order. The file
and its columns are validated here, cells are not.
"""

import csv
import io
import json
from collections.abc import Iterable, Iterator
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.sources.maps.geojson_shapes import parse_geometry

REQUIRED_COLUMN = "path"
COLUMNS = (
    REQUIRED_COLUMN,
    "view",
    "split",
    "location",
    "lat",
    "lon",
    "altitude_m",
    "heading_deg",
    "pitch_deg",
    "roll_deg",
    "focal_35mm",
    "taken_at",
)
ALIASES = {"latitude": "lat", "longitude": "lon", "lng": "lon"}
NUMBER_COLUMNS = (
    "lat", "lon", "altitude_m", "heading_deg", "pitch_deg", "roll_deg", "focal_35mm",
)  # fmt: skip
SHAPE_COLUMN = "shape"
"Under this name a GeoJSON row holds its geometry, a Shape."
BROKEN_COLUMN = "broken"
"Under this name an unusable row holds a countable reason, and what was found."
MAX_CELL_LENGTH = 4096
"Characters: the longest path that a file system opens."
DELIMITERS = ",;\t"
BATCH_ROWS = 10_000  # rows of Parquet at once
BYTE_ORDER_MARKS = {b"\xff\xfe": "UTF-16", b"\xfe\xff": "UTF-16", b"\x00\x00\xfe\xff": "UTF-32"}

Row = dict[str, Any]


def read_table_rows(path: str) -> Iterator[tuple[int, Row]]:
    """The rows of a table. Row 1 is the first below a CSV's header; blank rows are not counted.

    Other columns are ignored; names match in upper and lower case. Raises InputError where the file
    is not a table of images.
    """
    readers = {
        "csv": _csv_rows,
        "tsv": _csv_rows,
        "parquet": _parquet_rows,
        "geojson": _geojson_rows,
        "json": _geojson_rows,
    }
    kinds = f".{', .'.join(readers)}"
    if storage.is_folder(path):
        raise InputError(
            f"{path} is a folder, expected a table of images ({kinds}); give --root the file itself"
        )
    if not storage.exists(path):
        raise InputError(f"no file {path}; expected a table of images ({kinds}); check --root")
    ending = path.rpartition("/")[2].rpartition(".")[2].lower()
    if ending not in readers:
        raise InputError(
            f"{path} is no table by its name, expected {kinds}; write the table as one of these"
        )
    return enumerate(map(_check_cell_lengths, readers[ending](path)), 1)


def _check_cell_lengths(row: Row) -> Row:
    """The row without cells longer than any valid value, so that memory and messages stay small for
    a hostile file.
    """
    for name, value in row.items():
        if isinstance(value, str | bytes) and len(value) > MAX_CELL_LENGTH:
            broken = ("cell too long", f"{name} of {len(value)} characters")
            return row | {name: value[:MAX_CELL_LENGTH], BROKEN_COLUMN: broken}
    return row


def _map_columns(path: str, found: Iterable[str]) -> dict[str, str]:
    """The file's names of our columns -> our names."""
    names = list(found)
    ours: dict[str, str] = {}
    for name in names:
        plain = name.strip().lower()
        column = ALIASES.get(plain, plain)
        if column not in COLUMNS:
            continue
        if column in ours.values():
            raise InputError(
                f"{path} has two columns for {column}: {', '.join(names)}; expected one; "
                "take one away"
            )
        ours[name] = column
    half = {"lat", "lon"} & set(ours.values())
    wanted = (REQUIRED_COLUMN, *({"lat", "lon"} if len(half) == 1 else ()))
    missing = [name for name in wanted if name not in ours.values()]
    if missing:
        raise InputError(
            f"{path} has no column {missing[0]} but {', '.join(names) or 'none'}; expected "
            f"{REQUIRED_COLUMN} and any of {', '.join(COLUMNS[1:])}; add it or rename one"
        )
    return ours


def _csv_rows(path: str) -> Iterator[Row]:
    """Every cell as text: a location called 0001 stays so. Rows of separators alone are blank."""
    with (
        storage.open_read(path) as stream,
        io.TextIOWrapper(stream, "utf-8-sig", newline="") as text,
    ):
        try:
            header, delimiter = _read_header(text)
            names = next(csv.reader([header], delimiter=delimiter), [])
            kept = _without_blank_end(names, len(names))
            ours = _map_columns(path, kept)
            surplus = None
            for cells in csv.reader(text, delimiter=delimiter):
                if not any(cell.strip() for cell in cells):
                    continue
                if surplus is None:  # of the header, or of rows where the first one has it
                    surplus = max(len(names), len(cells)) - len(kept)
                cells = _without_blank_end(cells, min(surplus, len(cells) - len(kept)))
                yield _csv_row(kept, ours, cells, delimiter)
        except UnicodeDecodeError as error:
            raise _not_utf8(path, error) from None
        except csv.Error as error:
            raise InputError(
                f"{path} cannot be read as CSV ({error}); expected a header and a row per image"
            ) from None


def _read_header(text: IO[str]) -> tuple[str, str]:
    """The line with the columns' names, and the delimiter. Excel writes a line `sep=;` before."""
    header = text.readline()
    note = header.strip().strip('"')
    if note.lower().startswith("sep=") and len(note) == 5:
        return text.readline(), note[-1]
    if header.startswith("sep=\t"):
        return text.readline(), "\t"
    return header, max(DELIMITERS, key=header.count)  # the first of them in a table of one column


def _without_blank_end(cells: list[str], most: int) -> list[str]:
    """Cells without at most so many blank ones at the end, which separators behind the last column
    make.
    """
    end = len(cells)
    while end > 0 and len(cells) - end < most and not cells[end - 1].strip():
        end -= 1
    return cells[:end]


def _csv_row(names: list[str], ours: dict[str, str], cells: list[str], delimiter: str) -> Row:
    row: Row = {ours[name]: cell for name, cell in zip(names, cells, strict=False) if name in ours}
    if len(cells) != len(names):  # an unquoted comma in a name shifts all that follows
        found = f"{len(cells)} cells below {len(names)} columns"
        row[BROKEN_COLUMN] = ("wrong number of cells", found)
    if delimiter != ",":  # spreadsheets of many countries write 50,1
        row |= {name: row[name].replace(",", ".") for name in NUMBER_COLUMNS if name in row}
    return row


def _not_utf8(path: str, error: UnicodeDecodeError) -> InputError:
    """The error with the encoding that the file's first bytes show."""
    with storage.open_read(path) as stream:
        start = stream.read(4)
    marked = next((name for mark, name in BYTE_ORDER_MARKS.items() if start.startswith(mark)), None)
    if marked or b"\0" in start:
        name = marked or "UTF-16"
        return InputError(
            f"{path} is not UTF-8, it is {name}; expected UTF-8 with or without BOM; save it again "
            f"as UTF-8, or `iconv -f {name.replace('-', '').lower()} -t utf8` it"
        )
    return InputError(
        f"{path} is not UTF-8 (byte {error.object[error.start]:#04x}); expected UTF-8 with or "
        "without BOM; save it again as UTF-8, or `iconv -f latin1 -t utf8` it"
    )


def _parquet_rows(path: str) -> Iterator[Row]:
    with storage.open_read(path) as stream:
        try:
            schema = pq.read_schema(stream)
            ours = _map_columns(path, schema.names)
            for name in ours:
                if not _is_plain(schema.field(name).type):
                    kind = str(schema.field(name).type)[:80]
                    raise InputError(
                        f"{path} has a column {name} of {kind}, expected text, numbers or times; "
                        "write it as these"
                    )
            # As dictionaries: a text that the file stores once, for ten thousand rows, is in memory
            # once.
            table = pq.ParquetFile(stream, read_dictionary=list(ours))
            for batch in table.iter_batches(BATCH_ROWS, columns=list(ours)):
                columns = {ours[name]: _values(batch.column(name)) for name in batch.schema.names}
                for cells in zip(*columns.values(), strict=True):
                    yield dict(zip(columns, cells, strict=True))
        except InputError:
            raise
        # pyarrow's, of any kind: damage, a date outside of the calendar, an unknown time zone.
        except Exception as error:
            raise InputError(
                f"{path} cannot be read as Parquet ({error}); expected a Parquet file; "
                "write it again"
            ) from None


def _values(column: Any) -> list[Any]:
    """A column's values; equal ones of a dictionary are one object."""
    if not pa.types.is_dictionary(column.type):
        values: list[Any] = column.to_pylist()
        return values
    entries = column.dictionary.to_pylist()
    return [None if at is None else entries[at] for at in column.indices.to_pylist()]


def _is_plain(kind: Any) -> bool:
    types = pa.types
    if types.is_dictionary(kind):
        return _is_plain(kind.value_type)
    tests = (
        types.is_string,
        types.is_large_string,
        types.is_integer,
        types.is_floating,
        types.is_boolean,
        types.is_decimal,
        types.is_null,
        types.is_date,
        types.is_timestamp,
    )
    return any(test(kind) for test in tests)


def _geojson_rows(path: str) -> Iterator[Row]:
    """Features' properties and, under SHAPE_COLUMN, their geometries."""
    try:
        collection = json.loads(storage.read_bytes(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path} cannot be read as JSON ({error}); expected GeoJSON in UTF-8; write it again"
        ) from None
    features = None
    if isinstance(collection, dict) and collection.get("type") == "FeatureCollection":
        features = collection.get("features")
    if not isinstance(features, list):
        raise InputError(
            f"{path} holds no FeatureCollection; expected GeoJSON with a feature per image"
        )
    system = str(collection.get("crs") or "CRS84")
    if "CRS84" not in system and "4326" not in system:
        raise InputError(
            f"{path} has coordinates in {system}; expected longitude and latitude, WGS84; "
            "reproject it"
        )
    features = [feature if isinstance(feature, dict) else {} for feature in features]
    properties = [
        given if isinstance(given := feature.get("properties"), dict) else {}
        for feature in features
    ]
    names = dict.fromkeys(name for given in properties for name in given)
    ours = _map_columns(path, names) if features else {}
    for feature, given in zip(features, properties, strict=True):
        row = {ours[name]: value for name, value in given.items() if name in ours}
        shape = parse_geometry(feature.get("geometry"))
        yield row | ({} if shape is None else {SHAPE_COLUMN: shape})
