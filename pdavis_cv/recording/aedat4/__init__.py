"""Read and write AEDAT-4, the format of DV, dv-processing and jAER."""
