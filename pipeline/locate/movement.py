"""Two candidates of a flight -> whether a UAV can have flown from one to the other, and how much
likelier both are for it.

In: candidates with the ground that they show, the camera's own place where it is known, and the
errors of both. Out: reaches, and likelihoods of the displacements that odometry measured. NumPy
only, no I/O. Shapes: M and K candidates, N of either, 2 = latitude and longitude in degrees or
(east, north) in metres, 3 = metres from the earth's centre.

The UAV moves, but what a photo shows may turn with its camera. So a distance is that of the two
cameras where both are known, else that of the two grounds, and how far either camera looks ahead is
added to its reach.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.camera.local_plane import metres_per_degree_at
from pipeline.core.arrays import Doubles, Ints, Mask
from pipeline.core.geo import EARTH_RADIUS_M, on_sphere
from pipeline.locate.odometry import Travelled


@dataclass(frozen=True, kw_only=True)
class Places:
    """Places of candidates, and how far from them the photos' own may lie."""

    positions_N2: Doubles
    "Latitude and longitude; NaN where unknown."
    slack_N: Doubles
    "Metres that hold nearly all errors: the speed limit is wider by them."
    covariance_N22: Doubles
    "Of the errors (east, north), square metres."

    @staticmethod
    def exact(positions_N2: Doubles) -> "Places":
        """Places without errors of their own."""
        count = len(positions_N2)
        return Places(
            positions_N2=positions_N2,
            slack_N=np.zeros(count),
            covariance_N22=np.zeros((count, 2, 2)),
        )

    @staticmethod
    def unknown(count: int) -> "Places":
        """As many unknown places."""
        return Places.exact(np.full((count, 2), np.nan))

    @staticmethod
    def joined(parts: "list[Places]") -> "Places":
        """All places of several in one row; at least one."""
        return Places(
            positions_N2=np.concatenate([part.positions_N2.reshape(-1, 2) for part in parts]),
            slack_N=np.concatenate([part.slack_N for part in parts]),
            covariance_N22=np.concatenate([part.covariance_N22 for part in parts]),
        )


@dataclass(frozen=True, kw_only=True)
class Ends:
    """Candidates at the ends of moves: arrays of N rows."""

    time_N: Doubles
    ground_N2: Doubles
    ground_N3: Doubles
    ground_slack_N: Doubles
    ground_covariance_N22: Doubles
    camera_N2: Doubles
    "NaN where unknown."
    camera_N3: Doubles
    camera_slack_N: Doubles
    camera_covariance_N22: Doubles
    ahead_N: Doubles
    "Metres from below the camera to the ground in the photo's middle; 0 where unknown."
    chain_N: Ints
    "Of the odometry; -1: none is known."
    travelled_N2: Doubles
    "(east, north) since the chain's beginning."
    travelled_variance_N: Doubles

    @staticmethod
    def of(
        time_N: Doubles,
        ground: Places,
        camera: Places,
        ahead_N: Doubles,
        travelled: "list[Travelled | None]",
    ) -> "Ends":
        """The ends from places, and from how far each camera has travelled."""
        known_N = ~np.isnan(camera.positions_N2).any(axis=1)
        between_N2 = _displacement(ground.positions_N2, camera.positions_N2)
        between_N = np.linalg.norm(between_N2, axis=1)
        gone = [one or Travelled(chain=-1) for one in travelled]
        return Ends(
            time_N=time_N,
            ground_N2=ground.positions_N2,
            ground_N3=on_sphere(np.nan_to_num(ground.positions_N2)),
            ground_slack_N=ground.slack_N,
            ground_covariance_N22=ground.covariance_N22,
            camera_N2=camera.positions_N2,
            camera_N3=on_sphere(np.nan_to_num(camera.positions_N2)),
            camera_slack_N=camera.slack_N,
            camera_covariance_N22=camera.covariance_N22,
            ahead_N=np.where(known_N, between_N, ahead_N),
            chain_N=np.array([one.chain for one in gone], np.int64),
            travelled_N2=np.array([(one.east_m, one.north_m) for one in gone]).reshape(-1, 2),
            travelled_variance_N=np.array([one.variance_m2 for one in gone], np.float64),
        )

    def part(self, rows: slice) -> "Ends":
        return replace(self, **{one.name: getattr(self, one.name)[rows] for one in fields(self)})

    @property
    def camera_known_N(self) -> Mask:
        return np.asarray(~np.isnan(self.camera_N2).any(axis=1))


@dataclass(frozen=True, kw_only=True)
class Moves:
    """All moves from M candidates to K others."""

    reach_MK: Doubles
    "The longest distance that can have been flown, metres, errors included."
    within_MK: Mask
    "Whether the distance is at most as long."
    measured_MK: Mask
    "Whether odometry measured the displacement."
    log_density_MK: Doubles
    """Log of the likelihood of the measured displacement, per square metre, where it was
    measured."""
    peak_MK: Doubles
    "The same if the measurement were met exactly."


def moves_between(some: Ends, others: Ends, max_speed: float, slack_m: float) -> Moves:
    """The moves between candidates of earlier photos and of later ones, or the other way.

    `max_speed`: metres per second; `slack_m`: metres that are added to every reach.
    """
    flown_MK = max_speed * np.abs(others.time_N[None] - some.time_N[:, None]) + slack_m
    errors_MK = some.ground_slack_N[:, None] + others.ground_slack_N[None]
    errors_MK = errors_MK + some.ahead_N[:, None] + others.ahead_N[None]
    reach_MK = flown_MK + errors_MK
    within_MK = within_reach(some.ground_N3, others.ground_N3, reach_MK)
    cameras_MK = some.camera_known_N[:, None] & others.camera_known_N[None]
    if cameras_MK.any():
        camera_reach_MK = flown_MK + some.camera_slack_N[:, None] + others.camera_slack_N[None]
        near_MK = within_reach(some.camera_N3, others.camera_N3, camera_reach_MK)
        within_MK = np.where(cameras_MK, near_MK, within_MK)
        reach_MK = np.where(cameras_MK, camera_reach_MK, reach_MK)
    same_MK = some.chain_N[:, None] == others.chain_N[None]
    measured_MK = same_MK & (some.chain_N[:, None] >= 0)
    log_density_MK = peak_MK = np.zeros(reach_MK.shape)
    if measured_MK.any():
        log_density_MK, peak_MK = _odometry_density(some, others, cameras_MK)
    return Moves(
        reach_MK=reach_MK,
        within_MK=within_MK,
        measured_MK=measured_MK,
        log_density_MK=log_density_MK,
        peak_MK=peak_MK,
    )


def _odometry_density(some: Ends, others: Ends, cameras_MK: Mask) -> tuple[Doubles, Doubles]:
    """Log-density (M, K) of the measured displacements under a normal distribution around those of
    the candidates, and at its middle. Its covariance is that of the odometry and of both ends."""
    ground_MK2 = _displacement(some.ground_N2[:, None], others.ground_N2[None])
    camera_MK2 = _displacement(some.camera_N2[:, None], others.camera_N2[None])
    moved_MK2 = np.where(cameras_MK[..., None], camera_MK2, ground_MK2)
    # A camera that looks ahead in an unknown direction: half its square is the variance of a part.
    ahead_N22, ahead_K22 = (
        one.ground_covariance_N22 + one.ahead_N[:, None, None] ** 2 / 2 * np.eye(2)
        for one in (some, others)
    )
    ground_MK22 = ahead_N22[:, None] + ahead_K22[None]
    camera_MK22 = some.camera_covariance_N22[:, None] + others.camera_covariance_N22[None]
    covariance_MK22 = np.where(cameras_MK[..., None, None], camera_MK22, ground_MK22)
    gone_MK2 = others.travelled_N2[None] - some.travelled_N2[:, None]
    variance_MK = np.abs(others.travelled_variance_N[None] - some.travelled_variance_N[:, None])
    east_MK = covariance_MK22[..., 0, 0] + variance_MK
    north_MK = covariance_MK22[..., 1, 1] + variance_MK
    both_MK = covariance_MK22[..., 0, 1]
    determinant_MK = np.maximum(east_MK * north_MK - both_MK**2, 1e-12)
    off_MK2 = moved_MK2 - gone_MK2
    squared_MK = (
        north_MK * off_MK2[..., 0] ** 2
        - 2 * both_MK * off_MK2[..., 0] * off_MK2[..., 1]
        + east_MK * off_MK2[..., 1] ** 2
    ) / determinant_MK
    peak_MK = -np.log(2 * np.pi) - np.log(determinant_MK) / 2
    return np.asarray(peak_MK - np.nan_to_num(squared_MK, nan=np.inf) / 2), np.asarray(peak_MK)


def _displacement(some_X2: Doubles, others_X2: Doubles) -> Doubles:
    """(east, north) in metres (X, 2) from positions to others; longitudes wrap. X: any shape of
    either that NumPy broadcasts."""
    north_X = others_X2[..., 0] - some_X2[..., 0]
    east_X = (others_X2[..., 1] - some_X2[..., 1] + 180) % 360 - 180
    scale_X2 = (metres_per_degree_at(some_X2[..., 0]) + metres_per_degree_at(others_X2[..., 0])) / 2
    return np.stack([east_X, north_X], axis=-1) * scale_X2[..., ::-1]


def within_reach(some_M3: Doubles, others_K3: Doubles, reach_MK: Doubles) -> Mask:
    """Whether great circles between points are at most that long; by their chords, which a matrix
    product gives."""
    squared_MK = 2 * (EARTH_RADIUS_M**2 - some_M3 @ others_K3.T)
    half_angle_MK = np.minimum(reach_MK / (2 * EARTH_RADIUS_M), np.pi / 2)
    chord_MK = 2 * EARTH_RADIUS_M * np.sin(half_angle_MK)
    return np.asarray(squared_MK <= chord_MK**2 + 1.0)  # 1 square metre: the product's rounding
