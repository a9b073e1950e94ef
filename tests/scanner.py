"""Ground and walls as a spinning scanner on a tripod sees them."""

import numpy as np

STATIONS = ((9.0, 0.0), (0.0, 9.0), (-9.0, 0.0), (0.0, -9.0))


def rays(beams: int, half_deg: float) -> np.ndarray:
    """Directions of one turn ``(N, 3)``: a ray each 0.2°, in beams from ``-half_deg`` to ``half_deg``."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(-half_deg, half_deg, beams)), np.radians(np.arange(0, 360, 0.2))
    )
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)


def seen(
    beams: int, half_deg: float, wall_x: float | None = None, far_m: float = 35.0, stations: int = 3
) -> np.ndarray:
    """Ground, and a wall of 20 × 8 m, from some stations, 1.5 m above the ground: ``(N, 3)`` with noise of 1 cm."""
    rng, ray, points = np.random.default_rng(0), rays(beams, half_deg), []
    with np.errstate(divide="ignore", invalid="ignore"):
        for x, y in STATIONS[:stations]:
            range_m = np.where(ray[:, 2] < 0, -1.5 / ray[:, 2], np.inf)
            if wall_x is not None:
                to_wall = (wall_x - x) / ray[:, 0]
                hit = ray * to_wall[:, None]
                is_hit = (to_wall > 0) & (abs(y + hit[:, 1]) < 10) & (abs(hit[:, 2] + 1.5 - 4) < 4)
                range_m = np.where(is_hit, np.minimum(to_wall, range_m), range_m)
            near = range_m < far_m
            range_m = range_m[near] + rng.normal(scale=0.01, size=near.sum())
            points.append(np.array([x, y, 1.5]) + range_m[:, None] * ray[near])
    return np.concatenate(points)
