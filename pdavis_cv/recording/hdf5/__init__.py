"""Read and write HDF5 in the layouts of E2P and DSEC; read that of rpg."""
