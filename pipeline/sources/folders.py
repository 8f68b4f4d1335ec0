"""Folders that hold one folder of images per location -> what is in them.

In: a folder on some storage. Out: its images with the location that each lies in, and a Rejection
for whatever lies elsewhere or is no image by its name.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import not_an_image


@dataclass(frozen=True, kw_only=True)
class SplitFolder:
    """Where one split's images of one view are: `<phase>/<folder>`."""

    phase: str
    folder: str
    split: Split
    view: View


@dataclass(frozen=True, kw_only=True)
class LocatedImage:
    """An image in its location's folder."""

    path: str
    name: str
    "Of the file, with its ending."
    location: str
    bytes: int


def split_folders(
    views: Iterable[View], train: str = "train", test: str = "test"
) -> list[SplitFolder]:
    """Folders as University-1652 names them and others after it: `train/drone`, `test/query_drone`,
    `test/gallery_drone`.
    """
    phases = (
        (train, Split.TRAIN, ""),
        (test, Split.QUERY, "query_"),
        (test, Split.GALLERY, "gallery_"),
    )
    return [
        SplitFolder(phase=phase, folder=f"{prefix}{view}", split=split, view=view)
        for phase, split, prefix in phases
        for view in views
    ]


def images_by_location(folder: str) -> Iterator[LocatedImage | Rejection]:
    """All images at `<folder>/<location>/<image>`, ordered by path; an absent folder has none."""
    if not storage.is_folder(folder):
        return
    for path, size in storage.walk(folder).items():
        location, _, name = path.rpartition("/")
        whole = storage.join(folder, path)
        if not location or "/" in location:
            yield wrong_folder(whole, f"{path} is not <location>/<image>")
        elif not is_image_name(name):
            yield not_an_image(whole)
        else:
            yield LocatedImage(path=whole, name=name, location=location, bytes=size)


def images_by_split(
    root: str, views: Iterable[View], tag: Callable[[SplitFolder, LocatedImage], GeoTag | None]
) -> Iterator[ImageRecord | Rejection]:
    """All images of a data set whose folders are named as University-1652's, with the geotag that
    `tag` knows of each.
    """
    for folder in split_folders(views):
        for item in images_by_location(storage.join(root, folder.phase, folder.folder)):
            if isinstance(item, Rejection):
                yield item
                continue
            yield ImageRecord(
                path=item.path, split=folder.split, view=folder.view, location=item.location,
                geotag=tag(folder, item), bytes=item.bytes,
            )  # fmt: skip


def wrong_folder(path: str, found: str) -> Rejection:
    """A file that lies where the layout has none."""
    return Rejection(path=path, reason="wrong folder", found=found)


def require_images(
    found: Iterable[ImageRecord | Rejection], root: str, layout: str
) -> Iterator[ImageRecord | Rejection]:
    """What a scan found, passed on. `layout` says in words what was expected at `root`.

    Raises InputError when `root` is no folder, and at the end when not one image was found.
    """
    if not storage.is_folder(root):
        raise InputError(f"no folder {root}; expected {layout}; check --root")
    some = False
    for item in found:
        some = some or isinstance(item, ImageRecord)
        yield item
    if not some:
        raise InputError(f"no images below {root}; expected {layout}; check --root")
