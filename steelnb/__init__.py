"""steelnb: drone mapping of steel structures, from simulated or recorded Time-of-Flight scans."""

__version__ = "0.1.0"
