"""AEDAT-4, as DV, dv-processing and jAER write it: container, decoding, writing."""
