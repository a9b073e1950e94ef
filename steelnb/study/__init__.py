"""Studies: many seeds, flights, noises, sensors and methods, run once each on one machine or a Dask cluster."""
