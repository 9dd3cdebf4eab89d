"""Images of a polarization camera: video, TIFF, still images and arrays."""
