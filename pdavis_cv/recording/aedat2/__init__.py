"""AEDAT-2.0, as jAER and v2e write it: header, decoding of words, writing."""
