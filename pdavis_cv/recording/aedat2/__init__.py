"""Read and write AEDAT-2.0, the format of jAER and v2e."""
