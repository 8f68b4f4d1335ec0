"""All images of one simulated location: a seed and a number come in, JPEG bytes and poses go out.

A pure function of its spec: the images do not depend on the process, the time or other locations.
"""

import time
from dataclasses import dataclass, replace
from itertools import cycle
from math import cos, pi, radians, sin, sqrt

import numpy as np
import simplejpeg

from pipeline.camera.pose import Pose
from pipeline.simulation.appearance import sample_day
from pipeline.simulation.flight import FlightPlan, FreeFlight
from pipeline.simulation.render import render_nadir, render_perspective
from pipeline.simulation.scene import prepare_scene
from pipeline.simulation.settings import Flight
from pipeline.simulation.texture import FLIGHT_OVER_TEXTURE, textured_world
from pipeline.simulation.town.town import make_town
from pipeline.simulation.world import ByteMap

JPEG_QUALITY = 90
"""About the compression of cameras and map services."""
SATELLITE_HALF_SIDE_RADII = 1.7
"""Half the side of the satellite image in target radii; the UAV frames go from 2.1 to 1.2."""

CENTRE_LAT, CENTRE_LON = 46.5, 8.0
"""Geotag of the simulated area's centre; nothing of the real place is used."""
SPACING_M = 300.0
"""Distance between neighbouring locations."""
METRES_PER_DEGREE = 111_320.0
"""Metres per degree of latitude, and of longitude at the equator."""


@dataclass(frozen=True, kw_only=True)
class LocationSpec:
    """The settings that determine a location's images."""

    seed: int
    location: int
    "Number of the location, from 1."
    views: int
    "Number of UAV images."
    size: int
    "Side of every image, pixels."
    flight: Flight = "spiral"
    texture: str | None = None
    "A real overhead image to fly over instead of a procedural town."
    texture_metres_per_pixel: float = 0.3
    "Resolution of that image."


@dataclass(frozen=True, kw_only=True)
class LocationImages:
    """A location's images as JPEG bytes, and the poses of the UAV images."""

    satellite: bytes
    drone: list[bytes]
    poses: list[Pose]
    seconds: dict[str, float]
    "Seconds spent per step."


def render_location(spec: LocationSpec) -> LocationImages:
    """Generate the world; render the satellite image on one day and the UAV images on another.

    Raises InputError for a texture that cannot be read.
    """
    begin = time.perf_counter()
    streams = np.random.default_rng([spec.seed, spec.location]).spawn(5)
    for_world, for_satellite, for_satellite_day, for_flight, for_flight_day = streams
    if spec.texture is None:
        world = make_town(for_world, frame_pixels=spec.size)
        plan = FlightPlan(views=spec.views)
    else:
        world = textured_world(
            spec.texture, metres_per_pixel=spec.texture_metres_per_pixel, frame_pixels=spec.size
        )
        plan = replace(FLIGHT_OVER_TEXTURE, views=spec.views)
    generated = time.perf_counter()
    radius = world.target_radius_m
    above = render_nadir(
        prepare_scene(world, sample_day(for_satellite_day)),
        size=spec.size,
        half_m=SATELLITE_HALF_SIDE_RADII * radius * float(for_satellite.uniform(0.95, 1.08)),
        shift_m=(
            float(for_satellite.normal(0, 0.05)) * radius,
            float(for_satellite.normal(0, 0.05)) * radius,
        ),
        turn_deg=float(for_satellite.uniform(-5, 5)),
        rng=for_satellite,
    )
    if spec.flight == "free":
        free = FreeFlight(views=spec.views)
        poses, days = free.poses(radius_m=radius, rng=for_flight), min(free.days, free.views)
    else:
        first_heading = float(for_flight.uniform(0, 360))
        poses, days = plan.poses(radius_m=radius, first_heading_deg=first_heading), 1
    scenes = [prepare_scene(world, sample_day(for_flight_day)) for _ in range(days)]
    frames = [
        render_perspective(scene, pose, size=spec.size, rng=for_flight)
        for scene, pose in zip(cycle(scenes), poses, strict=False)
    ]
    rendered = time.perf_counter()
    satellite, drone = encode_jpeg(above), [encode_jpeg(frame) for frame in frames]
    seconds = {
        "world": generated - begin,
        "render": rendered - generated,
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
    """(lat, lon) of a location: on a sunflower spiral, so that any number of them forms a disc."""
    distance_m = SPACING_M * sqrt(location / pi)
    turn = location * pi * (3 - sqrt(5))
    return offset_latlon(CENTRE_LAT, CENTRE_LON, distance_m * sin(turn), distance_m * cos(turn))


def offset_latlon(lat: float, lon: float, east_m: float, north_m: float) -> tuple[float, float]:
    """(lat, lon) of the point so far east and north of another; accurate over a few kilometres."""
    return lat + north_m / METRES_PER_DEGREE, lon + east_m / (METRES_PER_DEGREE * cos(radians(lat)))
