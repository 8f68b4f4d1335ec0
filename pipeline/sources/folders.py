"""Folders that hold one folder of images per location -> their images.

In: a folder on some storage. Out: its images, each with its location; a Rejection for each file
elsewhere in the layout, and a SkippedFile for each file that is no image by its name.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import (
    GeoTag,
    ImageRecord,
    Rejection,
    Scanned,
    SkippedFile,
    Split,
    View,
)
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import not_an_image


@dataclass(frozen=True, kw_only=True)
class SplitFolder:
    """The folder of one split's images of one view: `<phase>/<folder>`."""

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
    """Folders as University-1652 and its successors name them: `train/drone`, `test/query_drone`,
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


def images_by_location(folder: str) -> Iterator[LocatedImage | Rejection | SkippedFile]:
    """All images at `<folder>/<location>/<image>`, ordered by path; none where there is no
    folder.
    """
    if not storage.is_folder(folder):
        return
    for path, size in storage.walk(folder).items():
        location, _, name = path.rpartition("/")
        full_path = storage.join(folder, path)
        if not is_image_name(name):
            yield not_an_image(full_path)
        elif not location or "/" in location:
            yield wrong_folder(full_path, f"{path} is not <location>/<image>")
        else:
            yield LocatedImage(path=full_path, name=name, location=location, bytes=size)


def images_by_split(
    root: str, views: Iterable[View], tag: Callable[[SplitFolder, LocatedImage], GeoTag | None]
) -> Iterator[Scanned]:
    """All images of a data set whose folders are named as University-1652's, with the geotag that
    `tag` returns for each. Other folders beside them are passed over.
    """
    folders = split_folders(views)
    wanted = {f"{folder.phase}/{folder.folder}" for folder in folders}
    for phase in dict.fromkeys(folder.phase for folder in folders):
        for name in _folder_names(storage.join(root, phase)):
            if f"{phase}/{name}" not in wanted:
                yield SkippedFile(path=storage.join(root, phase, name), reason=f"folder {name}")
    for folder in folders:
        for item in images_by_location(storage.join(root, folder.phase, folder.folder)):
            if not isinstance(item, LocatedImage):
                yield item
                continue
            yield ImageRecord(
                path=item.path,
                split=folder.split,
                view=folder.view,
                location=item.location,
                geotag=tag(folder, item),
                bytes=item.bytes,
            )


def wrong_folder(path: str, found: str) -> Rejection:
    """An image in a folder where the layout has none."""
    return Rejection(path=path, reason="wrong folder", found=found)


def require_images(found: Iterable[Scanned], root: str, layout: str) -> Iterator[Scanned]:
    """The results of a scan, passed on. `layout` says in words what was expected at `root`.

    Raises InputError when `root` is not a folder, and at the end when there was no image.
    """
    if not storage.is_folder(root):
        raise InputError(f"no folder {root}; expected {layout}; check --root")
    some = False
    for item in found:
        some = some or isinstance(item, ImageRecord)
        yield item
    if not some:
        raise InputError(f"no images below {root}; expected {layout}; check --root")


def _folder_names(folder: str) -> list[str]:
    if not storage.is_folder(folder):
        return []
    names = storage.list_names(folder)
    return [name for name in names if storage.is_folder(storage.join(folder, name))]
