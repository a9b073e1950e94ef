"""What the owner of a simulated camera measures before a flight: ranges to a wall at known distances."""

import numpy as np

from steelnb.core import rng
from steelnb.core.arguments import checks_arguments
from steelnb.settings import TofSettings
from steelnb.settings.world import fitted_calibration
from steelnb.simulation.tof_faults import draw_faults, reported_range

DISTANCES_M = np.arange(0.5, 4.01, 0.25)
"""Of the wall from the camera: 15 tape marks. Their step is no multiple of the wiggle's period, so it averages out."""
TAPE_SIGMA_M = 0.001
"""Standard deviation of a distance by tape."""
PIXELS = 400
"""Number of pixels around the optical axis whose ranges are averaged at each distance."""


@checks_arguments
def measure_calibration(settings: TofSettings, seed: rng.Seed) -> dict[str, float]:
    """Scale and offset of the camera of a seed, with their standard deviations, as overrides of `TofSettings`: a line
    fitted to mean ranges at `DISTANCES_M`.

    The ranges have the camera's offset, scale and wiggle, and white noise. A wall seen at right angles has neither
    mixed pixels nor multipath. Standard deviations come from the residuals, so they contain the wiggle.
    """
    random, faults = rng.stream(seed, "tof-calibration"), draw_faults(settings, rng.stream(seed, "tof-camera"))
    tape_m, noise = random.standard_normal((2, len(DISTANCES_M)))
    sigma_m = np.maximum(settings.sigma_floor_m, settings.sigma_relative * DISTANCES_M) / np.sqrt(PIXELS)
    range_m = DISTANCES_M if faults is None else reported_range(DISTANCES_M, faults)
    return fitted_calibration(DISTANCES_M + TAPE_SIGMA_M * tape_m, range_m + sigma_m * noise)
