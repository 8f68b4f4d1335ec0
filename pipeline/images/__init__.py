"""Single images: their bytes in; pixels, sizes, thumbnails and camera tags out.

In: the bytes of one image file. Out: RGB pixels that stand upright (`decode`), resized and
augmented for a network (`transforms`, `augmentation`; the steps of other methods are in `chains`
and `auto_augment`); the size without decoding (`inspect`); a small picture for a page
(`thumbnails`); the camera's position, heading and time (`camera_tags`). An image that cannot be
used raises `DecodeError` with a countable reason, a tag `UnreadableTag`.

Begin with `decode`. The tags are read in three steps: `image_blocks` finds the EXIF and XMP blocks
of a file, `exif` and `xmp` list their entries, `camera_tags` interprets them.
"""
