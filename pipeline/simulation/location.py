"""All pictures of one simulated location: a seed and a number come in, JPEG bytes and camera poses
go out.

A pure function of its order, so the pictures are the same whoever takes them, whenever, beside
whatever else.
"""

import time
from dataclasses import dataclass, replace
from math import cos, pi, radians, sin, sqrt

import numpy as np
import simplejpeg

from pipeline.simulation.appearance import sample_day
from pipeline.simulation.flight import FlightPlan, Pose
from pipeline.simulation.render import render_nadir, render_perspective
from pipeline.simulation.scene import prepare_scene
from pipeline.simulation.texture import FLIGHT_OVER_TEXTURE, textured_world
from pipeline.simulation.town.town import make_town
from pipeline.simulation.world import ByteMap

JPEG_QUALITY = 90
"""Pictures of cameras and map services are compressed about as much."""
SATELLITE_HALF_SIDE_RADII = 1.7
"""Half the side of the satellite picture, target radii: between the first UAV frame's 2.1 and the
last one's 1.2.
"""

CENTRE_LAT, CENTRE_LON = 46.5, 8.0
"""Where the made country lies; nothing of the place itself is used."""
SPACING_M = 300.0
"""Distance between neighbouring locations."""
METRES_PER_DEGREE = 111_320.0
"""Of latitude; of longitude at the equator."""


@dataclass(frozen=True, kw_only=True)
class LocationSpec:
    """What to photograph."""

    seed: int
    location: int
    "Number of the location, from 1."
    views: int
    "UAV pictures."
    size: int
    "Side of every picture, pixels."
    texture: str | None = None
    "A real overhead image to fly over instead of a made town."
    texture_metres_per_pixel: float = 0.3
    "Resolution of that image."


@dataclass(frozen=True, kw_only=True)
class LocationImages:
    """What came of it."""

    satellite: bytes
    drone: list[bytes]
    poses: list[Pose]
    seconds: dict[str, float]
    "How long it took, by step."


def render_location(order: LocationSpec) -> LocationImages:
    """Make the world, let the satellite pass on one day and the UAV fly on another.

    Raises InputError for a texture that cannot be read.
    """
    begin = time.perf_counter()
    streams = np.random.default_rng([order.seed, order.location]).spawn(5)
    for_world, for_satellite, for_satellite_day, for_flight, for_flight_day = streams
    if order.texture is None:
        world = make_town(for_world, frame_pixels=order.size)
        plan = FlightPlan(views=order.views)
    else:
        world = textured_world(
            order.texture, metres_per_pixel=order.texture_metres_per_pixel, frame_pixels=order.size
        )
        plan = replace(FLIGHT_OVER_TEXTURE, views=order.views)
    made = time.perf_counter()
    radius = world.target_radius_m
    above = render_nadir(
        prepare_scene(world, sample_day(for_satellite_day)),
        size=order.size,
        half_m=SATELLITE_HALF_SIDE_RADII * radius * float(for_satellite.uniform(0.95, 1.08)),
        shift_m=(
            float(for_satellite.normal(0, 0.05)) * radius,
            float(for_satellite.normal(0, 0.05)) * radius,
        ),
        turn_deg=float(for_satellite.uniform(-5, 5)),
        rng=for_satellite,
    )
    scene = prepare_scene(world, sample_day(for_flight_day))
    first_heading = float(for_flight.uniform(0, 360))
    poses = plan.poses(radius_m=radius, first_heading_deg=first_heading)
    frames = [render_perspective(scene, pose, size=order.size, rng=for_flight) for pose in poses]
    rendered = time.perf_counter()
    satellite, drone = encode_jpeg(above), [encode_jpeg(frame) for frame in frames]
    seconds = {
        "world": made - begin,
        "render": rendered - made,
        "encode": time.perf_counter() - rendered,
    }
    return LocationImages(satellite=satellite, drone=drone, poses=poses, seconds=seconds)


def encode_jpeg(frame_SS3: ByteMap) -> bytes:
    """The frame as JPEG."""
    jpeg: bytes = simplejpeg.encode_jpeg(
        frame_SS3, quality=JPEG_QUALITY, colorspace="RGB", colorsubsampling="420"
    )
    return jpeg


def geotag(location: int) -> tuple[float, float]:
    """(latitude, longitude) of a location: on a sunflower's spiral, so the country is round however
    many there are.
    """
    away = SPACING_M * sqrt(location / pi)
    turn = location * pi * (3 - sqrt(5))
    return offset_latlon(CENTRE_LAT, CENTRE_LON, away * sin(turn), away * cos(turn))


def offset_latlon(lat: float, lon: float, east_m: float, north_m: float) -> tuple[float, float]:
    """The point so far east and north of another; exact enough over a few kilometres."""
    return lat + north_m / METRES_PER_DEGREE, lon + east_m / (METRES_PER_DEGREE * cos(radians(lat)))
