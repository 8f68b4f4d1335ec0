"""Shim."""

from pipeline.transforms import decode


def inspect(data: bytes) -> tuple[int, int]:
    height, width = decode(data).shape[:2]
    return width, height
