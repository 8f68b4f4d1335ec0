"""Where were these photos taken? `locate.py --checkpoint FILE --index INDEX --out FILE.geojson PHOTO...`

Photos, or folders of them, are embedded as the index's images were, and the index is asked. Writes GeoJSON, on demand CSV and a
page with a map. Photos that cannot be decoded are listed with the reason, the others are answered, and the exit code is 1.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import batched
from typing import Any

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from jobs.cli import run
from jobs.photo_encoder import PhotoEncoder
from pipeline import answer_files, storage
from pipeline.ahead import ahead
from pipeline.answer_files import Located
from pipeline.confidence import Confidence, find_confidence, read_confidence
from pipeline.features import Floats
from pipeline.flight import settle
from pipeline.gallery_map import GalleryMap, read_gallery_map
from pipeline.index import Index
from pipeline.locate import Answer, locate
from pipeline.photo_files import find_photos, folder_of, read_times, seconds, taken_at
from pipeline.progress import console, progress
from pipeline.records import InputError, Rejection, Unfinished
from pipeline.track import TRACKED, Motion, Start
from pipeline.where import Near, Where

BATCH = 128
"Photos that are read and encoded at a time."
READERS = 4
