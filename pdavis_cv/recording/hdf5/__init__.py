"""HDF5 as E2P, DSEC and rpg lay it out: reading and writing."""
