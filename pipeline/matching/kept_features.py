"""The features of a map kept in a file beside its index: made once.

In: a path, and what the features belong to. Out: the features, read or made.
"""

import io
import zipfile
from dataclasses import dataclass

import numpy as np

from pipeline.camera.local_plane import LocalPlane
from pipeline.core import storage
from pipeline.core.progress import console
from pipeline.matching.map_features import FAISS, MapFeatures, find_map_features
from pipeline.matching.map_windows import MapWindows

MAP_FEATURES_FILE = "map_features.npz"
"In the index's folder."
VERSION = "2"
"Of the features: counted up when other code would find others."


@dataclass(frozen=True, kw_only=True)
class FeatureFile:
    """Where the features of a map are kept."""

    path: str
    belongs_to: str
    "Which tiles: features of others are made anew."

    def read(self) -> MapFeatures | None:
        """The features that are kept; None where there are none, or those of other tiles, or of a
        damaged file."""
        if not storage.exists(self.path):
            return None
        try:
            with np.load(io.BytesIO(storage.read_bytes(self.path)), allow_pickle=False) as kept:
                if str(kept["belongs_to"]) != self._name():
                    return None
                lat, lon, reach_m = kept["frame"].tolist()
                index = FAISS.deserialize_index(kept["index"])
                index.make_direct_map()
                return MapFeatures(
                    plane=LocalPlane(lat=lat, lon=lon),
                    points_N2=kept["points_N2"],
                    metres_per_pixel_N=kept["metres_per_pixel_N"],
                    angles_N=kept["angles_N"],
                    index=index,
                    reach_m=reach_m,
                )
        except (OSError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile) as error:
            console.print(f"{self.path} is damaged ({error}); it is not used", markup=False)
            return None

    def make(self, windows: MapWindows) -> MapFeatures | None:
        """The features of the windows, which are kept if the folder can be written to. None of a
        map that is too large."""
        found = find_map_features(windows)
        if found is not None:
            self._keep(found)
        return found

    def _keep(self, features: MapFeatures) -> None:
        stream = io.BytesIO()
        np.savez(
            stream,
            belongs_to=np.array(self._name()),
            frame=np.array([features.plane.lat, features.plane.lon, features.reach_m]),
            points_N2=features.points_N2,
            metres_per_pixel_N=features.metres_per_pixel_N,
            angles_N=features.angles_N,
            index=FAISS.serialize_index(features.index),
        )
        try:
            storage.write_bytes(self.path, stream.getvalue())
        except OSError as error:
            console.print(
                f"{self.path} cannot be written ({error}): the map's features are made anew each "
                "time",
                markup=False,
            )

    def _name(self) -> str:
        return f"{VERSION} {self.belongs_to}"
